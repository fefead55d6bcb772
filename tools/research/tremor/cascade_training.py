"""Training of a cascade network (Ang 2004, 5.3.2): linear first, then one hidden unit at a time from a pool of
candidates.

Candidates (every kind, several random starts) are trained apart by quickprop on their correlation with what the network
still misses; the best is installed. Its input weights and the output's are then trained together by node-decoupled
extended Kalman filtering, after that they are frozen. Which size is kept is decided on validation paths, which no
weight has seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from tools.research.tremor.activations import KINDS
from tools.research.tremor.cascade import CascadeNetwork, Target
from tools.research.tremor.cascade_kernels import ndekf_pass, quickprop, unit_outputs


@dataclass(frozen=True)
class Training:
    """Holds the settings of training: ``window`` inputs ``spacing`` samples apart, at most ``units`` hidden units.

    ``spread``: standard deviation of the weights before training, of inputs and target of unit power. ``noise``:
    variance of what no network can explain, same unit. ``refine`` trains a new unit's input weights with the output's.
    ``patience``: units without gain on the validation paths before it stops. ``candidate_rows``: candidates are trained
    on no more samples than this, evenly spread.
    """

    window: int = 75
    spacing: int = 1
    units: int = 4
    target: Target = "voluntary"
    centred: bool = False
    restarts: int = 2
    epochs: int = 20
    candidate_rows: int = 1000
    quickprop_rate: float = 2.0
    passes: int = 2
    spread: float = 0.3
    noise: float = 0.05
    growth: float = 0.0
    refine: bool = True
    patience: int = 1
    seed: int = 1


@dataclass(frozen=True)
class Paths:
    """Holds the paths that a network learns: pairs of (measured, voluntary), each (n,) in m."""

    pairs: tuple[tuple[Array, Array], ...]


@dataclass(frozen=True)
class Trained:
    """The network, the same without hidden units (the best linear filter of its window), and rms errors (over the
    target's rms) on training and validation paths for 0, 1, ... hidden units."""

    network: CascadeNetwork
    linear: CascadeNetwork
    training_error: tuple[float, ...]
    validation_error: tuple[float, ...]
    candidates_tried: int


def windows(path: Array, window: int, spacing: int) -> Array:
    """(n - (window - 1) spacing, window), newest sample first."""
    reach = (window - 1) * spacing + 1
    view = np.lib.stride_tricks.sliding_window_view(path, reach)
    return view[:, ::-1][:, ::spacing]


def train(fitting: Paths, holding: Paths, rate_hz: float, how: Training, note: str = "") -> Trained:
    """A network from ``fitting``, its size chosen on ``holding``. Raises ValueError for a path that is too short."""
    rng = np.random.default_rng(how.seed)
    scale = sqrt(float(np.mean(np.concatenate([measured for measured, _ in fitting.pairs]) ** 2)))
    fit_x, fit_y = _matrices(fitting, how, scale)
    hold_x, hold_y = _matrices(holding, how, scale)
    order = rng.permutation(len(fit_x))
    features = np.concatenate([np.ones((len(fit_x), 1)), fit_x], axis=1)
    held = np.concatenate([np.ones((len(hold_x), 1)), hold_x], axis=1)
    first = 1 + how.window
    output = np.zeros(first)
    hidden: list[Array] = []
    kinds: list[int] = []
    nothing = np.zeros(0)
    output, _ = _fit(features, fit_y, order, output, nothing, 0, how)
    # every state of the growing network, so that the one that validates best can be taken
    states = [(output.copy(), 0)]
    train_error = [_rms(features, output, fit_y)]
    hold_error = [_rms(held, output, hold_y)]
    tried = 0
    while len(kinds) < how.units and len(kinds) < int(np.argmin(hold_error)) + how.patience:
        rows = slice(None, None, max(1, len(fit_y) // how.candidate_rows))
        some = np.ascontiguousarray(features[rows])
        residual = (fit_y - features @ output)[rows]
        residual = residual - residual.mean()
        residual /= max(1e-12, float(np.std(residual)))
        best: tuple[float, int, Array] | None = None
        for kind in range(len(KINDS)):
            for _ in range(how.restarts):
                size = 10.0 ** rng.uniform(-0.5, 0.7) / sqrt(features.shape[1])
                weights = rng.standard_normal(features.shape[1]) * size
                score = quickprop(some, residual, kind, weights, how.epochs, how.quickprop_rate)
                tried += 1
                if np.isfinite(score) and (best is None or score > best[0]):
                    best = float(score), kind, weights
        if best is None:
            break
        _, kind, weights = best
        features = _with_unit(features, kind, weights)
        output, weights = _fit(features, fit_y, order, np.append(output, 0.0), weights, kind, how)
        # with the weights as they are at the end of the pass, then the output once more on fixed features
        features = _with_unit(features[:, :-1], kind, weights)
        output, _ = _fit(features, fit_y, order, output, nothing, kind, how)
        held = _with_unit(held, kind, weights)
        hidden.append(weights)
        kinds.append(kind)
        states.append((output.copy(), len(kinds)))
        train_error.append(_rms(features, output, fit_y))
        hold_error.append(_rms(held, output, hold_y))

    def network(output: Array, units: int) -> CascadeNetwork:
        table = np.zeros((units, first + units))
        for h in range(units):
            table[h, : first + h] = hidden[h]
        return CascadeNetwork(
            how.window,
            how.spacing,
            rate_hz,
            how.target,
            scale,
            how.centred,
            tuple(KINDS[k] for k in kinds[:units]),
            table,
            output,
            note,
        )

    fit_rms, hold_rms = (sqrt(float(np.mean(y**2))) for y in (fit_y, hold_y))
    return Trained(
        network(*states[int(np.argmin(hold_error))]),
        network(*states[0]),
        tuple(e / fit_rms for e in train_error),
        tuple(e / hold_rms for e in hold_error),
        tried,
    )


def _matrices(paths: Paths, how: Training, scale: float) -> tuple[Array, Array]:
    """Inputs (n, window) and targets (n,) in units of ``scale``."""
    inputs: list[Array] = []
    targets: list[Array] = []
    reach = (how.window - 1) * how.spacing
    for measured, wanted in paths.pairs:
        if len(measured) <= 2 * reach:
            raise ValueError(f"a path of {len(measured)} samples is too short for a window over {reach + 1}")
        x = windows(measured, how.window, how.spacing)
        middle = x.mean(axis=1) if how.centred else np.zeros(len(x))
        y = wanted[reach:] - middle if how.target == "voluntary" else measured[reach:] - wanted[reach:]
        inputs.append((x - middle[:, None]) / scale)
        targets.append(y / scale)
    return np.concatenate(inputs), np.concatenate(targets)


def _with_unit(features: Array, kind: int, weights: Array) -> Array:
    out = np.empty(len(features))
    unit_outputs(features, kind, weights, out)
    return np.ascontiguousarray(np.column_stack([features, out]))


def _fit(
    features: Array, target: Array, order: NDArray[np.int64], output: Array, unit: Array, kind: int, how: Training
) -> tuple[Array, Array]:
    """Output weights and the newest unit's, trained; covariances start anew, weights go on from where they are."""
    given = unit
    unit = unit.copy() if how.refine else np.zeros(0)
    output = output.copy()
    m, k = features.shape[1], len(unit)
    output_spread = np.eye(m) * how.spread**2
    unit_spread = np.eye(max(1, k)) * how.spread**2
    work = features.copy()
    for _ in range(how.passes if k else 1):
        ndekf_pass(work, target, order, output, output_spread, unit, unit_spread, kind, how.noise, how.growth)
    return output, unit if how.refine else given


def _rms(features: Array, output: Array, target: Array) -> float:
    return sqrt(float(np.mean((features @ output - target) ** 2)))
