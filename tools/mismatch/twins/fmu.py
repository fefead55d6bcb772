"""An FMI 2 or 3 co-simulation FMU as a twin. It is opened and run in a process of its own (``tools.guest``)."""

from __future__ import annotations

import importlib.util
import stat
import struct
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from hal.trust import digest_of, path_inside, trusted_program
from sim_devices.physics.effect import Array
from tools.guest.host import GuestError, GuestProcess
from tools.mismatch.recording import Recording, RecordingError
from tools.mismatch.twins.opaque import OpaqueTwin, opaque_twin

MOST_BYTES, MOST_FILES = 1 << 30, 10_000


class FmuRun:
    """One free run per call. A copy in another process starts a process of its own for the FMU.

    ``named_by``: the file that names it, for messages. ``NotTrusted`` for an FMU that the user has not trusted,
    ``RecordingError`` for a file that is no co-simulation FMU and for a run that fails, ``GuestDied`` for a crash.
    """

    def __init__(self, path: Path, outputs: tuple[str, ...], dt: float, named_by: Path | None = None) -> None:
        self.path = path
        _check_fmpy(path)
        check_archive(path)
        digest = digest_of(trusted_program(path, named_by or path))
        opening = {
            "ask": "open_fmu",
            "path": str(path),
            "digest": digest,
            "outputs": outputs,
            "dt": dt,
        }
        self.guest = GuestProcess(str(path), opening)

    def names(self) -> set[str]:
        """Return the variables of the FMU."""
        try:
            return set(self.guest.opened()[0]["names"])
        except GuestError as error:
            raise RecordingError(f"{self.path}: {error}") from error

    def __call__(self, inputs: Mapping[str, Array], parameters: Mapping[str, Any]) -> Mapping[str, Array]:
        try:
            return self.guest.run(inputs, parameters)
        except GuestError as error:
            raise RecordingError(f"{self.path}: {error}") from error


def check_archive(path: Path) -> None:
    """An archive that stays in its folder and within ``MOST_BYTES`` when it is unpacked; ``RecordingError`` if not."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError, struct.error) as error:
        raise RecordingError(f"{path}: cannot be opened as an FMU ({' '.join(str(error).split())[:200]})") from error
    for member in members:
        name = PurePosixPath(member.filename.replace("\\", "/"))
        if name.is_absolute() or ".." in name.parts or ":" in member.filename:
            raise RecordingError(f"{path}: the archive would unpack '{member.filename}' outside its folder; refused")
        if stat.S_ISLNK(member.external_attr >> 16):
            raise RecordingError(f"{path}: the archive holds a link, '{member.filename}'; refused")
    size = sum(member.file_size for member in members)
    if size > MOST_BYTES or len(members) > MOST_FILES:
        raise RecordingError(f"{path}: {len(members)} files of {size} bytes when unpacked; that is no FMU")


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _check_fmpy(where: Path) -> None:
    if sys.modules.get("fmpy", ...) is None or importlib.util.find_spec("fmpy") is None:
        raise RecordingError(f"{where}: [twin] kind 'fmu' needs FMPy: install this package with its extra 'fmu'")


def fmu_twin(recording: Recording) -> OpaqueTwin:
    """An FMI 2 or 3 co-simulation FMU; ``[twin.parameters] path`` names it beside the descriptor."""
    where = f"{recording.path}: [twin.parameters]"
    name = recording.twin.parameters.get("path")
    if not isinstance(name, str):
        raise RecordingError(f"{where} path must name the .fmu file, got {name!r}")
    path = path_inside(recording.path, name)
    if not path.is_file():
        raise RecordingError(f"{where} path: {path} does not exist")
    run = FmuRun(path, tuple(recording.outputs), recording.dt, recording.path)
    known = run.names()
    lost = [s for s in (*recording.inputs, *recording.outputs) if s not in known]
    lost += [k for k in recording.twin.parameters if k != "path" and k not in known]
    if lost:
        raise RecordingError(f"{path}: no variable {', '.join(lost)} in the FMU")
    return opaque_twin(recording, run, str(path), fixed=("path",))
