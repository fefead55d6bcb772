"""Evaluates the cascade neural network that separates voluntary from erroneous motion (Ang 2004, sec. 5.3).

Inputs are a bias and a window of the measured path, newest sample first, ``spacing`` samples apart; every hidden unit
sees them and all hidden units before it; the output is linear in all of these. Trained by ``micron tremor train``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from firmware_py.records import Record, new_record
from hal.arrays import Array
from hal.compiled import kernel
from tools.research.tremor.activations import KINDS, activation

Target = Literal["voluntary", "error"]


@dataclass(frozen=True)
class CascadeNetwork:
    """``hidden`` (H, 1 + W + H): row h uses its first 1 + W + h entries; ``output`` (1 + W + H).

    ``scale``: metres per unit of the network's inputs and output. ``centred``: the window's mean is taken out before
    and added again after, so that where the hand is does not matter.
    """

    window: int
    spacing: int
    rate_hz: float
    target: Target
    scale: float
    centred: bool
    kinds: tuple[str, ...]
    hidden: Array
    output: Array
    note: str = ""

    def __post_init__(self) -> None:
        units = len(self.kinds)
        wide = 1 + self.window + units
        if self.hidden.shape != (units, wide) or self.output.shape != (wide,):
            raise ValueError(
                f"cascade network: {units} units on a window of {self.window} need ({units}, {wide}) weights"
            )
        if unknown := set(self.kinds) - set(KINDS):
            raise ValueError(f"cascade network: unknown kind of unit {sorted(unknown)}; known: {', '.join(KINDS)}")
        if not (np.isfinite(self.hidden).all() and np.isfinite(self.output).all() and self.scale > 0.0):
            raise ValueError("cascade network: weights must be finite and the scale positive")


def cascade_dtype(window: int, spacing: int, units: int) -> np.dtype[Any]:
    """Numbers of the kernel."""
    wide = 1 + window + units
    return np.dtype(
        [
            ("hidden", "f8", (max(1, units), wide)),
            ("output", "f8", (wide,)),
            ("kinds", "i8", (max(1, units),)),
            ("window", "i8"),
            ("spacing", "i8"),
            ("units", "i8"),
            ("scale", "f8"),
            ("centred", "i8"),
            ("gives_error", "i8"),
        ]
    )


def cascade_state_dtype(window: int, spacing: int, units: int) -> np.dtype[Any]:
    """Ring of past samples, room for the features, how many samples have come."""
    return np.dtype(
        [
            ("ring", "f8", (window * spacing,)),
            ("features", "f8", (1 + window + units,)),
            ("at", "i8"),
            ("seen", "i8"),
        ]
    )


def cascade_params(network: CascadeNetwork) -> Record:
    """Return the kernel's parameters."""
    units = len(network.kinds)
    hidden = network.hidden if units else np.zeros((1, 1 + network.window))
    return new_record(
        cascade_dtype(network.window, network.spacing, units),
        hidden=hidden,
        output=network.output,
        kinds=[KINDS.index(k) for k in network.kinds] or [0],
        window=network.window,
        spacing=network.spacing,
        units=units,
        scale=network.scale,
        centred=int(network.centred),
        gives_error=int(network.target == "error"),
    )


def cascade_state(network: CascadeNetwork) -> Record:
    """Return the state before the first sample."""
    return new_record(cascade_state_dtype(network.window, network.spacing, len(network.kinds)))


@kernel
def cascade_output(features: Array, hidden: Array, kinds: NDArray[np.int64], units: int, output: Array) -> float:
    """Fill the hidden units' places at the end of ``features`` and return the network's output."""
    first = len(features) - units
    for h in range(units):
        net = 0.0
        for i in range(first + h):
            net += hidden[h, i] * features[i]
        features[first + h] = activation(kinds[h], net)
    out = 0.0
    for i in range(len(features)):
        out += output[i] * features[i]
    return out


@kernel
def cascade_kernel(position: float, state: Record, param: Record) -> float:
    """Return the erroneous part of ``position`` (m) now, 0 until the window has filled. Nothing is allocated."""
    size = len(state.ring)
    state.at = (state.at + 1) % size
    state.ring[state.at] = position
    state.seen = min(state.seen + 1, size)
    if state.seen < size:
        return 0.0
    middle = 0.0
    if param.centred:
        for j in range(param.window):
            middle += state.ring[(state.at - j * param.spacing) % size]
        middle /= param.window
    state.features[0] = 1.0
    for j in range(param.window):
        state.features[1 + j] = (state.ring[(state.at - j * param.spacing) % size] - middle) / param.scale
    out = param.scale * cascade_output(state.features, param.hidden, param.kinds, param.units, param.output)
    if param.gives_error:
        return out
    return position - (out + middle)


@kernel
def cascade_run(positions: Array, states: Record, params: Record, errors: Array) -> None:
    """Run ``cascade_kernel`` over ``positions`` (n,) and write ``errors`` (n,)."""
    for i in range(len(positions)):
        errors[i] = cascade_kernel(positions[i], states[0], params[0])


class Cascade:
    """Holds a network with its state, for one axis."""

    def __init__(self, network: CascadeNetwork) -> None:
        self.network = network
        self.params = cascade_params(network)
        self.state = cascade_state(network)

    def run(self, positions: Sequence[float] | Array) -> Array:
        """Return the erroneous part (n,) of a path (n,), m. The state carries on from call to call."""
        path = np.ascontiguousarray(positions, dtype=np.float64)
        errors = np.zeros(len(path))
        cascade_run(path, self.state, self.params, errors)
        return errors
