"""Writes results as files: each is there whole or not at all, none costs another, and names are checked before."""

from __future__ import annotations

import io
import json
import os
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

from hal.jsonable import to_jsonable
from hal.trust import allow_name
from tools.errors import FULL, InputError, OutputError
from tools.interrupt import is_stopped


def write_text_atomic(path: Path, text: str) -> None:
    """Write the whole file or nothing. Raises ``OutputError`` when it cannot be written."""
    write_bytes_atomic(path, text.encode())


def write_calibration(path: Path, text: str) -> None:
    """Write a calibration, or another file that benches of other folders may name."""
    write_text_atomic(path, text)
    allow_name(path)


def write_bytes_atomic(path: Path, data: bytes) -> None:
    """Write a temporary file beside ``path`` and rename it; a device or a pipe is written as it is.

    A link is followed. ``OutputError`` when it cannot be written; ``path`` is then what it was before.
    """
    target = path.resolve()
    try:
        if target.exists() and not target.is_file():
            target.write_bytes(data)  # /dev/stdout, /dev/null, a named pipe: renaming would put a file in their place
            return
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name[:200]}.")
    except OSError as error:
        raise OutputError(_cannot(path, error)) from error
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(handle)  # a quota or a full disk may show itself only here
        os.chmod(temporary, 0o644)
        os.replace(temporary, target)
    except OSError as error:
        raise OutputError(_cannot(path, error)) from error
    finally:
        Path(temporary).unlink(missing_ok=True)


def save_figure(figure: Any, path: Path, **options: Any) -> None:
    """Draw a matplotlib figure and write it whole, in the format that the name says; its folder is made."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=path.suffix.removeprefix(".") or "png", **options)
    make_folder_of(path)
    write_bytes_atomic(path, buffer.getvalue())


def make_folder_of(path: Path) -> None:
    """Make the folder of ``path`` unless it is there. Raises ``OutputError`` if it cannot be made."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(_cannot(path, error)) from error


@contextmanager
def folder_atomic(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder beside ``folder``, whose files are put in ``folder`` at the end of the block.

    ``folder`` is made, or keeps the other files that it has. ``OutputError`` when a file cannot be written; after any
    exception ``folder`` is what it was before.
    """
    make_folder_of(folder)
    try:
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name[:200]}.") as temporary:
            part = Path(temporary) / "part"
            part.mkdir()
            yield part
            if folder.is_dir():
                for file in sorted(part.iterdir()):
                    os.replace(file, folder / file.name)
            else:
                part.rename(folder)
    except OSError as error:
        raise OutputError(_cannot(folder, error)) from error


def write_json(result: Any, destination: str | None) -> None:
    """Write ``result`` where ``--json`` said."""
    if destination is None:
        return
    if is_stopped() and isinstance(result, dict):
        result = {**result, "stopped": True}  # Ctrl-C came before it was whole
    text = json.dumps(to_jsonable(result), indent=2) + "\n"
    if destination == "-":
        try:
            sys.stdout.write(text)
            sys.stdout.flush()
        except BrokenPipeError:
            raise
        except OSError as error:
            raise OutputError(_cannot("standard output", error)) from error
    else:
        write_text_atomic(Path(destination), text)


class Outputs:
    """Results that do not depend on one another: each is tried, and ``finish`` says which failed.

    A run of an hour must not be lost because the disk was too full for its picture.
    """

    def __init__(self) -> None:
        self.failed: list[str] = []

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Write one result and remember its errors."""
        try:
            yield
        except OutputError as error:
            self.failed.append(f"{name}: {error}")
        except Exception as error:
            self.failed.append(f"{name}: {type(error).__name__}: {error}")

    def finish(self) -> None:
        """Raise ``OutputError`` with everything that failed, if anything did."""
        if self.failed:
            raise OutputError("not all results could be written; the others are there\n  " + "\n  ".join(self.failed))


def check_names(*destinations: str | Path | None) -> None:
    """Refuse a name that begins with ``-``: it is an option in the wrong place. Raises ``InputError``."""
    for destination in destinations:
        if destination is not None and str(destination).startswith("-"):
            raise InputError(f"{destination}: looks like an option; name a file, or ./{destination} for that name")


MOST_FILES = 1000
"""Number of descriptions (.toml) below a folder that are looked at for the files that they name."""


def files_read(path: Path) -> set[Path]:
    """Return the files behind an input: the file itself, and what it names if it is a description (.toml).

    A folder stands for its recording.toml, or for every description below it.
    """
    own = path / "recording.toml"
    todo = [path] if not path.is_dir() else [own] if own.is_file() else list(islice(path.rglob("*.toml"), MOST_FILES))
    found: set[Path] = set()
    while todo:
        file = todo.pop().resolve()
        if file in found or not os.path.isfile(file):  # False, too, for a text that can be no name of a file
            continue
        found.add(file)
        if file.suffix.lower() == ".toml":
            todo += [file.parent / name for text in _texts(_table(file)) for name in (text, text.rpartition(":")[0])]
    return found


def _table(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError):
        return {}  # the command that reads it says what is wrong


def _texts(value: object) -> Iterator[str]:
    if isinstance(value, str):
        if value and "\0" not in value:
            yield value
    elif isinstance(value, Mapping | list):
        for inner in value.values() if isinstance(value, Mapping) else value:
            yield from _texts(inner)


def _is_recording(target: Path) -> bool:
    """Return True for a recording of the instrument, and for the recording.toml of a folder with the files it names."""
    beside = target.parent / "recording.toml"
    return target.is_file() and (target.suffix.lower() == ".mcap" or target in files_read(beside))


def check_writable(
    *destinations: str | Path | None,
    folders: bool = False,
    reads: Sequence[str | Path | None] = (),
    overwrite: bool = False,
) -> None:
    """Refuse, before any work, a result file that cannot be written or would replace data: ``InputError``.

    The folder must be there and take a file, and the name must not be a folder's (unless ``folders``). A name that
    begins with ``-`` is an option in the wrong place. That the disk becomes full during the work is not seen here.
    No result replaces another one, a file behind the inputs ``reads``, or (unless ``overwrite``) another recording.
    """
    inputs: set[Path] = set()
    for path in reads:
        inputs |= set() if path is None else files_read(Path(path))
    targets: set[Path] = set()
    for destination in destinations:
        if destination is None or str(destination) == "-":
            continue
        check_names(destination)
        path = Path(destination)
        if not folders and path.is_dir():
            raise InputError(f"{destination}: this is a folder; name a file in it")
        target = path.resolve()
        parent = target.parent
        if not parent.is_dir():
            raise InputError(f"{destination}: the folder {parent} does not exist; create it first")
        if target.exists() and not target.is_file():
            if not target.is_dir() and not os.access(target, os.W_OK):
                raise InputError(f"{destination}: no permission to write there; name another file")
            continue
        if target in targets:
            raise InputError(f"{destination}: is named for two results; name a file for each")
        targets.add(target)
        if target in inputs:
            raise InputError(f"{destination}: is read by this command and would be overwritten; name another file")
        if not overwrite and _is_recording(target):
            raise InputError(f"{destination}: is a recording or its data and would be overwritten; name another file")
        try:
            with tempfile.TemporaryFile(dir=parent, prefix=f".{target.name[:200]}."):
                pass
        except OSError as error:
            raise InputError(_cannot(destination, error)) from error


def check_folder(
    folder: Path | None, option: str = "--out", *, files: Sequence[str] = (), reads: Sequence[str | Path | None] = ()
) -> None:
    """Refuse, before any work, a folder for results that is a file or cannot be written: ``InputError``.

    ``files``: what will be written into it; none of them may be data (``check_writable``).
    """
    if folder is None:
        return
    check_writable(folder, folders=True, overwrite=True)  # a file is refused below
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{option} {folder}: is a file; name a folder")
    if folder.exists() and not os.access(folder, os.W_OK):
        raise InputError(f"{option} {folder}: you may not write there; name another folder, or change its rights")
    if folder.is_dir():
        check_writable(*(folder / name for name in files), reads=reads)


def _cannot(path: object, error: OSError) -> str:
    advice = "free some space" if error.errno in FULL else "name a folder that you may write to"
    return f"{path}: cannot be written ({error.strerror or error}); {advice}"
