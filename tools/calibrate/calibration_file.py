"""Writes calibration files (TOML, format = 1, one table per stage), which ``[firmware] calibration`` of a bench
names."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value)


def calibration_toml(title: str, made_by: str, stages: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the text of a calibration file."""
    lines = ["format = 1", f"title = {json.dumps(title)}", f"made_by = {json.dumps(made_by)}"]
    for stage, table in stages.items():
        lines += ["", f"[{stage}]"]
        for key, value in table.items():
            if isinstance(value, list | tuple) and value and isinstance(value[0], Mapping | list | tuple):
                lines += [f"{key} = [", *(f"  {_value(item)}," for item in value), "]"]
            else:
                lines.append(f"{key} = {_value(value)}")
    return "\n".join(lines) + "\n"
