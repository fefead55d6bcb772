"""Runs a twin beside an instrument: it takes rows of the frame as they come and returns its residual on them.

A twin of a whole bench with its own hand runs on without an end. Every other twin runs freely over the newest rows and
``LEAD_S`` before them, anew each time: the influence of its start state decays, and the rest of it is part of the
reference residual as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from firmware_py.frame import VOLTS
from hal.bench import BenchFile
from sim_devices.config import EmulationConfig
from sim_devices.plant.hand import holding_frame
from sim_devices.plant.instrument import Instrument
from sim_devices.plant.recorded_hand import make_hand
from tools.errors import InputError
from tools.mismatch import units
from tools.mismatch.export.run import whole_view
from tools.mismatch.recording import Array, Recording
from tools.mismatch.recording_load import descriptor, from_table, load_twin
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_text import restore
from tools.mismatch.twins.instrument import GivenHand, bench_world
from tools.mismatch.twins.opaque import OpaqueTwin

LEAD_S = 4.0
"""Time before the newest rows over which a twin with states runs until its start state has decayed."""
HOP_S = 1.0
"""Time of new rows that are simulated at once."""
PLACEHOLDERS = 64
"""Number of samples of the synthetic columns by which the twin is checked before anything runs."""
STANDARD = {"instrument": [("command", "V", "input", ("1", "2", "3")), ("volts", "V", "output", tuple("012345"))]}
"""Default channels of a twin file: quantity of the frame, unit, role, parts. Supply and temperature (6 and 7) belong to
the room, whose wander no twin models."""
SUPPLY = 6
"""DAQ input with a fraction of the accelerometers' supply, to which their readings are proportional."""


@dataclass(frozen=True)
class World:
    """Describes the motion of an emulated instrument that its bench file does not define and the twin needs."""

    seed: int | None = None
    hand_file: str | None = None
    hand_scale: float | None = None


class LiveTwin:
    """Computes the residual of a twin on rows of the frame. ``outputs`` are its channels, ``unit`` their units."""

    def __init__(self, template: Recording, columns: Mapping[str, int], course: BenchCourse | None) -> None:
        """Use ``open_twin``."""
        self.template, self._columns, self._course = template, columns, course
        self.outputs = tuple(template.outputs)
        self.unit: Mapping[str, str] = template.unit
        self.dt = template.dt
        self._is_bare = course is not None and not template.twin.effects
        self._lead = 0 if self._is_bare else round(LEAD_S / self.dt)
        self._hop = 1 if self._is_bare else round(HOP_S / self.dt)
        self._rows: Array = np.zeros((0, 0))
        self._base: Array = np.zeros((0, len(self.outputs)))
        self._done = 0

    @property
    def needs_bench_time(self) -> bool:
        """Return True if the twin needs the time that the emulated world had run before the run (``begin_at``)."""
        return self._course is not None

    @property
    def start_s(self) -> float:
        """Return the time in s that the emulated world had run when the run began."""
        return self._course.start_s if self._course is not None else 0.0

    def begin_at(self, start_s: float) -> None:
        """Set the time that the world had run when the run began to ``start_s``."""
        if self._course is not None:
            self._course.start_s = start_s

    def restart(self) -> None:
        """Forget the rows before a gap."""
        self._rows, self._base, self._done = np.zeros((0, 0)), self._base[:0], 0

    def advance(self, t_s: Array, rows: Array) -> Array:
        """Take ``rows`` (n, columns of the frame) at ``t_s`` (n,) and return residuals (k, outputs) of the due rows.

        Residuals are measured less simulated, in the order of the rows.
        """
        if self._course is not None:
            base = self._course.advance(t_s, rows)
            if self._is_bare:
                measured = self._signals(rows, self.template.outputs)
                return np.column_stack([measured[o] - base[o] for o in self.outputs])
            self._base = np.concatenate([self._base, np.column_stack([base[o] for o in self.outputs])])
        self._rows = np.concatenate([self._rows.reshape(-1, rows.shape[1]), rows])
        if self._rows.shape[0] - self._done < self._hop or self._rows.shape[0] <= self._lead:
            return np.zeros((0, len(self.outputs)))
        left = self._run()[max(self._done, self._lead) :]
        kept = min(self._lead, self._rows.shape[0])
        self._rows, self._base = self._rows[-kept:] if kept else self._rows[:0], self._base[-kept:]
        self._done = kept
        return left

    def _run(self) -> Array:
        """Return the residual (n, outputs) of one free run over all rows that are kept."""
        n = self._rows.shape[0]
        course = replace(
            self.template,
            t=np.asarray(np.arange(n) * self.dt, np.float64),
            inputs=self._signals(self._rows, self.template.inputs),
            outputs=self._signals(self._rows, self.template.outputs),
            context=self._signals(self._rows, self.template.context),
        )
        model, theta = restore(course)
        if self._course is not None:
            stored = {o: self._base[:, i] for i, o in enumerate(self.outputs)}
            model = Model(replace(cast("OpaqueTwin", model.twin), call=lambda _i, _p: stored), model.placed)
        with np.errstate(all="ignore"):
            found = model.simulate(whole_view(course, model), theta)
        return np.column_stack([course.outputs[o] - found[o] for o in self.outputs])

    def _signals(self, rows: Array, signals: Mapping[str, Array]) -> dict[str, Array]:
        rec = self.template
        return {s: units.convert(rows[:, self._columns[s]], rec.file_unit[s], rec.unit[s]) for s in signals}


class BenchCourse:
    """Runs the noiseless emulated bench of an ``instrument`` twin on from call to call.

    Accelerometers get the measured supply instead of the twin's. Commands are omitted: they move the tip, which
    no channel of the frame measures.
    """

    def __init__(self, config: EmulationConfig, own_hand: bool, world: World, unit: Mapping[str, str]) -> None:
        seed = config.seed if world.seed is None else world.seed
        at_rest = GivenHand(holding_frame(config.hand), np.array([0.0, 1.0]), np.zeros((2, 6)))
        hand = make_hand(config.hand, seed, world.hand_file, world.hand_scale) if own_hand else at_rest
        # the truth of the tip is not used, so little of it is kept
        config = config.model_copy(update={"truth_s": 1.0})
        self._instrument = Instrument(config, seed, hand, unit=config.unit, quiet=True)
        self._unit = {o: (int(o.rpartition("_")[2]), u) for o, u in unit.items() if o.startswith("volts_")}
        self.start_s = 0.0

    def advance(self, t_s: Array, rows: Array) -> dict[str, Array]:
        """Return outputs (n,) at ``t_s`` (n,), which does not decrease, beside ``rows`` of the frame."""
        volts = np.empty((t_s.size, 8))
        for k, t_ns in enumerate(np.round((t_s + self.start_s) * 1e9).astype(np.int64).tolist()):
            self._instrument.advance_to(t_ns)
            volts[k] = self._instrument.analog_V
        volts[:, :SUPPLY] *= (rows[:, VOLTS + SUPPLY] / volts[:, SUPPLY])[:, None]
        return {o: units.convert(volts[:, i], "V", u) for o, (i, u) in self._unit.items()}


def open_twin(path: Path, bench: BenchFile, names: Sequence[str], world: World) -> LiveTwin:
    """Open a twin beside a run of ``bench``.

    ``path`` is a file that ``micron mismatch apply`` wrote, or a ``recording.toml`` whose channels are columns of the
    frame (``names``). Raises InputError or RecordingError for any fault.
    """
    file = path / "recording.toml" if path.is_dir() else path
    if file.suffix.lower() != ".toml":
        raise InputError(f"--watch {path}: only a .toml twin runs beside an instrument; write one with mismatch apply")
    text = descriptor(file)
    channels = text.get("channels")
    if channels is None:
        kind = load_twin(file).kind
        if kind not in STANDARD:
            raise InputError(
                f"--watch {file}: does not say which columns of the frame a {kind} reads; name a recording.toml with "
                "[[channels]] of the frame and [twin]"
            )
        channels = [
            {"column": f"{q}_{p}", "role": role, "signal": f"{q}_{p}", "unit": unit}
            for q, unit, role, parts in STANDARD[kind]
            for p in parts
        ]
    wanted = (
        [str(c.get("column", "")) for c in channels if isinstance(c, Mapping)] if isinstance(channels, list) else []
    )
    unknown = [c for c in wanted if c not in names]
    if unknown:
        raise InputError(
            f"--watch {file}: no column '{unknown[0]}' in the frame of {bench.path.name}; see micron export"
        )
    wave: Array = np.sin(np.linspace(0.0, 20.0, PLACEHOLDERS))
    table: dict[str, Any] = {k: v for k, v in text.items() if k in ("format", "title", "twin")}
    table |= {"format": 1, "rate_hz": float(bench.description.clock.tick_hz), "channels": channels}
    made_up = {c: wave * (1.0 + 0.1 * i) for i, c in enumerate(wanted)}
    template = from_table(file, table, made_up, load_twin(file) if "channels" not in text else None)
    restore(template)
    course: BenchCourse | None = None
    if template.twin.kind == "instrument":
        config, own_hand, _ = bench_world(template)
        if own_hand and not bench.description.emulated_buses():
            raise InputError(
                f"--watch {file}: hand = 'bench' is the hand of an emulated bench, and {bench.path} is a real one; "
                "nothing measures how that is held"
            )
        course = BenchCourse(config, own_hand, world, {o: template.unit[o] for o in template.outputs})
    return LiveTwin(template, {s: names.index(c) for s, c in template.column.items()}, course)
