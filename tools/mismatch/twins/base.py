"""What a twin is: an ordered chain of stages around base physics with a flat list of base parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.effect import Array, Effect, Human, Parameter, Settings, Stage
from tools.mismatch.recording import Recording

Counted = Literal["", "start", "rest"]
"""What a position is counted from where only its rate was recorded: the begin of the record, or a spring at rest."""


@dataclass(frozen=True)
class Signal:
    """A signal that is affine in the linear parameters: ``value + sum(theta[j] * columns[j])``.

    ``token`` names how it came about; equal tokens mean equal arrays, so that work can be remembered.
    """

    value: Array
    columns: Mapping[int, Array] = field(default_factory=dict[int, Array])
    token: tuple[object, ...] = ()

    def map(self, f: Callable[[Array], Array], token: object) -> Signal:
        """A linear operator on the value and on every column."""
        return Signal(f(self.value), {j: f(c) for j, c in self.columns.items()}, (*self.token, token))

    def plus(self, columns: Mapping[int, Array], token: object) -> Signal:
        """More columns (added to those with the same index)."""
        merged = dict(self.columns)
        for j, c in columns.items():
            merged[j] = merged[j] + c if j in merged else c
        return replace(self, columns=merged, token=(*self.token, token))


@dataclass(frozen=True)
class Force:
    """A feedback effect as the base physics meets it: ``basis(pos, vel) @ weights`` is added to the force."""

    effect: Effect
    settings: Settings
    q: Array
    weights: Array
    first_weight: int
    """Index of its first weight in theta."""
    target: str = ""
    """Where it acts, of a twin that has several places."""


@dataclass(frozen=True)
class Run:
    """The stretch of a recording that is simulated, and from where.

    ``starts``: samples of the stretch where the base physics starts afresh. ``window``: samples of measured output
    after each start that may set its state (0: the twin's own initial state). ``measured``: outputs (n,). ``setting``:
    sorted sample numbers that may set the states of a linear run instead (None: those of the window). ``period``:
    samples after which all inputs and outputs repeat from every start on (0: they do not): it sets the start states.
    ``afresh``: samples where the memory of effects begins. ``bent``: an effect that is not linear stands between the
    states and what was measured, which then is no linear function of a start state.
    """

    t: Array
    dt: float
    signals: Mapping[str, Array]
    inputs: tuple[str, ...]
    measured: Mapping[str, Array]
    starts: tuple[int, ...]
    window: int
    memo: dict[object, object]
    setting: NDArray[np.int64] | None = None
    period: int = 0
    afresh: tuple[int, ...] = (0,)
    bent: bool = False


class Twin(Protocol):
    """The simulator before anything is added. Frozen; ``theta`` are the base parameters, in order."""

    @property
    def kind(self) -> str:
        """The contract's name."""
        ...

    @property
    def inputs(self) -> tuple[str, ...]:
        """Input signals that were recorded."""
        ...

    @property
    def outputs(self) -> tuple[str, ...]:
        """Output signals that were recorded."""
        ...

    @property
    def units(self) -> Mapping[str, str]:
        """Contract unit of each signal."""
        ...

    @property
    def chain(self) -> tuple[Stage, ...]:
        """Its stages, in order."""
        ...

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Base parameters, in the order of theta."""
        ...

    @property
    def static(self) -> bool:
        """Output depends on the present input alone: additive effects then sit at the output, driven by the input."""
        ...

    @property
    def apart(self) -> bool:
        """Every output has base parameters of its own, so that one can be fitted without the others: parameter ``i``
        belongs to output ``i`` modulo their number."""
        ...

    @property
    def restart(self) -> bool:
        """Free-run drifts (an integrator, a slow pole): each range of a view starts from a state set by data."""
        ...

    @property
    def feedback_on(self) -> str:
        """The output that feedback effects act on ("" when the twin has no equation of motion)."""
        ...

    @property
    def counted(self) -> Counted:
        """Return what the position of feedback effects counts from where ``feedback_on`` is a velocity."""
        ...

    def start(self, recording: Recording) -> Array:
        """Base parameters as the engineer gave them; what is missing is estimated from the data."""
        ...

    def drive(self, output: str) -> str:
        """The input signal that this output mainly follows ("" if several do)."""
        ...

    def facts(self, output: str) -> Mapping[str, tuple[float, ...]]:
        """Constants that effects may need: axis, location."""
        ...

    def sensitivity(self, output: str, theta: Array) -> float:
        """Output per unit of its driving input, for human parameters."""
        ...

    def input_gain(self, signal: str, theta: Array) -> float:
        """Return what weights of effects on this input are multiplied by before the base physics; 1.0 where they are
        in input units. (A single gain behind the input is a linear parameter only if weights carry it.)"""
        ...

    def respond(
        self, run: Run, inputs: Mapping[str, Signal], theta: Array, forces: Sequence[Force], join: bool
    ) -> dict[str, Signal]:
        """Outputs for inputs. Linear base parameters appear as columns; ``join`` folds them into the value.

        Columns of the inputs pass through when the base physics is linear in its input.
        """
        ...

    def through(self, run: Run, signal: str, theta: Array, output: str) -> Callable[[Array], Array] | None:
        """What a change of an input (or, for "", of the force behind the input gain) does to an output, linear part
        only; None: unknown."""
        ...

    def human(self, theta: Array) -> Sequence[Human]:
        """Base parameters under the contract's names."""
        ...

    def to_text(self, theta: Array) -> dict[str, object]:
        """``[twin.parameters]`` for a corrected twin."""
        ...


def travelled(velocity: Array, dt: float, counted: Counted) -> Array:
    """Position (n,) that a recorded velocity has led to, on average zero where a spring holds it."""
    x = np.concatenate([[0.0], np.cumsum(0.5 * dt * (velocity[1:] + velocity[:-1]))])
    return x - x.mean() if counted == "rest" else x


def fold(signal: Signal, theta: Array, gain: float = 1.0) -> Signal:
    """The value at ``theta``, without columns; ``gain``: what the weights carry (``Twin.input_gain``)."""
    if not signal.columns:
        return signal
    value = signal.value.copy()
    for j, c in signal.columns.items():
        value += theta[j] / gain * c
    key = tuple((j, float(theta[j] / gain)) for j in signal.columns)
    return Signal(value, {}, (*signal.token, key))


MEMO_BYTES = 1 << 28  # what one view remembers of unchanged columns


def remember(memo: dict[object, object], key: object, make: Callable[[], Array]) -> Array:
    """``make()`` once per key; everything goes when the store is full."""
    found = memo.get(key)
    if isinstance(found, np.ndarray):
        return found
    value = make()
    size = memo.get("bytes", 0)
    assert isinstance(size, int)
    if value.nbytes > MEMO_BYTES // 2:
        return value
    if size + value.nbytes > MEMO_BYTES:
        memo.clear()
        size = 0
    memo[key] = value
    memo["bytes"] = size + value.nbytes
    return value
