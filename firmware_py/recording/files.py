"""Writes a result completely or not at all: it has a temporary name and is renamed when complete."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from firmware_py.recording.errors import RecordingError

_LOCK_TRIES = 20


@contextmanager
def new_file(path: Path, *, overwrite: bool) -> Generator[Path]:
    """A temporary path beside ``path`` that becomes ``path`` at the end of the block, unless it raises."""
    refuse_existing(path, overwrite=overwrite)
    with _temporary_folder(path) as folder:
        part = folder / path.name
        yield part
        os.replace(part, path)


@contextmanager
def new_folder(path: Path) -> Generator[Path]:
    """The same for a folder; an existing one is refused."""
    refuse_existing(path, overwrite=False)
    with _temporary_folder(path) as folder:
        part = folder / path.name
        part.mkdir()
        yield part
        part.rename(path)


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Raise ``RecordingError`` when ``path`` is there and may not be replaced, or is being recorded."""
    if path.exists() and not (overwrite and path.is_file()):
        raise RecordingError(f"{path} exists already: choose another name or remove it")
    if is_being_recorded(path):
        raise RecordingError(f"{path} is being recorded by another process; stop it or choose another name")


def lock(fd: int, path: Path) -> None:
    """Take the exclusive lock of a recording, which ends with its process. ``RecordingError`` when another has it.

    Programs that do not ask for the lock are not kept away by it (``flock`` is advisory).
    """
    for attempt in range(_LOCK_TRIES):
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError as error:
            if attempt == _LOCK_TRIES - 1:
                raise RecordingError(
                    f"{path} is being recorded by another process; stop it or choose another name"
                ) from error
            time.sleep(0.01)  # somebody who only asks holds it for a moment
        except OSError:
            return  # a file system without locks


def is_being_recorded(path: Path) -> bool:
    """Return True if a recorder holds the lock of ``path``."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(fd)
    return False


@contextmanager
def _temporary_folder(path: Path) -> Generator[Path]:
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
