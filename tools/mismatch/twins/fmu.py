"""Uses an FMU as a twin: co-simulation (FMI 2, 3) or model exchange (FMI 2).

The FMU runs in a process of its own (``tools.guest``). An FMU for model exchange (FMI 2) whose equations are linear
becomes a state-space twin; any other one is an opaque program.
"""

from __future__ import annotations

import importlib.util
import stat
import struct
import sys
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from hal.trust import digest_of, path_inside, trusted_program
from sim_devices.physics.effect import Array
from tools.errors import RecordingError
from tools.guest.host import GuestError, GuestProcess
from tools.mismatch.recording import Recording
from tools.mismatch.twins.holds import STRAIGHT_OR_HELD, common_hold, read_holds
from tools.mismatch.twins.opaque import OpaqueTwin, opaque_twin

OWN_KEYS = ("path", "hold")
"""Keys of ``[twin.parameters]`` that are not parameters of the FMU."""
MOST_BYTES, MOST_FILES = 1 << 30, 10_000


class FmuRun:
    """Makes a free run of an FMU per call. A copy in another process starts its own process for the FMU.

    ``named_by``: the file that names the FMU, for messages; its matrices are requested with ``inputs`` and ``start``
    (parameters). Raises ``NotTrusted`` for an FMU that the user has not trusted, ``RecordingError`` for a file that
    cannot be opened as an FMU and for a run that fails, ``GuestDied`` for a crash.
    """

    def __init__(
        self, path: Path, outputs: tuple[str, ...], dt: float, named_by: Path | None = None,
        inputs: tuple[str, ...] = (), start: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
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
            "inputs": inputs,
            "start": dict(start or {}),
        }
        self.guest = GuestProcess(str(path), opening)

    def names(self) -> set[str]:
        """Return the variables of the FMU."""
        return set(self._described("names"))

    def kind(self) -> str:
        """Return ``CoSimulation`` or ``ModelExchange``."""
        return str(self._described("kind"))

    def linear(self) -> Mapping[str, Any] | None:
        """Return the matrices, states and start of a linear FMU for model exchange, else None."""
        return self._described("linear")

    def _described(self, key: str) -> Any:
        try:
            return self.guest.opened()[0][key]
        except GuestError as error:
            raise RecordingError(f"{self.path}: {error}") from error

    def __call__(self, inputs: Mapping[str, Array], parameters: Mapping[str, Any]) -> Mapping[str, Array]:
        try:
            return self.guest.run(inputs, parameters)
        except GuestError as error:
            raise RecordingError(f"{self.path}: {error}") from error


def check_archive(path: Path) -> None:
    """Check that an archive unpacks into its folder and within ``MOST_BYTES``. Raises ``RecordingError`` if not."""
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


def _check_fmpy(where: Path) -> None:
    if sys.modules.get("fmpy", ...) is None or importlib.util.find_spec("fmpy") is None:
        raise RecordingError(f"{where}: [twin] kind 'fmu' needs FMPy: install this package with its extra 'fmu'")


def opened_fmu(recording: Recording) -> tuple[Path, FmuRun]:
    """Load the FMU that ``[twin.parameters] path`` names beside the descriptor. Raises RecordingError on a fault."""
    where = f"{recording.path}: [twin.parameters]"
    name = recording.twin.parameters.get("path")
    if not isinstance(name, str):
        raise RecordingError(f"{where} path must name the .fmu file, got {name!r}")
    path = path_inside(recording.path, name)
    if not path.is_file():
        raise RecordingError(f"{where} path: {path} does not exist")
    start = {k: v for k, v in recording.twin.parameters.items() if k not in OWN_KEYS}
    read_holds(recording, STRAIGHT_OR_HELD)
    run = FmuRun(path, tuple(recording.outputs), recording.dt, recording.path, tuple(recording.inputs), start)
    known = run.names()
    lost = [s for s in (*recording.inputs, *recording.outputs, *start) if s not in known]
    if lost:
        raise RecordingError(f"{path}: no variable {', '.join(lost)} in the FMU")
    return path, run


def fmu_twin(recording: Recording) -> OpaqueTwin:
    """Return an FMU as an opaque program."""
    path, run = opened_fmu(recording)
    twin = opaque_twin(recording, run, str(path), fixed=OWN_KEYS)
    hold = common_hold(recording)
    return replace(twin, holds=dict.fromkeys(twin.inputs, hold), given={**twin.given, "hold": hold})


def with_equations(recording: Recording) -> Recording:
    """Return the recording with the state space of a linear FMU for model exchange: forces reach each of its states.

    Any other recording is returned unchanged.
    """
    if recording.twin.kind != "fmu":
        return recording
    _, run = opened_fmu(recording)
    if run.kind() == "CoSimulation":
        return recording
    found = run.linear()
    if found is None:
        return recording
    parameters = dict(found) if any(found["x0"]) else {k: v for k, v in found.items() if k != "x0"}
    parameters |= {k: v for k, v in recording.twin.parameters.items() if k == "hold"}
    return replace(recording, twin=replace(recording.twin, kind="state_space", parameters=parameters))
