"""Bench files by name: those that ship with the package."""

from __future__ import annotations

from pathlib import Path

import benches
from tools.errors import InputError


def bench_file(named: str) -> Path:
    """Return the bench file at the path ``named``, or the one of that name that ships. Raises ``InputError``."""
    if Path(named).exists():
        return Path(named)
    shipped = Path(benches.__file__).parent
    if (shipped / f"{named}.toml").exists():
        return shipped / f"{named}.toml"
    names = ", ".join(sorted(path.stem for path in shipped.glob("*.toml") if "[bus." in path.read_text("utf-8")))
    raise InputError(f"{named}: no such bench file, and none of that name ships; these do: {names}")
