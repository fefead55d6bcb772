"""Results as files: JSON or text that is there whole or not at all, and a folder that is checked before the work."""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from tools.errors import InputError


def to_jsonable(value: Any) -> Any:
    """Plain JSON values; numpy scalars and arrays become lists, NaN and infinities null."""
    if isinstance(value, dict):
        return {str(k): to_jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [to_jsonable(v) for v in value]
    if isinstance(value, np.ndarray):
        return to_jsonable(value.tolist())
    if isinstance(value, np.generic):
        return to_jsonable(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    return value


def write_text_atomic(path: Path, text: str) -> None:
    """All of the file or nothing of it."""
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); name a folder that exists") from error
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def write_json(result: Any, destination: str | None) -> None:
    """Write ``result`` where ``--json`` said."""
    if destination is None:
        return
    text = json.dumps(to_jsonable(result), indent=2) + "\n"
    if destination == "-":
        sys.stdout.write(text)
    else:
        write_text_atomic(Path(destination), text)


def check_writable(*destinations: str | Path | None, folders: bool = False) -> None:
    """Refuse a result file in a folder that is not there, or that is a folder (unless ``folders``), before any work."""
    for destination in destinations:
        if destination is None or str(destination) == "-":
            continue
        if not folders and Path(destination).is_dir():
            raise InputError(f"{destination}: this is a folder; name a file in it")
        parent = Path(destination).absolute().parent
        if not parent.is_dir():
            raise InputError(f"{destination}: the folder {parent} does not exist; create it first")
