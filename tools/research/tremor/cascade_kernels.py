"""Training kernels of the cascade network: quickprop for candidate units, node-decoupled extended Kalman filtering."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.compiled import kernel
from tools.research.tremor.activations import activation, slope

GROWTH = 1.75  # of a quickprop step over the one before (Fahlman 1988)


@kernel
def candidate_score(inputs: Array, residual: Array, kind: int, weights: Array, gradient: Array) -> float:
    """Correlation magnitude of a candidate unit with the residual, and its gradient over ``weights``.

    ``inputs`` (n, m), ``residual`` (n,) of zero mean and unit power. The measure is Fahlman and Lebiere's covariance
    divided by the unit's own spread, so that units of different kinds compare.
    """
    n, m = inputs.shape
    out = np.empty(n)
    rise = np.empty(n)
    mean = 0.0
    for i in range(n):
        net = 0.0
        for j in range(m):
            net += weights[j] * inputs[i, j]
        out[i] = activation(kind, net)
        rise[i] = slope(kind, net)
        mean += out[i]
    mean /= n
    both = 0.0
    power = 0.0
    for i in range(n):
        both += (out[i] - mean) * residual[i]
        power += (out[i] - mean) ** 2
    both /= n
    power = power / n + 1e-12
    spread = sqrt(power)
    sign = 1.0 if both >= 0.0 else -1.0
    gradient[:] = 0.0
    for i in range(n):
        # d/dout of |both| / spread
        pull = (sign * residual[i] / spread - abs(both) * (out[i] - mean) / (power * spread)) * rise[i] / n
        for j in range(m):
            gradient[j] += pull * inputs[i, j]
    return abs(both) / spread


@kernel
def quickprop(inputs: Array, residual: Array, kind: int, weights: Array, epochs: int, rate: float) -> float:
    """Train one candidate in place by quickprop on its correlation; returns the best found, ``weights`` with it."""
    m = inputs.shape[1]
    gradient = np.zeros(m)
    before = np.zeros(m)
    step = np.zeros(m)
    best = candidate_score(inputs, residual, kind, weights, gradient)
    kept = weights.copy()
    shrink = GROWTH / (1.0 + GROWTH)
    for _ in range(epochs):
        for j in range(m):
            g, p, s = gradient[j], before[j], step[j]
            move = 0.0
            if s != 0.0:
                if s > 0.0:
                    if g > 0.0:
                        move += rate * g
                    move += GROWTH * s if g >= shrink * p else s * g / (p - g)
                else:
                    if g < 0.0:
                        move += rate * g
                    move += GROWTH * s if g <= shrink * p else s * g / (p - g)
            else:
                move = rate * g
            move = max(-1.0, min(1.0, move))
            step[j] = move
            before[j] = g
            weights[j] += move
        score = candidate_score(inputs, residual, kind, weights, gradient)
        if score > best:
            best = score
            kept[:] = weights
    weights[:] = kept
    return best


@kernel
def ndekf_pass(
    features: Array,
    target: Array,
    order: NDArray[np.int64],
    output: Array,
    output_spread: Array,
    unit: Array,
    unit_spread: Array,
    kind: int,
    noise: float,
    growth: float,
) -> float:
    """Make a pass of node-decoupled extended Kalman filtering over the samples ``order``; mean squared innovation.

    ``features`` (n, m): bias, window, hidden units that are frozen, newest unit last (recomputed here when ``unit`` has
    weights). Two groups, the weights into the output node and those into the newest hidden node, with covariances
    ``output_spread`` (m, m), ``unit_spread`` (m - 1, m - 1) and none between them; ``unit`` of length 0 leaves the
    output group alone, which is then exact recursive least squares. ``noise``: variance of the target's error.
    ``growth``: added to every weight's variance per sample.
    """
    n, m = features.shape
    k = len(unit)
    out_gain = np.empty(m)
    unit_gain = np.empty(max(1, k))
    missed = 0.0
    for at in range(n):
        row = features[order[at]]
        rise = 0.0
        if k > 0:
            net = 0.0
            for j in range(k):
                net += unit[j] * row[j]
            row[m - 1] = activation(kind, net)
            rise = output[m - 1] * slope(kind, net)
        y = 0.0
        for j in range(m):
            y += output[j] * row[j]
        error = target[order[at]] - y
        missed += error * error
        total = noise
        for i in range(m):
            g = 0.0
            for j in range(m):
                g += output_spread[i, j] * row[j]
            out_gain[i] = g
            total += g * row[i]
        if k > 0:
            for i in range(k):
                g = 0.0
                for j in range(k):
                    g += unit_spread[i, j] * row[j]
                unit_gain[i] = g * rise
                total += unit_gain[i] * row[i] * rise
        scale = error / total
        for i in range(m):
            output[i] += out_gain[i] * scale
            ratio = out_gain[i] / total
            for j in range(m):
                output_spread[i, j] -= ratio * out_gain[j]
            output_spread[i, i] += growth
        for i in range(k):
            unit[i] += unit_gain[i] * scale
            ratio = unit_gain[i] / total
            for j in range(k):
                unit_spread[i, j] -= ratio * unit_gain[j]
            unit_spread[i, i] += growth
    return missed / n


@kernel
def unit_outputs(inputs: Array, kind: int, weights: Array, out: Array) -> None:
    """Outputs (n,) of one hidden unit."""
    for i in range(inputs.shape[0]):
        net = 0.0
        for j in range(len(weights)):
            net += weights[j] * inputs[i, j]
        out[i] = activation(kind, net)
