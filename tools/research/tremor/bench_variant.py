"""A copy of a bench file with some of its values changed, as a file of its own."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hal.trust import allow_name, path_inside

Table = Mapping[str, Any]


def write_variant(bench: Path, changes: Table, folder: Path, name: str) -> Path:
    """``bench`` with ``changes`` merged in (tables key by key, the rest replaced) as ``folder / name.toml``."""
    table = merged(tomllib.loads(bench.read_text(encoding="utf-8")), changes)
    firmware = table.get("firmware", {})
    if "calibration" in firmware:
        # the copy lives elsewhere
        files = [path_inside(bench, file) for file in firmware["calibration"]]
        for path in files:
            allow_name(path)
        firmware["calibration"] = [str(path) for path in files]
    file = folder / f"{name}.toml"
    file.write_text("".join(f"{key} = {_inline(value)}\n" for key, value in table.items()), encoding="utf-8")
    return file


def merged(table: Table, changes: Table) -> dict[str, Any]:
    """``table`` with ``changes`` in it; neither is touched."""
    out = dict(table)
    for key, value in changes.items():
        old = out.get(key)
        out[key] = merged(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return out


def _inline(value: Any) -> str:
    """Write a TOML value on one line. JSON writes everything but tables as TOML does."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{json.dumps(str(k))} = {_inline(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_inline(v) for v in value) + "]"
    return json.dumps(value, ensure_ascii=False)
