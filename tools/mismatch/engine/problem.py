"""Represents a recording under diagnosis: twin, split, views and the noise that scales residuals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from sim_devices.physics.statistics import after_jumps
from tools.mismatch.engine.noise import NoiseFloor, spectral_floor
from tools.mismatch.engine.split import Span, Split
from tools.mismatch.placed import Placed
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View
from tools.mismatch.twins.base import Twin


@dataclass(frozen=True)
class Hint:
    """Holds the fit of an effect at a place on a part of the recording: parameters of the ``base`` and ``own`` ones."""

    placed: Placed
    base: Array
    own: tuple[Array, Array]


@dataclass(frozen=True)
class Problem:
    """Holds the data that all steps of a diagnosis share.

    ``view`` covers fit and held-out samples, ``fit_view`` the fit alone: only the latter is used to choose settings,
    starting points or parameters. ``settle``: the start state of a linear run is fitted to all samples of the fit, as a
    parameter; otherwise it is the engineer's, or the first samples set it. ``afresh``: the start states of every
    stretch, held-out ones too, are fitted to all its samples. ``hints`` are starts from a part of the recording, in
    addition to those that the whole suggests. ``imitated`` are the labels of places at which an effect is nothing but
    the twin's own parameters.
    """

    recording: Recording
    twin: Twin
    split: Split
    init: int
    seed: int
    floors: Mapping[str, NoiseFloor] = field(default_factory=dict[str, NoiseFloor])
    settle: bool = False
    afresh: bool = False
    hints: tuple[Hint, ...] = ()
    imitated: frozenset[str] = frozenset()

    def __getstate__(self) -> dict[str, object]:
        """Return the fields alone: derived values (and the caches of views) are rebuilt in a worker process."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)

    @cached_property
    def view(self) -> View:
        ranges = tuple(sorted({*self.split.fit, *_with_init(self.split.held_out, self.init, self.twin, self.split)}))
        return View(self.recording, ranges, self.init, fit=self.split.fit if self.settle else (), afresh=self.afresh)

    @cached_property
    def fit_view(self) -> View:
        fit = self.split.fit
        return View(self.recording, fit, self.init, fit=fit if self.settle else (), afresh=self.afresh)

    @cached_property
    def index(self) -> NDArray[np.int64]:
        return self.view.index

    @cached_property
    def fit_rows(self) -> NDArray[np.int64]:
        """Return the rows of the view that may be fitted."""
        mask = self.split.fit_mask()[self.index] & self.view.scored(self.twin)
        return np.nonzero(mask)[0]

    @cached_property
    def held_rows(self) -> NDArray[np.int64]:
        mask = self.split.held_out_mask()[self.index] & self.view.scored(self.twin)
        return np.nonzero(mask)[0]

    @cached_property
    def row_of_sample(self) -> NDArray[np.int64]:
        """Return the row of each sample of the recording (-1: not in the view)."""
        row = np.full(self.recording.n, -1)
        row[self.index] = np.arange(self.index.size)
        return row

    def rows(self, spans: tuple[Span, ...]) -> list[Span]:
        """Return spans of samples as spans of rows of the view; spans that fall outside are left out."""
        out: list[Span] = []
        scored = self.view.scored(self.twin)
        for a, b in spans:
            inside = self.row_of_sample[a:b]
            inside = inside[inside >= 0]
            inside = inside[scored[inside]]
            if inside.size:
                out.append((int(inside[0]), int(inside[-1]) + 1))
        return out

    @cached_property
    def held_blocks(self) -> list[Span]:
        return self.rows(self.split.blocks)

    @cached_property
    def fit_blocks(self) -> list[Span]:
        return self.rows(self.split.fit_blocks)

    @cached_property
    def held_spans(self) -> list[Span]:
        return self.rows(self.split.held_out)

    @cached_property
    def fit_spans(self) -> list[Span]:
        return self.rows(self.split.fit)

    @cached_property
    def lively(self) -> NDArray[np.bool_]:
        """Return a mask of the rows shortly after a jump of an input, where a large value is a response, no outlier."""
        return after_jumps(self.recording.inputs.values(), self.recording.n)[self.index]

    @cached_property
    def measured(self) -> dict[str, Array]:
        return {o: self.view.measured(o) for o in self.twin.outputs}

    @cached_property
    def opening(self) -> Problem | None:
        """Return the problem on the first part of a long recording, if that shows most of the inputs' range and rates.

        A free run from the first sample is identical there to that of the whole.
        """
        n = self.recording.n
        signals = [*self.recording.inputs.values()]
        samples = LEAST_OPENING
        while samples <= n // 3:
            rows = int(np.searchsorted(self.index[self.fit_rows], samples))
            if rows > samples // 3 and all(_shows(x[:samples], x) for x in signals):
                return replace(self, recording=_first(self.recording, samples), split=self.split.first(samples))
            samples += samples // 3
        return None

    @cached_property
    def given(self) -> Array:
        """Return the base parameters as the engineer gave them."""
        return self.twin.start(self.recording)

    def sigma(self, output: str) -> float:
        return self.floors[output].rms if output in self.floors else 1.0

    def with_floors(self, floors: Mapping[str, NoiseFloor]) -> Problem:
        return replace(self, floors=dict(floors))

    def quieter(self, residual: Mapping[str, Array]) -> Problem:
        """Return the problem with lower noise floors where ``residual`` (m,) of a better model shows them: what is
        missing may be rough enough to look like noise. Floors that were declared or found by repetition stay.
        """
        floors = dict(self.floors)
        spans = sorted(self.held_spans, key=lambda s: s[0] - s[1])[:6]
        for o, old in self.floors.items():
            if old.method not in ("spectrum", "rest") or o not in residual:
                continue
            left = float(np.sqrt(np.mean(residual[o][self.held_rows] ** 2)))
            if old.method == "rest":
                # the output may still have moved there; what a free run leaves on other samples bounds any noise
                rms = max(left, old.step / np.sqrt(12.0))
            else:
                found = [spectral_floor(residual[o][a:b], 1 / self.recording.dt) for a, b in spans if b - a >= 128]
                sizes = [float(b - a) for a, b in spans if b - a >= 128]
                if not found:
                    continue
                rms = float(np.sqrt(np.average([f[0] ** 2 for f in found], weights=sizes)))
                if old.step > 0:
                    # readings on a grid: noise shows as the readings that fell on the other side of an edge
                    rms = max(rms, min(old.step / np.sqrt(12.0), left))
            if rms < 0.95 * old.rms:
                floors[o] = replace(old, rms=rms, white_rms=min(old.white_rms, rms))
        return self.with_floors(floors) if floors != dict(self.floors) else self

    def base(self) -> Model:
        return Model(self.twin)


LEAST_OPENING = 15_000
"""Least number of samples of the first part of a recording on which a search may begin."""


def _shows(part: Array, whole: Array) -> bool:
    """Return True if a part of a signal reaches most of its range and rate. A search ends on the whole anyway."""
    if float(np.ptp(part)) < 0.8 * float(np.ptp(whole)):
        return False
    some, every = (float(np.quantile(np.abs(np.diff(x)), 0.99)) for x in (part, whole))
    return some >= 0.8 * every


def _first(recording: Recording, samples: int) -> Recording:
    signals = {
        kind: {s: x[:samples] for s, x in getattr(recording, kind).items()} for kind in ("inputs", "outputs", "context")
    }
    return replace(recording, t=recording.t[:samples], segments=recording.segments_of(0, samples), parts=(), **signals)


def spread(rows: NDArray[np.int64], most: int, seed: int) -> NDArray[np.int64]:
    """Select at most ``most`` of ``rows``, evenly spread but at irregular distances.

    A regular stride would alias lines of the spectrum onto others.
    """
    if rows.size <= most:
        return rows
    edges = np.linspace(0, rows.size, most + 1).astype(np.int64)
    inside = np.random.default_rng([seed, rows.size, most]).random(most) * np.diff(edges)
    return rows[edges[:-1] + inside.astype(np.int64)]


def _with_init(held: tuple[Span, ...], init: int, twin: Twin, split: Split) -> tuple[Span, ...]:
    """Return the held-out spans with the samples in front that set the state (their outputs are not scored)."""
    if init <= 0 or split.own or not twin.restart:
        return held
    return tuple((max(0, a - init), b) for a, b in held)
