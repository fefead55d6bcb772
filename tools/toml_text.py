"""Writes a table as TOML that a person reads: one key a line, vectors on a line, floats exact as in memory."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any


def toml_text(table: Mapping[str, Any], name: str = "") -> str:
    """Return ``table`` as TOML: its plain values, then its tables and lists of tables, each under its own head.

    ``name`` is the head that ``table`` itself stands under.
    """
    plain = {k: v for k, v in table.items() if not isinstance(v, Mapping) and not _is_of_tables(v)}
    lines = [f"{_key(k)} = {_value(v)}" for k, v in plain.items()]
    for k, v in table.items():
        if k in plain:
            continue
        below = f"{name}.{_key(k)}" if name else _key(k)
        for entry in [v] if isinstance(v, Mapping) else v:
            head = f"[{below}]" if isinstance(v, Mapping) else f"[[{below}]]"
            lines += ["", head, toml_text(entry, below).rstrip("\n")]
    return "\n".join(lines) + "\n"


def _is_of_tables(value: object) -> bool:
    return isinstance(value, list | tuple) and bool(value) and all(isinstance(v, Mapping) for v in value)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name)


def _value(value: Any) -> str:
    if hasattr(value, "tolist"):
        value = value.tolist()  # numpy's scalars and arrays
    if isinstance(value, str | bool):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, Sequence):
        rows = [_value(v) for v in value]
        of_rows = any(isinstance(v, Mapping | list | tuple) for v in value)
        return "[\n" + "".join(f"  {row},\n" for row in rows) + "]" if of_rows else "[" + ", ".join(rows) + "]"
    return repr(value)
