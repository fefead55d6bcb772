"""Requests of the Calibrate view: poses by hand, the emulated rotary stage and interferometer, apply, discard."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import numpy as np
from starlette.requests import Request
from starlette.routing import BaseRoute, Route

from hal.types import STANDARD_GRAVITY
from tools.bench.applied import Applied
from tools.bench.history import BLOCK
from tools.bench.jobs import Jobs
from tools.bench.poses import at_nominal_supply, identify
from tools.bench.requests import body, clear, text
from tools.bench.session import Session
from tools.calibrate.calibration_file import calibration_toml
from tools.calibrate.still import warm_up
from tools.errors import InputError
from tools.output import write_text_atomic

TEMPERATURE_TOLERANCE_K = 0.2
WARM_UP_ROWS = 600_000


class Calibration:
    """Holds an identified calibration that is not yet applied."""

    def __init__(self, session: Session, jobs: Jobs, applied: Applied) -> None:
        self._session = session
        self._jobs = jobs
        self._applied = applied
        self._folder = session.recorder.folder / "calibrations"
        self.identified: dict[str, Any] | None = None
        self._file: Path | None = None

    async def poses(self, request: Request) -> Any:
        """Fit the poses that the page collected."""
        table = await body(request)
        try:
            means = np.array(table["means_V"], dtype=np.float64)
        except (KeyError, TypeError, ValueError):
            raise InputError("means_V must be rows of nine voltages: eight inputs and the supply") from None
        sensing = json.loads(self._session.metadata().get("stages", "{}")).get("sensing", {})
        gravity = float(sensing.get("gravity_m_s2", STANDARD_GRAVITY))
        result = await asyncio.to_thread(identify, at_nominal_supply(means, sensing), gravity)
        stages = {"sensing": result["table"]}
        self._keep("poses", calibration_toml("sensors, poses by hand", "micron bench", stages), result)
        return result

    async def lab(self, request: Request) -> Any:
        """Measure with the emulated rotary stage or interferometer and identify, in a process of its own."""
        what = text(await body(request), "what")
        if not self._session.bench.description.emulated_buses():
            raise InputError("this bench is real, so are its stage and interferometer: see 'micron calibrate --help'")
        folder = self._jobs.new_folder()
        bench = str(self._session.choice.bench)
        lab = "sim_devices.plant.lab"
        if what == "piezo":
            stacks = [str(folder / f"stack{i}") for i in range(3)]
            steps = [
                [lab, "piezo", "--bench", bench, "--axis", str(i), "--profile", "loops", "--out", stack]
                for i, stack in enumerate(stacks)
            ]
            names = (*stacks, "--out", str(folder / "piezo.toml"), "--json", str(folder / "result.json"))
            steps.append(["tools.cli.main", "calibrate", "piezo", *names])
        elif what == "tumble":
            tumble = str(folder / "tumble")
            names = (tumble, "--out", str(folder / "sensors.toml"), "--json", str(folder / "result.json"))
            steps = [
                [lab, "tumble", "--bench", bench, "--out", tumble],
                ["tools.cli.main", "calibrate", "sensors", *names],
            ]
        else:
            raise InputError(f"{what!r} is not a measurement; there are piezo and tumble")
        return self._jobs.start("calibrate", f"{what} on the emulated lab", steps, folder).as_dict()

    async def warmth(self, _: Request) -> Any:
        """Temperature since the start, and whether it has settled."""
        history = self._session.history
        column = np.array([history.layout.start("temperature")])
        k = BLOCK * 16
        buckets = history.buckets(column, k, max(0, history.head - WARM_UP_ROWS) // k)
        t, value = buckets.t_s, 0.5 * (buckets.low[0] + buckets.high[0]).astype(np.float64)
        good = t > 2.0  # the smoothing has settled
        t, value = t[good], value[good]
        if len(t) < 30:
            return {"t": t.tolist(), "temperature": value.tolist(), "text": "watching: a verdict needs ten seconds"}
        warm = await asyncio.to_thread(warm_up, t, value, TEMPERATURE_TOLERANCE_K)
        last = "steady" if warm.steady else "still warming up"
        return {
            "t": t.tolist(),
            "temperature": value.tolist(),
            "steady": warm.steady,
            "text": f"{last}: {warm.remaining:+.2f} K to come, {warm.tolerance:g} K allowed",
        }

    async def apply(self, request: Request) -> Any:
        """Start the firmware again with the new calibration over the old ones."""
        kind = text(await body(request), "kind")
        if kind == "poses":
            if self._file is None:
                raise InputError("no poses were identified yet")
            source = self._file
        else:
            name = "piezo.toml" if kind == "piezo" else "sensors.toml"
            source = self._jobs.file("calibrate", name)
        return {"bench": str(await self._applied.calibration(kind, source.read_text(encoding="utf-8")))}

    async def discard(self, _: Request) -> Any:
        """Forget what was found; back to the original bench if something was applied."""
        self.identified, self._file = None, None
        await self._applied.discard()

    def _keep(self, kind: str, toml: str, result: dict[str, Any]) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._file = self._folder / f"{kind}.found.toml"
        write_text_atomic(self._file, toml)
        self.identified = result

    async def state(self, _: Request) -> Any:
        return {"job": self._jobs.state("calibrate"), "applied": self._applied.what, "found": self.identified}


def calibrate_routes(session: Session, jobs: Jobs, applied: Applied) -> list[BaseRoute]:
    c = Calibration(session, jobs, applied)
    return [
        Route("/api/calibrate", clear(c.state)),
        Route("/api/calibrate/warmth", clear(c.warmth)),
        Route("/api/calibrate/poses", clear(c.poses), methods=["POST"]),
        Route("/api/calibrate/lab", clear(c.lab), methods=["POST"]),
        Route("/api/calibrate/apply", clear(c.apply), methods=["POST"]),
        Route("/api/calibrate/discard", clear(c.discard), methods=["POST"]),
    ]
