"""Locates a mismatch: outputs, windows, regime, and the recorded signal that it follows."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from hal.arrays import Array
from tools.mismatch.engine.dependence import Dependence, dependences, needs_memory
from tools.mismatch.engine.features import (
    Feature,
    alike,
    envelope,
    features_of,
    local_frequency,
    rate_of,
    standard,
)
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem
from tools.mismatch.engine.windows import bad_windows


def thinned(problem: Problem, fitted: Fit, output: str, limit: int = 40000) -> tuple[Array, dict[str, Array], float]:
    """Return residual, recorded signals and step on the view's samples, block-averaged to ``limit`` samples."""
    index = problem.index
    k = max(1, int(np.ceil(index.size / limit)))
    m = index.size // k

    def mean(x: Array) -> Array:
        return x[: m * k].reshape(m, k).mean(axis=1) if k > 1 else x

    signals = {s: mean(x[index]) for s, x in problem.recording.signals.items()}
    return mean(fitted.residual[output]), signals, problem.recording.dt * k


def tested_features(problem: Problem, fitted: Fit, output: str) -> tuple[Array, list[Feature]]:
    """Return the thinned residual (n,) of an output and all features that it may follow."""
    e, signals, dt = thinned(problem, fitted, output)
    # friction, springs and play follow a plant's own motion; a gain follows a reading that is made of several inputs
    motion = problem.measured[output] - fitted.residual[output]
    k = max(1, round(dt / problem.recording.dt))
    motion = motion[: e.size * k].reshape(e.size, k).mean(axis=1)
    if not problem.twin.static or not any(
        alike(standard(motion), standard(signals[i])) for i in problem.twin.inputs if i in signals
    ):
        signals[output] = motion
    return e, features_of(signals, dt, drive=problem.twin.drive(output), motion=output)


def follow(problem: Problem, fitted: Fit, output: str) -> tuple[list[Dependence], float]:
    """Return the features that the residual of an output follows, strongest first, and the p-value of no memory.

    Both the mean and the size of the residual are tested: the mean of bursts follows nothing, but their size may.
    """
    e, features = tested_features(problem, fitted, output)
    found = dependences(e, features)
    present = [f for f in features if not f.memory and f.kind in ("value", "rate")]
    past = [f for f in features if f.memory and f.kind in ("running extremum", "recent history", "amplitude")]
    return found, needs_memory(e, present, past)


def follow_size(problem: Problem, fitted: Fit, output: str) -> list[Dependence]:
    """Return the features that the size of the residual follows (logarithm, floored at the noise), strongest first."""
    e, signals, dt = thinned(problem, fitted, output)
    size = np.log(e**2 + (0.5 * problem.sigma(output)) ** 2)
    features = [f for f in features_of(signals, dt, pairs=False) if f.kind in ("value", "rate", "amplitude")]
    return dependences(size - size.mean(), features)


def regime(problem: Problem, fitted: Fit, output: str) -> str:
    """Return in words where the residual is worst: the regime variable whose upper and lower parts differ most."""
    e, signals, dt = thinned(problem, fitted, output)
    blocks = max(2, min(120, max(12, e.size // 50), e.size // 4))
    edges = np.linspace(0, e.size, blocks + 1).astype(int)

    def per_block(x: Array) -> Array:
        return np.array([x[a:b].mean() for a, b in itertools.pairwise(edges)])

    energy = np.sqrt(per_block(e**2))
    seconds = max(20 * dt, e.size * dt / 60)
    choices: list[tuple[float, str]] = []
    for name, x in signals.items():
        if np.std(x) <= 1e-12 * (np.max(np.abs(x)) + 1e-300):
            continue
        variables = {
            f"large {name}": x,
            f"large swings of {name}": envelope(x, seconds, dt),
            f"fast {name}": np.abs(rate_of(x, dt)),
            f"high frequency of {name}": local_frequency(x, seconds, dt),
        }
        for words, v in variables.items():
            value = per_block(v)
            order = np.argsort(value)
            third = max(2, blocks // 3)
            low = float(np.sqrt(np.mean(energy[order[:third]] ** 2)))
            high = float(np.sqrt(np.mean(energy[order[-third:]] ** 2)))
            if min(low, high) <= 0:
                continue
            opposite = words.replace("large ", "small ").replace("fast ", "slow ").replace("high ", "low ")
            ratio = high / low
            choices.append(
                (abs(np.log(ratio)), f"{words if ratio > 1 else opposite} ({max(ratio, 1 / ratio):.1f} times)")
            )
    half = max(2, blocks // 3)
    early = float(np.sqrt(np.mean(energy[:half] ** 2)))
    late = float(np.sqrt(np.mean(energy[-half:] ** 2)))
    if min(early, late) > 0:
        ratio = late / early
        choices.append(
            (
                abs(np.log(ratio)),
                f"{'late' if ratio > 1 else 'early'} in the record ({max(ratio, 1 / ratio):.1f} times)",
            )
        )
    if not choices:
        return "everywhere alike"
    best = max(choices)
    return f"worst at {best[1]}" if best[0] > np.log(1.25) else "everywhere alike"


def windows(
    problem: Problem, fitted: Fit, outputs: list[str], loudest: Mapping[str, float] | None = None
) -> list[tuple[float, float]]:
    """Return the time windows, in s of the recording, in which any of ``outputs`` exceeds its noise.

    ``loudest`` is the upper end of the noise. If nearly all of the record exceeds it, the windows with most of the
    excess are returned.
    """
    noise = {o: max((loudest or {}).get(o, 0.0), problem.sigma(o)) for o in outputs}
    t = problem.recording.t[problem.index] - problem.recording.t[0]
    found: list[tuple[float, float]] = []
    for o in outputs:
        for a, b in bad_windows(fitted.residual[o], noise[o], 1.0):
            i, j = min(int(a), t.size - 1), min(int(b), t.size) - 1
            found.append((float(t[i]), float(t[j]) + problem.recording.dt))
    found.sort()
    joined: list[tuple[float, float]] = []
    for a, b in found:
        if joined and a <= joined[-1][1] + 1e-9:
            joined[-1] = (joined[-1][0], max(b, joined[-1][1]))
        else:
            joined.append((a, b))
    return joined


def excess_share(e: Array, noise_rms: float) -> float:
    """Return the mean square of a residual over the noise variance."""
    return float(np.mean(e**2) / noise_rms**2) if noise_rms > 0 else np.inf


__all__ = ["Feature", "excess_share", "follow", "regime", "windows"]
