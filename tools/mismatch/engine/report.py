"""The answer: frozen records that mirror section 5 of the contract, and the arrays that pictures are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hal.jsonable import to_jsonable

Array = NDArray[np.float64]
Verdict = Literal["agrees", "recalibrate", "missing_physics", "unexplained"]
Meaning = Literal["", "floor_doubtful", "fit_failed", "place_not_reachable", "unknown"]
"""What an ``unexplained`` means; "" for the other verdicts."""
WithheldReason = Literal["holds_zero", "at_limit", "below_tolerance", "unlikely"]


@dataclass(frozen=True)
class Window:
    start_s: float
    stop_s: float


@dataclass(frozen=True)
class DependsOn:
    """``strength``: share of the residual's variance that follows; ``memory``: history helps beyond the present."""

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
    """One accepted effect. ``site``, ``target``, ``outputs``, ``settings`` and ``raw`` are what ``apply`` needs."""

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


@dataclass(frozen=True)
class Withheld:
    """An effect that lowered the residual and is not named. ``shown_by``: the parameters (of ``parameters``, or
    searched ones) whose interval holds zero or that ended at a limit of the search. ``residual_rms_without`` and
    ``_with`` are held out; ``replaced_by``: the plainer effect that is named in its place.
    """

    name: str
    output: str
    reason: WithheldReason
    parameters: Mapping[str, ParameterValue]
    shown_by: tuple[str, ...]
    residual_rms_without: float
    residual_rms_with: float
    replaced_by: str = ""


@dataclass(frozen=True)
class Hold:
    """What the inputs do between their samples: ``kind`` zero (held), linear or smooth (nothing above half the sampling
    rate); ``how``: declared, inferred, assumed (the data do not tell) or instead_of_delay (a named delay of half a
    sample was the hold). ``share``: 0 is linear, 1 the other that was tried: held, or smooth where that was inferred.
    """

    kind: Literal["zero", "linear", "smooth"]
    how: Literal["declared", "inferred", "assumed", "instead_of_delay"]
    share: float | None = None
    ci95: tuple[float, float] | None = None


@dataclass(frozen=True)
class OneWay:
    """A load that moved one way only (``direction`` 1 or -1): friction shows as ``offset`` of the force (re-fitted less
    given; None where the twin has no such parameter). ``reversal``: travel, in ``unit``, that would tell.
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
    """A base parameter as given, re-fitted alone, and re-fitted beside the effects."""

    name: str
    unit: str
    given: float
    alone: float
    with_effects: float
    ci95: tuple[float, float]


@dataclass(frozen=True)
class Sealed:
    """Rms of the residual per output on the end of the recording, which nothing read before everything was decided.
    ``span``: its samples, stop excluded; None where nothing was sealed, and ``why``: "short", "own_split" (the
    recording says what is fitted and tested) or "several_recordings" (each is left out in turn).
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
    """Unit of an output in the data file, where it is not ``unit``: people are shown that one."""
    base_human: tuple[BaseShift, ...] = ()
    """The base parameters under the names and units of the twin's file (mass, not its inverse), for people."""
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
    """Rms of the residual per output on recordings that the fit left out: base parameters alone, and with physics."""

    names: tuple[str, ...]
    recalibrated_rms: Mapping[str, float]
    fitted_rms: Mapping[str, float]


@dataclass(frozen=True)
class BetweenRecordings:
    """A parameter estimated in each recording, to first order: ``values`` and ``standard_errors`` in the order of
    ``Together.recordings``. ``free``: it was free in each; otherwise the recordings share one value.
    """

    name: str
    unit: str
    free: bool
    values: tuple[float, ...]
    standard_errors: tuple[float, ...]


@dataclass(frozen=True)
class Change:
    """A parameter that changes with a condition. ``slope`` in the parameter's unit per unit of the condition (None: the
    condition is a word), ``relative`` the same as a share of the mean; ``p_value`` corrected for all that was tried;
    ``same`` conditions that go with it as well and that these recordings cannot tell from it.
    """

    parameter: str
    condition: str
    slope: float | None
    relative: float | None
    p_value: float
    same: tuple[str, ...] = ()


@dataclass(frozen=True)
class Together:
    """Several recordings of one system. ``held_out``: one entry per fold; ``rms_recalibrated`` and ``rms_fitted`` over
    all folds; ``p_value`` one-sided, that physics does not help on a recording that was left out (None: none named).
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
    """Arrays for the report: time (m,), inputs and, per output, measured, as given, recalibrated, fitted (m,);
    ``held_out`` (m,) bool; ``units`` of the signals. Not part of the JSON."""

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
    """What ``diagnose`` says. ``chain``: the twin's stages in order; ``corrected_parameters``: the base parameters that
    ``corrected_base`` was written from, in the order of ``fit.base_parameters``.
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
    """What the verdict ``unexplained`` means."""
    trouble: tuple[str, ...] = ()
    """What went wrong in the fit, in words."""
    doubtful: tuple[str, ...] = ()
    """Outputs whose verdict would be another at the lower end of the noise floor's interval."""
    hold: Mapping[str, Hold] = field(default_factory=dict[str, Hold])
    """Per input of a twin with memory: what it does between its samples."""
    one_way: OneWay | None = None
    """A load that moved one way only, so that its friction shows as an offset."""
    pictures: Pictures | None = field(default=None, repr=False, compare=False)
    together: Together | None = None
    """Several recordings that were diagnosed together: what differs between them."""
    not_tried: str = ""
    """What this kind of twin does not allow to be tried, and which kind would."""

    def to_json(self) -> dict[str, Any]:
        """The JSON of the contract, with optional keys beside; numbers finite or null."""
        body = asdict(Report(**{**{f: getattr(self, f) for f in self.__dataclass_fields__}, "pictures": None}))
        body.pop("pictures")
        if self.together is None:
            body.pop("together")
        return to_jsonable({"format": 1, **body})
