"""An FMI 2 or 3 co-simulation FMU as a twin, through FMPy (an extra)."""

from __future__ import annotations

import ctypes
import shutil
import stat
import struct
import weakref
import zipfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any, cast

import numpy as np

from sim_devices.physics.effect import Array
from tools.mismatch.recording import Recording, RecordingError
from tools.mismatch.twins.opaque import OpaqueTwin, opaque_twin

MOST_BYTES, MOST_FILES = 1 << 30, 10_000


class FmuRun:
    """One free run per call. The unpacked FMU and its instance belong to one process; a copy unpacks its own.

    RecordingError for a file that is no co-simulation FMU, and for a run that fails.
    """

    def __init__(self, path: Path, inputs: tuple[str, ...], outputs: tuple[str, ...], dt: float) -> None:
        self.path, self.inputs, self.outputs, self.dt = path, inputs, outputs, dt
        self._open: tuple[Any, str, Any] | None = None

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_open": None}

    def names(self) -> set[str]:
        """Variables of the FMU."""
        return {v.name for v in self._opened()[0].modelVariables}

    def _opened(self) -> tuple[Any, str, Any]:
        if self._open is None:
            fm = _fmpy(self.path)
            check_archive(self.path)
            try:
                description = fm.read_model_description(str(self.path))
                if description.coSimulation is None:
                    raise RecordingError(f"{self.path}: not a co-simulation FMU; export it again for co-simulation")
                folder = str(fm.extract(str(self.path)))
                weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
                instance = fm.instantiate_fmu(folder, description, "CoSimulation")
            except RecordingError:
                raise
            except Exception as error:
                raise RecordingError(f"{self.path}: cannot be opened as an FMU ({_line(error)})") from error
            self._open = (description, folder, instance)
        return self._open

    def __call__(self, inputs: Mapping[str, Array], parameters: Mapping[str, Any]) -> Mapping[str, Array]:
        description = self._opened()[0]
        start = {k: v for k, v in parameters.items() if k != "path"}
        kind = {v.name: v.type for v in description.modelVariables}
        plain = all(kind.get(name) == "Real" for name in (*self.inputs, *self.outputs, *start))
        try:
            self._opened()[2].reset()
            if plain and str(description.fmiVersion).startswith("2"):
                return self._stepped(inputs, start)
            return self._simulated(inputs, start)
        except Exception as error:
            raise RecordingError(
                f"{self.path}: the FMU stopped ({_line(error)}); parameters {dict(parameters)}"
            ) from error

    def _stepped(self, inputs: Mapping[str, Array], start: Mapping[str, Any]) -> dict[str, Array]:
        """FMI 2 with real variables alone: what FMPy's ``simulate_fmu`` does, at a third of its cost a step."""
        description, _, fmu = self._opened()
        number = {v.name: int(v.valueReference) for v in description.modelVariables}
        n_in, n_out = len(self.inputs), len(self.outputs)
        to = (ctypes.c_uint * n_in)(*(number[s] for s in self.inputs))
        sent = (ctypes.c_double * n_in)()
        of = (ctypes.c_uint * n_out)(*(number[o] for o in self.outputs))
        got = (ctypes.c_double * n_out)()
        rows = np.column_stack([inputs[s] for s in self.inputs]).tolist()
        t, c = inputs["t"].tolist(), fmu.component
        found = np.empty((len(t), n_out))
        fmu.setupExperiment(startTime=t[0], stopTime=t[-1])
        fmu.setReal([number[k] for k in start], [float(v) for v in start.values()])
        fmu.enterInitializationMode()
        sent[:] = rows[0]
        fmu.fmi2SetReal(c, to, n_in, sent)
        fmu.exitInitializationMode()
        for k, row in enumerate(rows):
            fmu.fmi2GetReal(c, of, n_out, got)
            found[k] = got
            if k + 1 < len(rows):
                sent[:] = row
                fmu.fmi2SetReal(c, to, n_in, sent)
                fmu.fmi2DoStep(c, t[k], self.dt, 1)
        return {o: found[:, i] for i, o in enumerate(self.outputs)}

    def _simulated(self, inputs: Mapping[str, Array], start: Mapping[str, Any]) -> dict[str, Array]:
        """Any other FMU, by FMPy itself."""
        fm = _fmpy(self.path)
        description, folder, instance = self._opened()
        t = inputs["t"]
        table = np.zeros(t.size, [("time", float), *((s, float) for s in self.inputs)])
        table["time"] = t
        for s in self.inputs:
            table[s] = inputs[s]
        result = fm.simulate_fmu(
            folder,
            model_description=description,
            fmu_instance=instance,
            start_time=float(t[0]),
            stop_time=float(t[-1]),
            output_interval=self.dt,
            start_values=dict(start),
            input=table,
            output=list(self.outputs),
        )
        return {o: np.interp(t, result["time"], result[o]) for o in self.outputs}


def check_archive(path: Path) -> None:
    """An archive that stays in its folder and within ``MOST_BYTES`` when it is unpacked; ``RecordingError`` if not."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError, struct.error) as error:
        raise RecordingError(f"{path}: cannot be opened as an FMU ({_line(error)})") from error
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


def _fmpy(where: Path) -> Any:
    try:
        import fmpy  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise RecordingError(
            f"{where}: [twin] kind 'fmu' needs FMPy: install this package with its extra 'fmu'"
        ) from None
    return cast(Any, fmpy)


def fmu_twin(recording: Recording) -> OpaqueTwin:
    """An FMI 2 or 3 co-simulation FMU; ``[twin.parameters] path`` names it beside the descriptor."""
    where = f"{recording.path}: [twin.parameters]"
    name = recording.twin.parameters.get("path")
    if not isinstance(name, str):
        raise RecordingError(f"{where} path must name the .fmu file, got {name!r}")
    path = (recording.path.parent / name).resolve()
    if not path.is_file():
        raise RecordingError(f"{where} path: {path} does not exist")
    run = FmuRun(path, tuple(recording.inputs), tuple(recording.outputs), recording.dt)
    known = run.names()
    lost = [s for s in (*recording.inputs, *recording.outputs) if s not in known]
    lost += [k for k in recording.twin.parameters if k != "path" and k not in known]
    if lost:
        raise RecordingError(f"{path}: no variable {', '.join(lost)} in the FMU")
    return opaque_twin(recording, run, str(path), fixed=("path",))
