"""Defines a twin: an ordered chain of stages around base physics with a flat list of base parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.effect import Array, Effect, Human, Parameter, Settings, Stage
from tools.mismatch.recording import Recording
from tools.mismatch.twins.memo import Nearby

LEAST_WINDOW = 20
"""Least number of samples that set a start state, in a record that has so many."""
Counted = Literal["", "start", "rest"]
"""Origin of a position of which only the rate was recorded: the start of the record, or a spring at rest."""


@dataclass(frozen=True)
class Signal:
    """Holds a signal that is affine in the linear parameters: ``value + sum(theta[j] * columns[j])``.

    ``token`` identifies its origin: equal tokens mean equal arrays, so that results can be cached.
    """

    value: Array
    columns: Mapping[int, Array] = field(default_factory=dict[int, Array])
    token: tuple[object, ...] = ()

    def map(self, f: Callable[[Array], Array], token: object) -> Signal:
        """Apply a linear operator to the value and to every column."""
        return Signal(f(self.value), {j: f(c) for j, c in self.columns.items()}, (*self.token, token))

    def plus(self, columns: Mapping[int, Array], token: object) -> Signal:
        """Return the signal with more columns, which are added to those with the same index."""
        merged = dict(self.columns)
        for j, c in columns.items():
            merged[j] = merged[j] + c if j in merged else c
        return replace(self, columns=merged, token=(*self.token, token))


@dataclass(frozen=True)
class Force:
    """Presents a feedback effect to the base physics, which adds ``basis(pos, vel) @ weights`` to the force."""

    effect: Effect
    settings: Settings
    q: Array
    weights: Array
    first_weight: int
    """Index of its first weight in theta."""
    target: str = ""
    """Place at which the force acts, for a twin with several places."""


@dataclass(frozen=True)
class Path:
    """Carries an output through the effects behind it, to what was measured; ``token`` identifies it.

    ``carry`` takes any number of first samples of a run.
    """

    carry: Callable[[Array], Array]
    token: tuple[object, ...]
    is_linear: bool


@dataclass(frozen=True)
class Run:
    """Describes the simulated stretch of a recording and its start states.

    ``starts``: samples of the stretch at which the base physics restarts. ``window``: number of measured output samples
    after each start that may set its state (0: the twin's own initial state). ``measured``: outputs (n,). ``setting``:
    sorted sample numbers that may set the states of a linear run instead (None: those of the window). ``period``:
    samples after which all inputs and outputs repeat from every start on (0: they do not); it then sets the start
    states. ``afresh``: samples at which the memory of effects restarts. ``bent``: True if a nonlinear effect stands
    between the states and the measured outputs, which are then no linear function of a start state. ``wanted``: sorted
    sample numbers of which alone a response may consist (None: it consists of all). ``paths``: of the outputs that were
    measured behind effects, linear ones for a linear run; ``about``: an earlier run of these outputs (n,), else
    zeros. ``beside``: what is added behind each output per unit of a weight; start states are read off the rest;
    ``beside_token`` identifies it. ``recorded``: outputs (n,) as recorded, where ``measured`` has been corrected.
    ``nearby``: start states of the search that this run belongs to.
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
    wanted: NDArray[np.int64] | None = None
    paths: Mapping[str, Path] = field(default_factory=dict[str, Path])
    about: Mapping[str, Array] = field(default_factory=dict[str, Array])
    beside: Mapping[str, Mapping[int, Array]] = field(default_factory=dict[str, Mapping[int, Array]])
    beside_token: tuple[object, ...] = ()
    recorded: Mapping[str, Array] = field(default_factory=dict[str, Array])
    nearby: Nearby | None = None

    def behind_path(self, output: str, y: Array, at: NDArray[np.int64]) -> Array:
        """Return what is measured (m,) of an output ``y`` (m,) at the samples ``at``; elsewhere it is as ``about``."""
        path = self.paths.get(output)
        if path is None:
            return y
        size = self.reach(at)
        full = self.about[output][:size].copy() if output in self.about else np.zeros(size)
        full[at] = y
        return path.carry(full)[at]

    def reach(self, at: NDArray[np.int64]) -> int:
        """Return the number of first samples on which what is measured at the sorted samples ``at`` depends.

        It depends on what was before, and on little after (a clock that runs slow, a central difference).
        """
        return min(self.t.size, 2 * (int(at[-1]) + 1))

    def head(self, size: int) -> Run:
        """Return the first ``size`` samples of the run, without its cache."""
        if size == self.t.size:
            return replace(self, memo={})
        signals, measured = ({o: x[:size] for o, x in of.items()} for of in (self.signals, self.measured))
        afresh, starts = (tuple(k for k in of if k < size) for of in (self.afresh, self.starts))
        return replace(self, t=self.t[:size], signals=signals, measured=measured, starts=starts, afresh=afresh, memo={})

    @property
    def scale(self) -> Mapping[str, Array]:
        """Return the outputs (n,) that show size and noise of a record: the same for all corrections of it."""
        return self.recorded or self.measured

    @property
    def lasting(self) -> dict[object, object]:
        """Return the cache of what depends on no measured output."""
        kept = self.memo.setdefault("lasting", {})
        assert isinstance(kept, dict)
        return cast("dict[object, object]", kept)

    @property
    def start_window(self) -> int:
        """Return the number of samples after each start that set its state where the data set any."""
        return max(self.window, min(LEAST_WINDOW, self.t.size))


class Twin(Protocol):
    """Defines a simulator without effects. It is frozen; ``theta`` are the base parameters, in order."""

    @property
    def kind(self) -> str:
        """Return the contract's name."""
        ...

    @property
    def inputs(self) -> tuple[str, ...]:
        """Return the recorded input signals."""
        ...

    @property
    def outputs(self) -> tuple[str, ...]:
        """Return the recorded output signals."""
        ...

    @property
    def units(self) -> Mapping[str, str]:
        """Return the contract unit of each signal."""
        ...

    @property
    def chain(self) -> tuple[Stage, ...]:
        """Return the stages, in order."""
        ...

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Return the base parameters, in the order of theta."""
        ...

    @property
    def static(self) -> bool:
        """Return True if outputs depend on the present input alone.

        Additive effects then sit at the output and are driven by the input.
        """
        ...

    @property
    def apart(self) -> bool:
        """Return True if every output has its own base parameters and can be fitted without the others.

        Parameter ``i`` belongs to output ``i`` modulo their number.
        """
        ...

    @property
    def restart(self) -> bool:
        """Return True if a free run drifts (an integrator, a slow pole), so that data set the state of each range."""
        ...

    @property
    def feedback_on(self) -> str:
        """Return the output that feedback effects act on ("" when the twin has no equation of motion)."""
        ...

    @property
    def counted(self) -> Counted:
        """Return the origin of the position of feedback effects where ``feedback_on`` is a velocity."""
        ...

    def start(self, recording: Recording) -> Array:
        """Return the base parameters as the engineer gave them; missing ones are estimated from the data."""
        ...

    def drive(self, output: str) -> str:
        """Return the input signal that drives this output ("" if there are several)."""
        ...

    def facts(self, output: str) -> Mapping[str, tuple[float, ...]]:
        """Return the constants that effects may need: axis, location."""
        ...

    def sensitivity(self, output: str, theta: Array) -> float:
        """Return the output per unit of its driving input, for human parameters."""
        ...

    def input_gain(self, signal: str, theta: Array) -> float:
        """Return the factor of weights of effects on this input before the base physics; 1.0 if in input units.

        A single gain behind the input is a linear parameter only if the weights carry it.
        """
        ...

    def respond(
        self, run: Run, inputs: Mapping[str, Signal], theta: Array, forces: Sequence[Force], join: bool
    ) -> dict[str, Signal]:
        """Return the outputs for inputs. Linear base parameters appear as columns; ``join`` folds them into the value.

        Columns of the inputs pass through if the base physics is linear in its input.
        """
        ...

    def through(self, run: Run, signal: str, theta: Array, output: str) -> Callable[[Array], Array] | None:
        """Return the linear response of an output to a change of an input; None if it is unknown.

        The input "" stands for the force behind the input gain.
        """
        ...

    def human(self, theta: Array) -> Sequence[Human]:
        """Return the base parameters under the contract's names."""
        ...

    def to_text(self, theta: Array) -> dict[str, object]:
        """Return ``[twin.parameters]`` for a corrected twin."""
        ...


@dataclass(frozen=True)
class Balance:
    """Holds both sides of an equation of motion along a recording.

    ``rate`` (n,) is the derivative of the ``order`` (1 or 2) of the ``reading`` (n,), by central differences; ``model``
    (n,) is the same by the equations without forces, and ``slopes`` (n, k) are its derivatives with respect to the base
    parameters. ``at`` returns the model's side at other base parameters and signals.
    """

    reading: Array
    order: int
    rate: Array
    model: Array
    slopes: Array
    at: Callable[[Array, Mapping[str, Array]], Array]


def central_difference(x: Array, dt: float, order: int) -> Array:
    """Return the derivative (n,) of ``order`` 1 or 2 by central differences; the ends repeat their neighbours."""
    inner = (x[2:] - x[:-2]) / (2 * dt) if order == 1 else (x[2:] - 2 * x[1:-1] + x[:-2]) / dt**2
    return np.concatenate([inner[:1], inner, inner[-1:]])


def midway(u: Array, held: bool) -> Array:
    """Return an input (n,) as a central difference sees it: held, it is the mean of both sides of a sample."""
    return np.concatenate([u[:1], 0.5 * (u[1:] + u[:-1])]) if held else u


def travelled(velocity: Array, dt: float, counted: Counted) -> Array:
    """Integrate a recorded velocity to a position (n,); its mean is zero where a spring holds it."""
    x = np.concatenate([[0.0], np.cumsum(0.5 * dt * (velocity[1:] + velocity[:-1]))])
    return x - x.mean() if counted == "rest" else x


def fold(signal: Signal, theta: Array, gain: float = 1.0) -> Signal:
    """Return the value at ``theta``, without columns; ``gain`` is the factor of the weights (``Twin.input_gain``)."""
    if not signal.columns:
        return signal
    value = signal.value.copy()
    for j, c in signal.columns.items():
        value += theta[j] / gain * c
    key = tuple((j, float(theta[j] / gain)) for j in signal.columns)
    return Signal(value, {}, (*signal.token, key))
