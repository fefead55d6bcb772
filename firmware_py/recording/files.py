"""All of a result or nothing of it: written under a temporary name, renamed when complete."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from firmware_py.recording.errors import RecordingError


@contextmanager
def new_file(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """A temporary path beside ``path`` that becomes ``path`` at the end of the block, unless it raises."""
    refuse_existing(path, overwrite=overwrite)
    with _temporary_folder(path) as folder:
        part = folder / path.name
        yield part
        os.replace(part, path)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """The same for a folder; an existing one is refused."""
    refuse_existing(path, overwrite=False)
    with _temporary_folder(path) as folder:
        part = folder / path.name
        part.mkdir()
        yield part
        part.rename(path)


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    if path.exists() and not (overwrite and path.is_file()):
        raise RecordingError(f"{path} exists already: choose another name or remove it")


@contextmanager
def _temporary_folder(path: Path) -> Iterator[Path]:
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.absolute().parent))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written ({error.strerror}); name a folder that exists") from error
    try:
        yield folder
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written ({error.strerror}); nothing was kept") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
