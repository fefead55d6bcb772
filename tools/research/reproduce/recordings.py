"""Public recordings beside the project: ``../shared/data``, or the folder that MICRON_DATA names."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any


def data_folder() -> Path:
    """Return where the public recordings are."""
    given = os.environ.get("MICRON_DATA")
    return Path(given) if given else Path(__file__).resolve().parents[4] / "shared" / "data"


def meta(name: str) -> dict[str, Any]:
    """Source, licence, published figures of a set."""
    return tomllib.loads((data_folder() / name / "meta.toml").read_text())
