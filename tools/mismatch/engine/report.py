"""Defines the report: frozen records that mirror section 5 of the contract, and the arrays for pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.jsonable import to_jsonable

Verdict = Literal["agrees", "recalibrate", "missing_physics", "unexplained"]
Meaning = Literal["", "floor_doubtful", "fit_failed", "place_not_reachable", "unknown"]
"""Meaning of the verdict ``unexplained``; "" for the other verdicts."""
WithheldReason = Literal[
    "holds_zero", "holds_plain", "at_limit", "below_tolerance", "unlikely", "follows_signal", "no_better"
]


@dataclass(frozen=True)
class Window:
    start_s: float
    stop_s: float


@dataclass(frozen=True)
class DependsOn:
    """Describes a dependence of the residual.

    ``strength``: share of the residual's variance that follows; ``memory``: history helps beyond the present.
    """

    signal: str
    feature: str
    strength: float
    p_value: float = 0.0
    memory: bool = False


@dataclass(frozen=True)
class Location:
    outputs: tuple[str, ...]
    stage: str
    windows: tuple[Window, ...]
    regime: str
    depends_on: tuple[DependsOn, ...]


@dataclass(frozen=True)
class ParameterValue:
    value: float
    unit: str
    ci95: tuple[float, float]


@dataclass(frozen=True)
class PhysicsFound:
    """Holds an accepted effect. ``apply`` needs ``site``, ``target``, ``outputs``, ``settings`` and ``raw``.

    ``only_whole``: what it adds is certain, and each figure alone may be zero.
    """

    name: str
    output: str
    stage: str
    confidence: float
    parameters: Mapping[str, ParameterValue]
    equation: str
    source: str
    residual_rms_before: float
    residual_rms_after: float
    site: str
    target: str
    outputs: tuple[str, ...]
    settings: Mapping[str, tuple[float, ...]]
    raw: Mapping[str, float]
    note: str = ""
    at_bound: tuple[str, ...] = ()
    only_whole: bool = False


@dataclass(frozen=True)
class Vouched:
    """Counts the ``names`` above a half on strangers' machines, and those of them that were ``right``."""

    names: int
    right: int

    @property
    def most(self) -> float:
        """Return the probability that may be stated at most, by the rule of succession (Laplace 1774)."""
        return (self.right + 1) / (self.names + 2)


@dataclass(frozen=True)
class Withheld:
    """Holds an effect that lowered the residual and is not named.

    ``shown_by``: the parameters (of ``parameters``, or searched ones) whose interval contains zero or the range of a
    plainer effect, or that ended at a limit of the search, or the signal that the course of an independent effect
    follows. ``residual_rms_without`` and ``_with`` are held out; ``replaced_by``: the simpler effect that is named in
    its place.
    """

    name: str
    output: str
    reason: WithheldReason
    parameters: Mapping[str, ParameterValue]
    shown_by: tuple[str, ...]
    residual_rms_without: float
    residual_rms_with: float
    replaced_by: str = ""


HoldKind = Literal["zero", "linear", "smooth"]
HoldHow = Literal["declared", "inferred", "assumed", "instead_of_delay"]


@dataclass(frozen=True)
class Hold:
    """Describes the course of an input between its samples.

    ``kind`` is zero (held), linear or smooth (nothing above half the sampling rate); ``how`` is declared, inferred,
    assumed (the data do not determine it) or instead_of_delay (a named delay of half a sample was the hold).
    ``share``: 0 is linear, 1 the tested alternative: held, or smooth where that was inferred.
    """

    kind: HoldKind
    how: HoldHow
    share: float | None = None
    ci95: tuple[float, float] | None = None


@dataclass(frozen=True)
class OneWay:
    """Describes a load that moved in one ``direction`` only (1 or -1), so that friction acts as an offset.

    ``offset`` of the force is re-fitted less given (None if the twin has no such parameter). ``reversal``: travel, in
    ``unit``, that would distinguish them.
    """

    output: str
    direction: int
    offset: ParameterValue | None
    reversal: float
    unit: str


@dataclass(frozen=True)
class Alternative:
    name: str
    output: str
    residual_rms_after: float
    why_not: str


@dataclass(frozen=True)
class Equivalent:
    names: tuple[str, ...]
    tell_apart_by: str


@dataclass(frozen=True)
class BaseShift:
    """Holds a base parameter as given, re-fitted alone, and re-fitted beside the effects."""

    name: str
    unit: str
    given: float
    alone: float
    with_effects: float
    ci95: tuple[float, float]


@dataclass(frozen=True)
class Sealed:
    """Holds the rms of the residual per output on the end of the recording, which is read only after the decision.

    ``span``: its samples, stop excluded; None if nothing was sealed, and then ``why`` is "short", "own_split" (the
    recording declares the fitted and tested parts) or "several_recordings" (each is left out in turn).
    """

    span: tuple[int, int] | None
    why: str = ""
    base_rms: Mapping[str, float] = field(default_factory=dict[str, float])
    recalibrated_rms: Mapping[str, float] = field(default_factory=dict[str, float])
    fitted_rms: Mapping[str, float] = field(default_factory=dict[str, float])


@dataclass(frozen=True)
class FitSummary:
    unit: Mapping[str, str]
    held_out: bool
    base_rms: Mapping[str, float]
    recalibrated_rms: Mapping[str, float]
    fitted_rms: Mapping[str, float]
    noise_floor_rms: Mapping[str, float]
    noise_method: Mapping[str, str]
    fit_spans: tuple[tuple[int, int], ...]
    held_out_spans: tuple[tuple[int, int], ...]
    base_parameters: tuple[BaseShift, ...]
    noise_floor_interval: Mapping[str, tuple[float, float]] = field(default_factory=dict[str, "tuple[float, float]"])
    tolerance: Mapping[str, float] = field(default_factory=dict[str, float])
    file_unit: Mapping[str, str] = field(default_factory=dict[str, str])
    """Unit of an output in the data file, if it is not ``unit``; reports for people use it."""
    base_human: tuple[BaseShift, ...] = ()
    """Base parameters under the names and units of the twin's file (mass, not its inverse), for people."""
    sealed: Sealed | None = None


@dataclass(frozen=True)
class Checks:
    residual_white_before: bool
    residual_white_after: bool
    false_alarm_p_value: float
    messages: tuple[str, ...] = ()
    memory_p_value: float = 1.0


@dataclass(frozen=True)
class HeldOutRecording:
    """Holds the rms of the residual per output on left-out recordings: base parameters alone, and with physics."""

    names: tuple[str, ...]
    recalibrated_rms: Mapping[str, float]
    fitted_rms: Mapping[str, float]


@dataclass(frozen=True)
class BetweenRecordings:
    """Holds a parameter that was estimated in each recording, to first order.

    ``values`` and ``standard_errors`` are in the order of ``Together.recordings``. ``free``: the parameter was free in
    each; otherwise the recordings share one value.
    """

    name: str
    unit: str
    free: bool
    values: tuple[float, ...]
    standard_errors: tuple[float, ...]


@dataclass(frozen=True)
class Change:
    """Describes a parameter that changes with a condition.

    ``slope`` is in the parameter's unit per unit of the condition (None: the condition is a word), ``relative`` the
    same as a share of the mean; ``p_value`` is corrected for the number of tests; ``same`` are correlated conditions
    that these recordings cannot distinguish from it.
    """

    parameter: str
    condition: str
    slope: float | None
    relative: float | None
    p_value: float
    same: tuple[str, ...] = ()


@dataclass(frozen=True)
class Together:
    """Holds the results on several recordings of one system.

    ``held_out``: one entry per fold; ``rms_recalibrated`` and ``rms_fitted`` over all folds; ``p_value``: one-sided,
    that physics does not help on a left-out recording (None: no effect is named).
    """

    recordings: tuple[str, ...]
    held_out: tuple[HeldOutRecording, ...]
    rms_recalibrated: Mapping[str, float]
    rms_fitted: Mapping[str, float]
    p_value: float | None
    parameters: tuple[BetweenRecordings, ...]
    conditions: Mapping[str, tuple[float | str, ...]]
    changes: tuple[Change, ...]
    tried: int


@dataclass(frozen=True)
class Pictures:
    """Holds arrays for the report, which are not part of the JSON.

    They are time (m,), inputs and, per output, measured, as given, recalibrated, fitted (m,); ``held_out`` (m,) bool;
    ``units`` of the signals.
    """

    t: Array
    held_out: NDArray[np.bool_]
    measured: Mapping[str, Array]
    as_given: Mapping[str, Array]
    recalibrated: Mapping[str, Array]
    fitted: Mapping[str, Array]
    signals: Mapping[str, Array]
    units: Mapping[str, str] = field(default_factory=dict[str, str])


@dataclass(frozen=True)
class Report:
    """Holds the result of ``diagnose``.

    ``chain``: the twin's stages in order; ``corrected_parameters``: the base parameters from which ``corrected_base``
    was written, in the order of ``fit.base_parameters``.
    """

    recording: str
    twin: str
    verdict: Verdict
    summary: str
    location: Location
    physics: tuple[PhysicsFound, ...]
    alternatives: tuple[Alternative, ...]
    equivalent: tuple[Equivalent, ...]
    detection_limit: Mapping[str, Mapping[str, float | None]]
    cannot_show: Mapping[str, str]
    fit: FitSummary
    checks: Checks
    seconds: float
    seed: int
    chain: tuple[str, ...]
    corrected_base: Mapping[str, Any]
    tested: tuple[Mapping[str, Any], ...] = ()
    withheld: tuple[Withheld, ...] = ()
    """Effects that were tried and are not named, with the reason."""
    corrected_parameters: tuple[float, ...] = ()
    meaning: Meaning = ""
    """Meaning of the verdict ``unexplained``."""
    trouble: tuple[str, ...] = ()
    """Failures of the fit, in words."""
    doubtful: tuple[str, ...] = ()
    """Outputs whose verdict would differ at the lower end of the noise floor's interval."""
    hold: Mapping[str, Hold] = field(default_factory=dict[str, Hold])
    """Course of each input of a twin with memory between its samples."""
    one_way: OneWay | None = None
    """Load that moved in one direction only, so that its friction acts as an offset."""
    pictures: Pictures | None = field(default=None, repr=False, compare=False)
    together: Together | None = None
    """Differences between recordings that were diagnosed together."""
    not_tried: str = ""
    """Sentence on the effects that this kind of twin cannot have, and the kind that can."""
    vouched: Vouched | None = None
    """Names on strangers' machines, which limit what is stated for this kind of twin; None: the calibration has it."""

    def to_json(self) -> dict[str, Any]:
        """Return the JSON of the contract, with additional optional keys; numbers are finite or null."""
        body = asdict(Report(**{**{f: getattr(self, f) for f in self.__dataclass_fields__}, "pictures": None}))
        body.pop("pictures")
        if self.together is None:
            body.pop("together")
        if self.vouched is None:
            body.pop("vouched")
        return to_jsonable({"format": 1, **body})
