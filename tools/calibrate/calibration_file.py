"""Writes calibration files (TOML, format = 1, one table per stage), which ``[firmware] calibration`` of a bench
names."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tools.output import write_calibration
from tools.toml_text import toml_text


def calibration_toml(title: str, made_by: str, stages: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the text of a calibration file."""
    return toml_text({"format": 1, "title": title, "made_by": made_by, **stages})


def save_calibration(out: Path | None, title: str, made_by: str, stages: Mapping[str, Mapping[str, Any]]) -> None:
    """Write a calibration file that benches of other folders may name; without ``out`` do nothing."""
    if out is not None:
        write_calibration(out, calibration_toml(title, made_by, stages))
