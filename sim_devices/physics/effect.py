"""Definition of an effect: one piece of physics that a simulator may lack, as a pure forward model.

The mismatch engine proposes these, fits their parameters inside the simulator, and puts the accepted ones
into a corrected twin. One effect per vocabulary name of the contract (recordings-and-mismatch.md, section 3);
one family of shapes per effect.

An effect has settings, nonlinear parameters and linear weights:

settings   what is read off the data once and then frozen (thresholds, knots, event times); plain numbers, so
           that they can be written to a twin file
nonlinear  few, searched (a time constant, a frequency, a limit)
weights    the coefficients of ``basis`` columns, solved exactly (kinds "add" and "feedback" only)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array

Settings = Mapping[str, tuple[float, ...]]
"""Frozen, data-derived numbers of one placed effect. Scalars are 1-tuples."""

Stage = Literal["amplifier", "actuator", "mechanics", "mounting", "sensor", "acquisition", "environment"]
STAGES: tuple[Stage, ...] = (
    "amplifier",
    "actuator",
    "mechanics",
    "mounting",
    "environment",
    "sensor",
    "acquisition",
)
"""The order in which a signal passes them."""

Kind = Literal["add", "linear", "nonlinear", "feedback"]
"""The way in which an effect acts on its target signal.

add        x + basis(x, ...) @ weights
linear     a linear operator on x (filter, delay, resampling): applied to every column of a design; with a basis
           its columns are added behind it
nonlinear  any other map of x
feedback   a force phi(position, velocity) @ weights inside the equation of motion; ``x`` is position
"""

Site = Literal["input", "output", "between"]
"""Site of an effect. ``between`` is the place between two filters of a circuit, also for effects at an input."""


@dataclass(frozen=True)
class Parameter:
    """Describes a parameter of an effect. Bounds are in ``unit``; ``log`` says that it is searched by its logarithm.

    A ``unit`` may contain ``{in}`` and ``{out}``, the units of the signals before and after the base physics.
    ``scale`` is a typical step for finite differences and for conditioning. ``away`` is a value at which the parameter
    has no influence. A fit that is insensitive to the parameter leaves it there, so that predictions of samples outside
    the fit do not depend on a value that no sample determines.
    """

    name: str
    unit: str
    lo: float = -np.inf
    hi: float = np.inf
    log: bool = False
    scale: float = 1.0
    away: float | None = None


@dataclass(frozen=True)
class Context:
    """Holds the data that a forward model may use besides the signal that it changes.

    ``t`` seconds since the start of the whole recording (n,), so that warm-up keeps its age in a held-out
    block; ``dt`` its step. ``signals``: every recorded input and context signal by the twin's name (n,), in
    the units of the contract. ``target``: the signal that the effect sits on; ``output``: the output whose
    residual is looked at; ``drive``: the name of the input that drives that output ("" when several do).
    ``starts``: samples where simulation starts afresh (0 first); memory is cleared there. ``mask`` (n,):
    where the residual may be looked at (None = everywhere); ``noise``: rms of the output's noise if known.
    ``facts``: constants of the twin that some effects need (sensor positions, axis of a channel).
    For guesses only: ``believed`` (n,) the output by the engineer's own base parameters (a re-fit may have bent
    them to cover an effect); ``measured`` (n,) the output's recording; ``everywhere`` (n,) the residual beyond the
    mask too, for nothing but locating single events (bursts); ``through`` carries a small change of the signal
    that the effect sits on to the output (linear, compiled).
    """

    t: Array
    dt: float
    signals: Mapping[str, Array]
    target: str
    output: str = ""
    drive: str = ""
    starts: tuple[int, ...] = (0,)
    mask: NDArray[np.bool_] | None = None
    noise: float | None = None
    facts: Mapping[str, tuple[float, ...]] = field(default_factory=dict[str, tuple[float, ...]])
    measured: Array | None = None
    everywhere: Array | None = None
    believed: Array | None = None
    through: Callable[[Array], Array] | None = None
    bends: Array | None = None
    """Derivatives (n, k) of the output with respect to each searched parameter of the simulation; for guesses only."""

    @property
    def keep(self) -> NDArray[np.bool_]:
        """Mask with None resolved, (n,) bool."""
        return np.ones(self.t.size, np.bool_) if self.mask is None else self.mask

    def to_output(self, change: Array) -> Array:
        """Return the change (n,) of the output that a change (n,) of the signal causes, to first order."""
        return change if self.through is None else self.through(change)

    def line(self, x: Array, k: NDArray[np.int64]) -> Array:
        """Return what needs no effect, at the samples ``k`` (k.size, columns): an offset, the signal ``x`` on its way
        to the output, and parameters of the simulation that are a little off.

        A base that was fitted without the effect has bent itself around it; a guess that leaves the base where it is
        finds what the bent base lacks.
        """
        bends = np.empty((self.t.size, 0)) if self.bends is None else self.bends
        return np.column_stack([np.ones(k.size), self.to_output(x)[k], bends[k]])

    def wanted(self, x: Array, residual: Array) -> Array:
        """Return what a course of the signal ``x`` with the effect in it would have to become at the output (n,).

        Like ``to_output``, and unlike the recording, it has no start state: a plant that integrates and is started
        afresh begins somewhere else each time.
        """
        return self.to_output(x) + residual


@dataclass(frozen=True)
class Signature:
    """Holds the outcome of the cheap test that screens a residual for an effect.

    ``p_value`` holds under the null hypothesis that the effect is absent; ``share`` is the largest part of the
    residual's variance that the effect could explain, 0..1.
    """

    p_value: float
    share: float
    note: str = ""


@dataclass(frozen=True)
class Human:
    """Holds a parameter for the report: ``value`` in ``unit``, derived from the fitted ones.

    ``spread`` is the standard deviation that remains without noise, where the value is the mean of a quantity that
    wanders.
    """

    name: str
    value: float
    unit: str
    spread: float = 0.0


@dataclass(frozen=True)
class Parts:
    """Lists the parameters of an effect for given settings: those that are searched and those solved exactly."""

    nonlinear: tuple[Parameter, ...] = ()
    weights: tuple[Parameter, ...] = ()
    penalty: Array | None = None
    """Optional smoothness rows (rows, weights), in units of weight; the fit scales them by the noise."""


Acting = Literal["motion", "storage", "storages", "parameter", "state", "direction", "joint"]
Prepare = Callable[[Array, Array, Context], Settings]
Apply = Callable[[Array, Context, Array, Settings], Array]
Basis = Callable[[Array, Context, Array, Settings], Array]
Guess = Callable[[Array, Array, Context, Settings], Sequence[Sequence[float]]]
Test = Callable[[Array, Array, Context], Signature]
Report = Callable[[Array, Settings, float], Sequence[Human]]
Predict = Callable[[Array, Array, NDArray[np.bool_], NDArray[np.bool_], float], tuple[Array, Array]]
"""Signature of a predictor. Arguments: residual (n,), time since the previous sample (n,) in s, valid samples (n,),
training samples (n,), least rms of the white part. Returns the one-step prediction errors (n,) and their standard
deviations (n,) up to a common factor; the deviations are at least one."""


def no_settings(x: Array, residual: Array, ctx: Context) -> Settings:
    """Return the settings of an effect that reads nothing off the data."""
    return {}


def no_start(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    """Return the only start of an effect without nonlinear parameters: the empty one."""
    return ((),)


def time_settings(x: Array, residual: Array, ctx: Context) -> Settings:
    """Return the settings of an effect that reads the time step and the length of the record, both in s."""
    return {"time": (ctx.dt, ctx.dt * ctx.t.size)}


def reports(*rows: tuple[str, str], by_gain: bool = False) -> Report:
    """Return the report of an effect whose first parameters are human ones, ``rows`` of (name, unit).

    ``by_gain``: the values are at the output and are reported at the input.
    """

    def report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
        g = (scale or 1.0) if by_gain else 1.0
        return tuple(Human(name, float(v) / g, unit) for (name, unit), v in zip(rows, p, strict=False))

    return report


@dataclass(frozen=True)
class Effect:
    """Defines an effect of the vocabulary.

    ``prepare(x, residual, ctx) -> settings`` reads what must be frozen. ``parts(settings)`` lists the parameters.
    ``apply(x, ctx, q, settings) -> (n,)`` for kinds linear and nonlinear; ``basis(x, ctx, q, settings) -> (n, k)``
    for kinds add (columns are added to the signal) and feedback (``x`` is position, columns are forces, velocity
    is ``ctx.signals["velocity"]``). ``q`` (len(parts.nonlinear),). Pure: same arguments, same answer.
    ``guess(x, residual, ctx, settings)`` gives one or more starts for ``q``. ``test`` replaces the score test on
    the directions at the guesses (``simulate_screen.directions``) where columns cannot say it (lines, bursts, steps,
    grids). ``report(p, settings, scale)`` gives human parameters from ``p`` (nonlinear, then weights);
    ``scale`` is the base twin's sensitivity at that place, in output per input unit.
    ``equation`` is TeX; ``source`` paper and equation, or standard text.
    ``driven``: depends on the signal it sits on (False: an addition from outside, such as hum).
    ``needs``: context or input signals without which it cannot be proposed; ``shared``: one set of weights for
    several outputs (field distortions, rigid-body terms): ``basis`` is called per output, same weights.
    """

    name: str
    summary: str
    kind: Kind
    stages: tuple[Stage, ...]
    parts: Callable[[Settings], Parts]
    equation: str
    source: str
    excitation: str
    confusable_with: tuple[str, ...] = ()
    prepare: Prepare = no_settings
    guess: Guess = no_start
    apply: Apply | None = None
    basis: Basis | None = None
    test: Test | None = None
    report: Report | None = None
    driven: bool = True
    sites: tuple[Site, ...] = ("input", "output")
    needs: tuple[str, ...] = ()
    shared: bool = False
    acts_on: tuple[Acting, ...] = ("motion",)
    """Where a feedback effect acts: at a velocity, between two of them (a joint), at any other state (a level, a
    current, a temperature), at all such states at once, on a parameter of differential equations that follows a signal
    or a state, or on one and the direction of a state."""
    end_units: tuple[str, ...] = ()
    """Units that the signal at an input or output must have for the effect to sit there; empty: any."""
    position_units: tuple[str, ...] = ()
    """Units of which the position must have one for a feedback effect; empty: any."""
    not_units: tuple[str, ...] = ()
    """Units that the position cannot have: no temperature flows over."""
    by_position: bool = False
    """True of a feedback effect that a velocity alone, of which the equations have no position, cannot have."""
    twins: tuple[str, ...] = ()
    """Twin kinds that can have the effect; empty: all."""
    available: Callable[[Mapping[str, Array], str], str] | None = None
    """(signals, output) -> reason why the effect cannot be proposed there, "" if it can. Serves needs that a fixed list
    cannot express."""
    claims: Callable[[Settings, int], NDArray[np.bool_]] | None = None
    """(settings, n) -> mask (n,) of the samples that the effect claims as its own events. They are excluded from the
    fit and from the score."""
    variants: tuple[Effect, ...] = ()
    """Other forms of the same physics, or other places in the equations (hysteresis as a force), with the same name and
    another equation."""
    other_laws: tuple[Effect, ...] = ()
    """Other laws with the same parameters in the same order, which are fitted once the effect is named: where they fit
    as well, its intervals hold their values, too."""
    fill: Callable[[Array, Array, Settings], Mapping[str, Array]] | None = None
    """Feedback only: (q, weights, settings) -> packed rows of ``forces.py`` (friction, spring, cogging, ...)."""
    stochastic: bool = False
    """True if the course on unseen data cannot be predicted from parameters alone (random walk, spikes)."""
    predict: Predict | None = None
    """One-step predictor of an effect that is noise. The effect is scored by its prediction errors and not by the
    course that was read off the data."""
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict[str, tuple[float, float]])
    """Ranges of human parameters (``report``) outside of which the effect is other physics in disguise. They are
    checked before it is named."""
    forbidden: Mapping[str, tuple[tuple[float, float], ...]] = field(
        default_factory=dict[str, tuple[tuple[float, float], ...]]
    )
    """Ranges of human parameters that belong to another effect by definition."""
    vanishes_with: tuple[tuple[str, ...], ...] = ()
    """Groups of human parameters (``report``; patterns such as ``amplitude_*``). The effect adds nothing when every
    parameter of any one group is zero, so it is named only where the data exclude that. Empty: one group of all.
    """
    plain_without: tuple[tuple[str, ...], ...] = ()
    """Groups like those of ``vanishes_with``, without any one of which the effect is another, plainer one."""
    plain_in: Mapping[str, tuple[float, float]] = field(default_factory=dict[str, tuple[float, float]])
    """Ranges of human parameters in which the effect is no more than a plainer one (a slew limit that is never met is a
    lag). It is not named while the 95 % interval of one reaches into its range."""
    laws: int = 1
    """Number of simpler laws that the effect joins. It has the price of as many names, or a flexible one would stand
    for every pair of plain ones."""
    estimated: tuple[str, ...] = ()
    """Those of ``limits`` that scatter with the noise: such a parameter is outside only where its 95 % interval is."""
    weights_beside: Callable[[Settings], int] | None = None
    """(settings) -> number of the last weights, which stand beside the effect (a curve without memory, a constant) and
    alone do not show it. None: there are none."""
    essential: tuple[str, ...] = ()
    """Searched parameters that the effect needs: it is not named when one ends at its bound."""
    plain: str = ""
    """Vocabulary name of the simpler effect that this one generalises. It is tried instead when this one is not
    supported by the data."""

    proportional: bool = False
    """True if an effect of kind add or feedback is proportional to the signal, position or velocity. Behind columns of
    simulated output it cannot be distinguished from wrong parameters of the simulation."""

    loses_mean: bool = False
    """True if a constant signal does not pass the effect."""

    shifts_line: bool = False
    """True if it changes a gain, a zero or a linear term alone: it has no place where the simulation's own are
    re-fitted."""

    @property
    def is_linear(self) -> bool:
        """True if the effect maps the signal linearly."""
        return self.kind == "linear" or self.proportional

    @property
    def is_independent(self) -> bool:
        """True if the course depends on no signal of the recording: drifts, steps, walks, lines."""
        return not self.driven and not self.needs and self.available is None

    @property
    def form(self) -> tuple[str, str, str]:
        """Return the key that distinguishes one shape of an effect from another: (name, kind, equation)."""
        return self.name, self.kind, self.equation
