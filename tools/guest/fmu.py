"""Runs an FMU in the process of a guest, through FMPy (an extra): co-simulation (FMI 2, 3), model exchange (FMI 2)."""

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

from hal.arrays import Array
from tools.guest.fmu_linear import linear_equations, unsettled

RK_ERROR = 1e-6
"""Largest change of an output, as a share of its range, by which half the step may differ."""
MOST_RK_STEPS = 64


class FmuError(ValueError):
    """The FMU cannot be opened, or stopped in a run."""


class OpenFmu:
    """Makes one free run per call. Only content whose ``digest`` (sha256) the user has trusted is opened.

    The parameter ``hold`` says what inputs do between their samples: "linear", else held. A co-simulation holds them
    over a step; in place of linear ones it takes two steps from sample to sample (``over_the_step``), or one with their
    mean where it refuses half steps. "end": what is set before a step is the sample at its end, for an FMU that knows
    what came before (those that ``micron mismatch apply`` writes).
    """

    def __init__(self, path: Path, digest: str, outputs: tuple[str, ...], dt: float) -> None:
        self.outputs, self.dt = outputs, dt
        self.rk_steps = 0  # steps from sample to sample of a model exchange; 0 until a first run
        self.parts = 2  # communication steps from sample to sample when inputs are linear
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
        """Return a new instance."""
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
        if self.kind == "ModelExchange":
            self.instance.reset()
            return self.integrated(inputs, start, hold)
        run = self.stepped if plain and str(self.description.fmiVersion).startswith("2") else self.simulated
        try:
            self.instance.reset()
            if hold == "linear" and self.parts > 1:
                try:
                    return run(inputs, start, hold, self.parts)
                except Exception:
                    self.instance.reset()
                    found = run(inputs, start, hold)
                    self.parts = 1
                    return found
            return run(inputs, start, hold)
        except Exception as error:
            raise FmuError(f"the FMU stopped ({_line(error)}); parameters {dict(parameters)}") from error

    def stepped(
        self, inputs: Mapping[str, Array], start: Mapping[str, Any], hold: str = "", parts: int = 1
    ) -> dict[str, Array]:
        """Simulate FMI 2 with real variables only, as FMPy's ``simulate_fmu`` does, at a third of its cost per step."""
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
        over = over_the_step(at, parts) if linear else (at[1:] if hold == "end" else at)[None]
        rows, held, h = at.tolist(), over.tolist(), self.dt / len(over)
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
                for i, part in enumerate(held):
                    sent[:] = part[k]
                    fmu.fmi2SetReal(c, to, n_in, sent)
                    fmu.fmi2DoStep(c, t[k] + i * h, h, 1)
                if linear:
                    # an output that its input reaches at once is read at the instant of the sample
                    sent[:] = rows[k + 1]
                    fmu.fmi2SetReal(c, to, n_in, sent)
        return {o: found[:, i] for i, o in enumerate(self.outputs)}

    def integrated(self, inputs: Mapping[str, Array], start: Mapping[str, Any], hold: str) -> dict[str, Array]:
        """Integrate an FMU for model exchange; the first run finds the steps per sample that its equations need.

        FMPy's own integration holds continuous inputs over a step and looks through all events at each step.
        """
        self.check_integrable(inputs, start)
        try:
            if self.rk_steps:
                return self.rk4(inputs, start, hold, self.rk_steps)
            found, n = self.rk4(inputs, start, hold, 1), 1
            while n < MOST_RK_STEPS:
                self.instance.reset()
                finer, n = self.rk4(inputs, start, hold, 2 * n), 2 * n
                off = max(
                    float(np.max(np.abs(finer[o] - found[o]))) / max(float(np.ptp(finer[o])), 1e-300) for o in found
                )
                if off < RK_ERROR:
                    self.rk_steps = n
                    return finer
                found = finer
        except FmuError:
            raise
        except Exception as error:
            raise FmuError(f"the FMU stopped ({_line(error)})") from error
        raise FmuError(
            f"its equations need more than {MOST_RK_STEPS} steps from sample to sample: export for co-simulation"
        )

    def check_integrable(self, inputs: Mapping[str, Array], start: Mapping[str, Any]) -> None:
        """Raise FmuError for events and for variables that are not real."""
        kind = {v.name: v.type for v in self.description.modelVariables}
        if self.description.numberOfEventIndicators:
            raise FmuError(
                "it is for model exchange and has events, which are not searched for: export for co-simulation"
            )
        other = [s for s in (*_signals(inputs), *self.outputs, *start) if kind.get(s) != "Real"]
        if other:
            raise FmuError(f"it is for model exchange, and {other[0]} is not a real variable: export for co-simulation")

    def rk4(self, inputs: Mapping[str, Array], start: Mapping[str, Any], hold: str, steps: int) -> dict[str, Array]:
        """Integrate by the classical method of Runge and Kutta (Hairer, Norsett, Wanner 1993, table II.1.2).

        ``steps``: number from sample to sample, over which inputs run straight ("linear") or are held.
        """
        fmu, signals = self.instance, _signals(inputs)
        number = {v.name: int(v.valueReference) for v in self.description.modelVariables}
        fmu.setupExperiment(startTime=float(inputs["t"][0]))
        fmu.setReal([number[k] for k in start], [float(v) for v in start.values()])
        to, of = [number[s] for s in signals], [number[o] for o in self.outputs]
        u = np.column_stack([inputs[s] for s in signals])
        fmu.enterInitializationMode()
        fmu.setReal(to, u[0].tolist())
        fmu.exitInitializationMode()
        if reason := unsettled(fmu):
            raise FmuError(f"{reason}: export for co-simulation")
        fmu.enterContinuousTimeMode()
        n_x = int(self.description.numberOfContinuousStates)
        at, rates = (ctypes.c_double * n_x)(), (ctypes.c_double * n_x)()
        fmu.getContinuousStates(at, n_x)
        x, h = np.array(at), self.dt / steps
        found = np.empty((u.shape[0], len(of)))

        def slope(t: float, y: Array, v: Array) -> Array:
            fmu.setTime(t)
            at[:] = y.tolist()
            fmu.setContinuousStates(at, n_x)
            fmu.setReal(to, v.tolist())
            fmu.getDerivatives(rates, n_x)
            return np.array(rates)

        with np.errstate(all="ignore"):
            for k, t in enumerate(inputs["t"].tolist()):
                slope(t, x, u[k])
                found[k] = fmu.getReal(of)
                rise = (u[k + 1] - u[k]) / steps if hold == "linear" and k + 1 < len(u) else np.zeros(len(to))
                for i in range(steps if k + 1 < len(u) else 0):
                    now, begin = t + i * h, u[k] + i * rise
                    k1 = slope(now, x, begin)
                    k2 = slope(now + 0.5 * h, x + 0.5 * h * k1, begin + 0.5 * rise)
                    k3 = slope(now + 0.5 * h, x + 0.5 * h * k2, begin + 0.5 * rise)
                    k4 = slope(now + h, x + h * k3, begin + rise)
                    x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return {o: found[:, i] for i, o in enumerate(self.outputs)}

    def simulated(
        self, inputs: Mapping[str, Array], start: Mapping[str, Any], hold: str = "", parts: int = 1
    ) -> dict[str, Array]:
        """Simulate any other FMU by FMPy itself."""
        fm = _fmpy()
        t, signals = inputs["t"], _signals(inputs)
        table = np.zeros(t.size * parts, [("time", float), *((s, float) for s in signals)])
        table["time"] = np.ravel(t[:, None] + np.arange(parts) * (self.dt / parts))
        for s in signals:
            table[s] = np.ravel(over_the_step(inputs[s], parts).T) if hold == "linear" else inputs[s]
        result = fm.simulate_fmu(
            self.folder,
            model_description=self.description,
            fmu_instance=self.instance,
            start_time=float(t[0]),
            stop_time=float(t[-1]),
            output_interval=self.dt / parts,
            start_values=dict(start),
            input=table,
            output=list(self.outputs),
        )
        return {o: np.interp(t, result["time"], result[o]) for o in self.outputs}


def over_the_step(x: Array, parts: int = 1) -> Array:
    """Return the held values of a linear input (n, ...) over each of 1 or 2 ``parts`` of the step behind each sample:
    (parts, n, ...); behind the last sample it stays.

    One part holds the mean. Two hold what has the mean and the first moment of the line, so that the first and the
    second integral of the input are exact at the samples: a mean alone leaves a motor's angle off by 1/12 of the
    step's square times its acceleration.
    """
    last = np.concatenate([x[1:], x[-1:]])
    if parts == 1:
        return (0.5 * (x + last))[None]
    return np.stack([(5.0 * x + last) / 6.0, (x + 5.0 * last) / 6.0])


def _signals(inputs: Mapping[str, Array]) -> list[str]:
    return [s for s in inputs if s != "t"]


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _fmpy() -> Any:
    import fmpy  # pyright: ignore[reportMissingImports]

    return cast(Any, fmpy)
