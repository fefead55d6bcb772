"""An FMU in the process of a guest, through FMPy (an extra): co-simulation (FMI 2, 3) or model exchange (FMI 2)."""

from __future__ import annotations

import ctypes
import hashlib
import shutil
import tempfile
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from tools.guest.fmu_linear import linear_equations

Array = NDArray[np.float64]


class FmuError(ValueError):
    """The FMU cannot be opened, or stopped in a run."""


class OpenFmu:
    """One free run per call. ``digest`` (sha256) says which content the user has trusted; no other is opened.

    The parameter ``hold`` says what inputs do between their samples: "linear", else held. A co-simulation
    holds them over a step; in place of linear ones it gets their mean over that step. "end": what is set before a
    step is the sample at its end, for an FMU that knows what came before (those that ``micron mismatch apply`` writes).
    """

    def __init__(self, path: Path, digest: str, outputs: tuple[str, ...], dt: float) -> None:
        self.outputs, self.dt = outputs, dt
        data = path.read_bytes()
        if hashlib.sha256(data).hexdigest() != digest:
            raise FmuError("the file changed since it was trusted")
        fm = _fmpy()
        folder = tempfile.mkdtemp(prefix="micron-fmu-")
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        copy = Path(folder) / "model.fmu"
        copy.write_bytes(data)
        try:
            self.description: Any = fm.read_model_description(str(copy))
            self.kind = "CoSimulation" if self.description.coSimulation is not None else "ModelExchange"
            if self.kind == "ModelExchange" and not str(self.description.fmiVersion).startswith("2"):
                raise FmuError("an FMI 3 FMU for model exchange is not read; export it for co-simulation, or by FMI 2")
            self.folder = str(fm.extract(str(copy), str(Path(folder) / "unpacked")))
            self.instance: Any = self.instantiated()
        except FmuError:
            raise
        except Exception as error:
            raise FmuError(f"cannot be opened as an FMU ({_line(error)})") from error

    def instantiated(self) -> Any:
        """A new instance."""
        return _fmpy().instantiate_fmu(self.folder, self.description, self.kind)

    def names(self) -> set[str]:
        """Return the variables of the FMU."""
        return {v.name for v in self.description.modelVariables}

    def linear(self, inputs: list[str], start: Mapping[str, Any]) -> dict[str, Any] | None:
        """The matrices of an FMU for model exchange whose equations are linear; else None."""
        if self.kind != "ModelExchange" or not {*inputs, *start, *self.outputs} <= self.names():
            return None
        try:
            return linear_equations(self.instantiated(), self.description, inputs, list(self.outputs), start)
        except Exception as error:
            raise FmuError(f"the FMU stopped when its derivatives were asked for ({_line(error)})") from error

    def __call__(self, inputs: Mapping[str, Array], parameters: Mapping[str, Any]) -> Mapping[str, Array]:
        start = {k: v for k, v in parameters.items() if k not in ("path", "hold")}
        hold = str(parameters.get("hold", ""))
        kind = {v.name: v.type for v in self.description.modelVariables}
        read = _signals(inputs)
        plain = all(kind.get(name) == "Real" for name in (*read, *self.outputs, *start))
        try:
            self.instance.reset()
            if plain and str(self.description.fmiVersion).startswith("2"):
                return self.stepped(inputs, start, hold)
            return self.simulated(inputs, start, hold == "linear")
        except Exception as error:
            raise FmuError(f"the FMU stopped ({_line(error)}); parameters {dict(parameters)}") from error

    def stepped(self, inputs: Mapping[str, Array], start: Mapping[str, Any], hold: str = "") -> dict[str, Array]:
        """FMI 2 with real variables alone: what FMPy's ``simulate_fmu`` does, at a third of its cost a step."""
        description, fmu = self.description, self.instance
        signals = _signals(inputs)
        number = {v.name: int(v.valueReference) for v in description.modelVariables}
        n_in, n_out = len(signals), len(self.outputs)
        to = (ctypes.c_uint * n_in)(*(number[s] for s in signals))
        sent = (ctypes.c_double * n_in)()
        of = (ctypes.c_uint * n_out)(*(number[o] for o in self.outputs))
        got = (ctypes.c_double * n_out)()
        at = np.column_stack([inputs[s] for s in signals])
        linear = hold == "linear"
        rows, over = at.tolist(), (over_the_step(at) if linear else at[1:] if hold == "end" else at).tolist()
        t, c = inputs["t"].tolist(), fmu.component
        found = np.empty((len(t), n_out))
        fmu.setupExperiment(startTime=t[0], stopTime=t[-1])
        fmu.setReal([number[k] for k in start], [float(v) for v in start.values()])
        fmu.enterInitializationMode()
        sent[:] = rows[0]
        fmu.fmi2SetReal(c, to, n_in, sent)
        fmu.exitInitializationMode()
        for k in range(len(rows)):
            fmu.fmi2GetReal(c, of, n_out, got)
            found[k] = got
            if k + 1 < len(rows):
                sent[:] = over[k]
                fmu.fmi2SetReal(c, to, n_in, sent)
                fmu.fmi2DoStep(c, t[k], self.dt, 1)
                if linear:
                    # an output that its input reaches at once is read at the instant of the sample
                    sent[:] = rows[k + 1]
                    fmu.fmi2SetReal(c, to, n_in, sent)
        return {o: found[:, i] for i, o in enumerate(self.outputs)}

    def simulated(
        self, inputs: Mapping[str, Array], start: Mapping[str, Any], linear: bool = False
    ) -> dict[str, Array]:
        """Any other FMU, by FMPy itself."""
        fm = _fmpy()
        t, signals = inputs["t"], _signals(inputs)
        table = np.zeros(t.size, [("time", float), *((s, float) for s in signals)])
        table["time"] = t
        for s in signals:
            table[s] = over_the_step(inputs[s]) if linear else inputs[s]
        result = fm.simulate_fmu(
            self.folder,
            model_description=self.description,
            fmu_instance=self.instance,
            start_time=float(t[0]),
            stop_time=float(t[-1]),
            output_interval=self.dt,
            start_values=dict(start),
            input=table,
            output=list(self.outputs),
        )
        return {o: np.interp(t, result["time"], result[o]) for o in self.outputs}


def over_the_step(x: Array) -> Array:
    """The mean of a linear input (n, ...) over the step behind each sample; behind the last it stays."""
    return np.concatenate([0.5 * (x[:-1] + x[1:]), x[-1:]])


def _signals(inputs: Mapping[str, Array]) -> list[str]:
    return [s for s in inputs if s != "t"]


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _fmpy() -> Any:
    import fmpy  # pyright: ignore[reportMissingImports]

    return cast(Any, fmpy)
