"""Splits a recording into fitted and held-out parts: contiguous segments with guard gaps, scored in many blocks."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array

Span = tuple[int, int]


@dataclass(frozen=True)
class Split:
    """Holds the spans ``fit`` and ``held_out`` of samples (stop excluded), which never touch.

    ``blocks`` cut the held-out spans, ``fit_blocks`` the fit spans, for paired comparisons. ``n`` is the number of all
    samples.
    """

    n: int
    fit: tuple[Span, ...]
    held_out: tuple[Span, ...]
    blocks: tuple[Span, ...]
    fit_blocks: tuple[Span, ...]
    own: bool = True

    def fit_mask(self) -> NDArray[np.bool_]:
        return _mask(self.n, self.fit)

    def held_out_mask(self) -> NDArray[np.bool_]:
        return _mask(self.n, self.held_out)

    def first(self, samples: int) -> Split:
        """Return the same split of the first ``samples`` alone."""

        def of(spans: tuple[Span, ...]) -> tuple[Span, ...]:
            return tuple((a, min(b, samples)) for a, b in spans if a < samples)

        return Split(samples, of(self.fit), of(self.held_out), of(self.blocks), of(self.fit_blocks), self.own)


def _mask(n: int, spans: tuple[Span, ...]) -> NDArray[np.bool_]:
    mask = np.zeros(n, bool)
    for a, b in spans:
        mask[a:b] = True
    return mask


def cut(spans: tuple[Span, ...], at_least: int) -> tuple[Span, ...]:
    """Cut spans into about equal blocks, ``at_least`` so many if their length allows (8 samples each)."""
    total = sum(b - a for a, b in spans)
    if total == 0:
        return ()
    length = max(8, total // max(at_least, 1))
    blocks: list[Span] = []
    for a, b in spans:
        parts = max(1, (b - a) // length)
        edges = np.linspace(a, b, parts + 1).astype(int)
        blocks += [(int(p), int(q)) for p, q in itertools.pairwise(edges) if q > p]
    return tuple(blocks)


def _coverage(signals: Array, held: NDArray[np.bool_], used: NDArray[np.bool_]) -> float:
    """Return the largest distance between the distributions of held-out and fitted samples over all signals.

    It is in units of its standard deviation, so that tails count as much as the middle (T. W. Anderson, D. A. Darling,
    Ann. Math. Stat. 23 (1952) 193): limits and edges are rare, and both parts must have some.
    """
    worst = 0.0
    levels = np.array([0.003, 0.01, 0.03, *np.linspace(0.05, 0.95, 19), 0.97, 0.99, 0.997])
    weight = 0.5 / np.sqrt(levels * (1 - levels))
    for x in signals.T:
        grid = np.quantile(x, levels)
        a = np.searchsorted(np.sort(x[held]), grid, side="right") / max(held.sum(), 1)
        b = np.searchsorted(np.sort(x[used]), grid, side="right") / max(used.sum(), 1)
        worst = max(worst, float(np.max(np.abs(a - b) * weight)))
    return worst


def _beyond(outputs: Array, held: NDArray[np.bool_], used: NDArray[np.bool_]) -> float:
    """Return the largest share of held-out samples of an output beyond its fitted ones.

    What a slow system did only there tests how physics extrapolates and not which physics it is.
    """
    y = outputs[held]
    far = (y < outputs[used].min(axis=0)) | (y > outputs[used].max(axis=0))
    return float(np.max(np.mean(far, axis=0)))


def own_split(
    signals: Array, outputs: Array | None = None, *, held_out: float = 0.3, seed: int = 0, guard: int = 0,
    segments: int = 6, begin: int = 0,
) -> Split:  # fmt: skip
    """Split a recording that has no split of its own.

    ``signals`` (n, k): inputs and context, whose values and rates both parts shall cover. ``outputs`` (n, m) of the
    held-out part shall be within the range of those of the other. The record is cut into
    ``segments`` stretches; each gives a contiguous held-out part with ``guard`` unused samples on either side. Samples
    before ``begin`` are not used either. Of 24 seeded layouts the one with the most similar parts is chosen.
    """
    n = signals.shape[0]
    segments = max(1, min(segments, n // 60))
    guard = min(guard, n // (20 * segments))
    rng = np.random.default_rng([seed, n])
    edges = np.linspace(0, n, segments + 1).astype(int)
    features = np.column_stack([signals, np.gradient(signals, axis=0)]) if signals.size else np.empty((n, 0))
    thin = slice(None, None, max(1, n // 20000))
    best: tuple[float, list[Span]] | None = None
    for _ in range(24):
        held: list[Span] = []
        for i in range(segments):
            length = int(held_out * (edges[i + 1] - edges[i]))
            room = edges[i + 1] - edges[i] - length
            # the first stretch of the record is never held out, because the fit needs the start
            least = min(begin + guard, room)
            least = least + (room - least) // 4 if i == 0 else 0
            start = int(edges[i] + rng.integers(least, max(room, least + 1)))
            held.append((start, start + length))
        mask = _mask(n, tuple(held))[thin]
        score = _coverage(features[thin], mask, ~mask) if features.size else 0.0
        if outputs is not None:
            used = ~mask & (np.arange(n)[thin] >= begin)
            score += _beyond(outputs[thin], mask, used)
        if best is None or score < best[0]:
            best = (score, held)
    assert best is not None
    return _with_guard(n, tuple(best[1]), guard, begin)


def _with_guard(n: int, held: tuple[Span, ...], guard: int, begin: int) -> Split:
    fit: list[Span] = []
    position = begin
    for a, b in held:
        if a - guard > position:
            fit.append((position, a - guard))
        position = b + guard
    if position < n:
        fit.append((position, n))
    fit = [s for s in fit if s[1] - s[0] >= 8]
    return Split(n, tuple(fit), held, cut(held, 30), cut(tuple(fit), 48))


def given_split(n: int, fit: Span, test: Span, *, initialization: int = 0) -> Split:
    """Return the recording's own split: its fit range, and its test range less the samples that set the state."""
    start = test[0] + max(initialization, 0)
    held = ((start, test[1]),)
    return Split(n, (fit,), held, cut(held, 30), cut((fit,), 48), own=False)


def split_of_parts(
    signals: Array, parts: Sequence[Span], *, held_out: float = 0.3, seed: int = 0, init: int = 0, skip: float = 0.0
) -> Split:
    """Return a split that holds whole recordings out: of 24 seeded choices the one with the most similar parts.

    ``signals`` (n, k); ``parts`` the samples of each recording (two at least); ``init`` samples set the start state of
    a held-out one, the share ``skip`` at the start of each is simulated and not scored.
    """
    n = signals.shape[0]
    count = min(max(1, round(held_out * len(parts))), len(parts) - 1)
    rng = np.random.default_rng([seed, n, len(parts)])
    thin = slice(None, None, max(1, n // 20000))
    best: tuple[float, set[int]] | None = None
    for _ in range(24):
        chosen = {int(i) for i in rng.choice(len(parts), count, replace=False)}
        mask = _mask(n, tuple(p for i, p in enumerate(parts) if i in chosen))[thin]
        score = _coverage(signals[thin], mask, ~mask) if signals.size else 0.0
        if best is None or score < best[0]:
            best = (score, chosen)
    assert best is not None
    return leave_out(n, parts, best[1], init=init, skip=skip)


def leave_out(n: int, parts: Sequence[Span], out: Collection[int], *, init: int = 0, skip: float = 0.0) -> Split:
    """Return the split of ``n`` samples that holds out the recordings with numbers ``out`` and fits the others."""
    spans = [(a + int(skip * (b - a)), b) for a, b in parts]
    fit = tuple(s for i, s in enumerate(spans) if i not in out)
    held = tuple((a + init, b) for i, (a, b) in enumerate(spans) if i in out)
    return Split(n, fit, held, cut(held, 30), cut(fit, 48), own=False)


def shot(split: Split, init: int, pieces: int = 24) -> Split:
    """Return the same parts in about ``pieces`` stretches each, for a twin that restarts in every stretch.

    This is multiple shooting (Bock, Springer Series in Chemical Physics 18, 1981): the free run of an integrator over a
    whole record depends more on its start than on its physics.
    """

    def stretches(spans: tuple[Span, ...], skip: int) -> tuple[Span, ...]:
        total = sum(b - a for a, b in spans)
        out: list[Span] = []
        for a, b in spans:
            parts = max(1, min(round(pieces * (b - a) / max(total, 1)), (b - a) // (6 * init + 60)))
            edges = np.linspace(a, b, parts + 1).astype(int)
            out += [(int(p) + (skip if p != a else 0), int(q)) for p, q in itertools.pairwise(edges)]
        return tuple(s for s in out if s[1] - s[0] > 2 * init + 16)

    fit, held = stretches(split.fit, 0), stretches(split.held_out, init)
    return Split(split.n, fit, held, cut(held, 30), cut(fit, 48), split.own)
