"""Figures and phrases that the terminal and the page share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from tools.mismatch import units
from tools.mismatch.engine.report import (
    BaseShift,
    FitSummary,
    Location,
    OneWay,
    ParameterValue,
    PhysicsFound,
    Report,
    Vouched,
    Withheld,
)

VERDICTS: Mapping[str, str] = {
    "agrees": "Agrees",
    "recalibrate": "Recalibrate",
    "missing_physics": "Missing physics",
    "unexplained": "Unexplained",
}
MEANINGS: Mapping[str, str] = {
    "floor_doubtful": "the noise floor is in doubt: at its upper end nothing is left. Record a thousand samples with"
    " the input at rest, repeat the input, or declare noise_rms or tolerance",
    "fit_failed": "the fit failed, so this says nothing about physics yet. Look at the parameters as given, the units"
    " and the start of the record",
    "place_not_reachable": "this kind of twin can be changed at its inputs and outputs only, and what is left may sit"
    " between them. A twin with its equations (ode, mechanical_axis, state_space with one input) can be tried inside",
    "unknown": "the noise floor is known well enough, the fit holds and every place that this kind of twin has was"
    " tried: no effect of the vocabulary does this",
}
"""Meanings of the verdict ``unexplained``, with the advice for each."""
IMITATED = (
    "the effects below account for all of it down to the noise. The parameters of the simulation behind these columns"
    " cannot be re-fitted, and a wrong one can look the same: a twin with its equations (ode) tells the two apart"
)
"""Meaning of ``place_not_reachable`` where the named effects leave nothing."""
FOLLOWS_NOTHING = (
    "the fit holds and every place that this kind of twin has was tried, but what is left follows no recorded signal."
    " It may be slow noise, a disturbance that is not recorded, or several effects at once: a thousand samples with the"
    " input at rest show what is there without the input"
)
"""Meaning of ``unknown`` where the residual depends on nothing that was recorded."""
ONLY_WHOLE = "certain as a whole; each figure alone may be zero"
UNSURE = 0.75
"""Probability of a name below which an equally good rival is named beside it."""
WELL_KNOWN = 0.3  # half an interval over its value: above this a parameter is poorly known
MUCH = 1.5  # ratio of residual to noise floor above which every report mentions the rest
SHOWABLE = 1.05  # ratio of residual to noise floor below which nothing is left to be explained


def number(value: float | None) -> str:
    """Return three significant digits, without a power of ten up to a million; '-' for an unknown value."""
    return "-" if value is None or not math.isfinite(value) else f"{float(f'{value:.3g}'):g}"


def chance(p: float) -> str:
    """Return a p-value as text, bounded below: no tail of a distribution is known beyond 1e-12."""
    return "p < 1e-12" if p < 1e-12 else f"p = {number(p)}"


_PREFIXES = ((1.0, ""), (1e3, "m"), (1e6, "u"), (1e9, "n"))
_SCALABLE = {"V", "A", "N", "m", "g", "rad", "m/s", "m/s^2", "rad/s"}


def scaled(typical: float, unit: str, file_unit: str = "") -> tuple[float, str]:
    """Return a factor and a unit in which to show a difference, e.g. (1e3, "mV").

    The unit is that of the data file if it differs from ``unit``, else one with an SI prefix that makes ``typical`` at
    least 1 where possible.
    """
    if file_unit and file_unit != unit:
        return units.convert_difference(1.0, unit, file_unit), file_unit
    if unit not in _SCALABLE or not math.isfinite(typical) or typical <= 0:
        return 1.0, unit
    factor, prefix = next(((f, p) for f, p in _PREFIXES if typical * f >= 1.0), _PREFIXES[-1])
    return (factor, prefix + unit) if typical < 0.1 else (1.0, unit)


def shown_in(fit: FitSummary, output: str, typical: float) -> tuple[float, str]:
    """Return a factor and a unit in which to show differences of an output (``scaled``)."""
    return scaled(typical, fit.unit.get(output, ""), fit.file_unit.get(output, ""))


def percent(share: float | None) -> str:
    """Return a share as a percentage, '-' for an unknown one: a digit below 1 %, no more than three above 10 000 %."""
    if share is None or not math.isfinite(share):
        return "-"
    size = abs(100 * share)
    return f"{100 * share:{'.0f' if size == 0 or 0.95 <= size < 1e4 else '.1g' if size < 1 else '.3g'}} %"


def words(name: str) -> str:
    """Return the name of an effect for running text."""
    return name.replace("_", " ")


def label(name: str, unit: str) -> str:
    """Return a parameter's name without its unit: 'time_constant_s' in s is 'time constant'."""
    short = name[: -len(unit) - 1] if name.lower().endswith(f"_{unit.lower()}") else name
    return words(short)


def place_before_output(p: PhysicsFound) -> str:
    """Return the input that an effect changes, or its place inside the twin; "" at outputs."""
    if p.site == "input":
        return f"the input {p.target}"
    return p.target if p.site == "feedback" and p.target not in p.outputs else ""


def interval(p: ParameterValue) -> tuple[str, str, str]:
    """Return the interval of an estimate (see ``interval_of``)."""
    return interval_of(p.value, p.ci95)


def interval_of(value: float, ci95: tuple[float, float]) -> tuple[str, str, str]:
    """Return a value and both ends of its interval, with as many digits as the interval justifies."""
    lo, hi = ci95
    half = (hi - lo) / 2
    if not all(map(math.isfinite, (value, lo, hi))) or half <= 0:
        return f"{value:.4g}", number(lo), number(hi)
    size = max(abs(value), abs(lo), abs(hi))
    digits = min(max(math.floor(math.log10(size)) - math.floor(math.log10(half)) + 2, 2), 6)
    if 1e-4 <= size < 1e6:
        places = max(0, digits - 1 - math.floor(math.log10(size)))
        return f"{value:.{places}f}", f"{lo:.{places}f}", f"{hi:.{places}f}"
    return f"{value:.{max(digits, 3)}g}", f"{lo:.{digits}g}", f"{hi:.{digits}g}"


def poorly_known(p: ParameterValue) -> float | None:
    """Return half the interval over the value if that exceeds ``WELL_KNOWN``, else None."""
    half = (p.ci95[1] - p.ci95[0]) / 2
    if not math.isfinite(half) or p.value == 0:
        return None
    share = half / abs(p.value)
    return share if share > WELL_KNOWN else None


def explained(fit: FitSummary, output: str) -> float | None:
    """Return the share of the re-fitted residual above the noise that the physics explains; None without any."""
    before, after = fit.recalibrated_rms[output], fit.fitted_rms[output]
    noise = fit.noise_floor_rms[output]
    if not before > SHOWABLE * noise:
        return None
    return min(max((before**2 - after**2) / (before**2 - noise**2), 0.0), 1.0)


def windows(location: Location, most: int = 6) -> str:
    """Return the time windows in one line."""
    if not location.windows:
        return "none"
    text = ", ".join(f"{number(w.start_s)} to {number(w.stop_s)} s" for w in location.windows[:most])
    more = len(location.windows) - most
    return text + (f" and {more} more" if more > 0 else "")


def follows(location: Location) -> str:
    """Return what the residual follows, by signal, e.g. 'load (value 49 %, recent history 22 %)'."""
    by: dict[str, list[str]] = {}
    for d in location.depends_on:
        by.setdefault(d.signal, []).append(f"{d.feature} {percent(d.strength)}")
    return "; ".join(f"{s} ({', '.join(v)})" for s, v in by.items()) or "nothing that was recorded"


def base_rows(report: Report) -> tuple[BaseShift, ...]:
    """Return the base parameters under the names of the twin's file, if the engine gave them."""
    return report.fit.base_human or report.fit.base_parameters


def guilty_stages(report: Report) -> tuple[str, ...]:
    """Return the stages to mark in the chain: those with physics, or the guessed place of the rest."""
    found = tuple(dict.fromkeys(p.stage for p in report.physics))
    if report.verdict == "missing_physics":
        return found
    return tuple(dict.fromkeys((*found, report.location.stage))) if report.verdict == "unexplained" else ()


def cautions(report: Report) -> list[str]:
    """Return the cautions about a verdict: the checks' messages, and a residual that no verdict covers."""
    out = list(report.checks.messages)
    if report.one_way is not None:
        out.append(one_way(report.one_way))
    step = step_s(report)
    for p in report.physics:
        delay = p.parameters.get("delay_s")
        if step and delay is not None and abs(delay.value - 0.5 * step) < 0.1 * step:
            out.append(
                f"{words(p.name)} of {p.output} is half a sample: an input that is held where the twin takes it as"
                " linear, or the other way round, looks the same"
            )
    if report.verdict != "unexplained":
        f = report.fit
        for o, noise in f.noise_floor_rms.items():
            most = max(noise, f.noise_floor_interval.get(o, (noise, noise))[1])
            if noise > 0 and f.fitted_rms[o] > max(MUCH * most, f.tolerance.get(o, 0.0)):
                out.append(f"what is left in {o} is {number(f.fitted_rms[o] / most)} times the noise floor")
    for o in report.doubtful:
        factor, unit = shown_in(report.fit, o, report.fit.noise_floor_interval[o][1])
        out.append(
            f"the noise of {o} may be {floor_of(report.fit, o, factor)} {unit}: the verdict is that of the upper end"
        )
    return out


def floor_of(fit: FitSummary, output: str, factor: float) -> str:
    """Return the noise floor of an output: a figure, or both ends of its interval if they differ by half or more."""
    lo, hi = fit.noise_floor_interval.get(output, (math.nan, math.nan))
    if math.isfinite(lo) and math.isfinite(hi) and hi > 1.5 * lo:
        return f"{number(lo * factor)} to {number(hi * factor)}"
    return number(fit.noise_floor_rms[output] * factor)


def one_way(found: OneWay) -> str:
    """Return the question that a load which moved one way leaves open, and the reversal that would answer it."""
    way = "forwards" if found.direction > 0 else "backwards"
    text = f"{found.output} only ever moved {way}: dry friction would show as an offset of the force"
    if found.offset is not None:
        value, lo, hi = interval(found.offset)
        p = found.offset
        text += f", which moved by {value} ({lo} .. {hi}) {p.unit} when re-fitted"
        against = p.value * found.direction < 0 and not p.ci95[0] <= 0.0 <= p.ci95[1]
        text += ": that may be friction of this size" if against else ""
    return f"{text}; record a reversal of {number(found.reversal)} {found.unit} or more"


_HOLDS = {
    "declared": "as declared",
    "inferred": "read off the data",
    "assumed": "assumed: the data do not tell",
    "instead_of_delay": "a delay of half a sample was this and no dead time",
}


def hold(report: Report) -> str:
    """Return a line on the course of inputs between their samples; "" for a twin without memory."""
    by: dict[str, list[str]] = {}
    for s, h in report.hold.items():
        kind = "held" if h.kind == "zero" else h.kind
        by.setdefault(f"{kind} between samples ({_HOLDS[h.how]})", []).append(s)
    return "; ".join(f"{', '.join(of)} {kind_text}" for kind_text, of in by.items())


def meaning(report: Report) -> str:
    """Return the meaning of ``unexplained`` on this recording; "" for the other verdicts."""
    text = IMITATED if leaves_nothing(report) else MEANINGS.get(report.meaning, "")
    if report.meaning == "unknown" and not report.location.depends_on:
        text = FOLLOWS_NOTHING
    return f"{text}: {'; '.join(report.trouble)}" if report.trouble and text else text


def leaves_nothing(report: Report) -> bool:
    """Return True if a report is ``unexplained`` although its effects leave only noise: the place alone is in doubt."""
    f = report.fit
    ends = {o: max(v, f.noise_floor_interval.get(o, (v, v))[1]) for o, v in f.noise_floor_rms.items()}
    within = all(f.fitted_rms[o] <= max(MUCH * end, f.tolerance.get(o, 0.0)) for o, end in ends.items())
    return report.meaning == "place_not_reachable" and bool(report.physics) and within


def physics_title(report: Report) -> str:
    """Return the heading of the named effects."""
    if report.verdict == "missing_physics":
        likely = any(p.confidence > 0.5 for p in report.physics)
        return "What is missing" if likely else "What may be missing: no name is likelier than not"
    return "What would explain it" if leaves_nothing(report) else "What explains a part of it"


def sure(report: Report, p: PhysicsFound) -> str:
    """Return how sure a name is, and the names with which it shares the probability because they fit as well."""
    text = f"sure {percent(p.confidence)}"
    rivals = [words(n) for e in report.equivalent if p.name in e.names for n in e.names if n != p.name]
    if not rivals or p.confidence >= UNSURE:
        return text
    fit = "fits" if len(rivals) == 1 else "fit"
    return f"{text}, a probability shared with {', '.join(dict.fromkeys(rivals))}, which {fit} as well"


def vouched(known: Vouched) -> str:
    """Return why no name is surer."""
    return (
        f"no name is surer than {percent(known.most)}: on machines of people who did not write the engine"
        f" {known.right} of {known.names} names above 50 % were right"
    )


def spans(of: Sequence[tuple[int, int]], dt_s: float) -> str:
    """Return sample ranges as times, e.g. '0 to 12.5 s, 14 to 30 s'."""
    return ", ".join(f"{number(a * dt_s)} to {number(b * dt_s)} s" for a, b in of) or "none"


def step_s(report: Report) -> float | None:
    """Return the time step in s from the pictures; None without them."""
    p = report.pictures
    if p is None or p.t.size < 2:
        return None
    return float(min(p.t[i + 1] - p.t[i] for i in range(min(p.t.size - 1, 16))))


UNSEALED = MappingProxyType(
    {
        "short": "the recording is too short to spare a part",
        "own_split": "the recording says what is fitted and what is tested",
        "several_recordings": "each recording is left out in turn instead",
    }
)


def data_parts(report: Report) -> list[tuple[str, str]]:
    """Return rows on the parts of the recording that were fitted, held out and sealed, and the sealed part's scores."""
    f, dt_s = report.fit, step_s(report)
    say = lambda of: f"samples {list(of)}" if dt_s is None else spans(of, dt_s)  # noqa: E731
    rows = [("fitted on", say(f.fit_spans)), ("held out", say(f.held_out_spans))]
    if f.sealed is None:
        return rows
    if f.sealed.span is None:
        return [*rows, ("sealed", f"nothing: {UNSEALED[f.sealed.why]}")]
    rows.append(("sealed", f"{say([f.sealed.span])}: scored once, after everything was decided"))
    for o, last in f.sealed.fitted_rms.items():
        given, again = f.sealed.base_rms[o], f.sealed.recalibrated_rms[o]
        factor, unit = shown_in(f, o, again)
        figures = f"{number(given * factor)} as given, {number(again * factor)} re-fitted"
        if report.physics:
            figures += f", {number(last * factor)} with physics"
        rows.append((f"  {o}", f"{figures} ({unit} rms)"))
    return rows


def before_after(p: PhysicsFound, fit: FitSummary) -> str:
    """Return how much an effect lowers the held-out residual of its output."""
    factor, unit = shown_in(fit, p.output, max(p.residual_rms_before, p.residual_rms_after))
    without, within = number(p.residual_rms_before * factor), number(p.residual_rms_after * factor)
    return f"{without} without it, {within} with it ({unit} rms, held out)"


def why_withheld(w: Withheld, fit: FitSummary) -> str:
    """Return why an effect that lowered the residual is not named, with the figures that show it."""
    names = ", ".join(words(n) for n in w.shown_by)
    if w.reason == "below_tolerance":
        why = "the difference that it makes is below your tolerance"
    elif w.reason == "at_limit":
        why = f"{names} ended at a limit of the search"
    elif w.reason == "no_better":
        why = "a run through the whole recording is no better with it"
    elif w.reason == "unlikely":
        why = "beside what is left unexplained it is too likely to be wrong"
    elif w.reason == "follows_signal":
        why = f"it depends on no signal, but what it explains follows {names}"
    else:
        sizes = []
        for n in w.shown_by[:3]:
            p = w.parameters[n]
            value, lo, hi = interval(p)
            sizes.append(f"{label(n, p.unit)} {value} ({lo} .. {hi}) {'' if p.unit == '1' else p.unit}".rstrip())
        what = "its size may be zero" if w.reason == "holds_zero" else "it may be no more than a plainer effect"
        why = f"{what}: {', '.join(sizes)}"
    factor, scaled_unit = shown_in(fit, w.output, max(w.residual_rms_without, w.residual_rms_with))
    without, within = number(w.residual_rms_without * factor), number(w.residual_rms_with * factor)
    instead = f"; {words(w.replaced_by)} is named instead" if w.replaced_by else ""
    return f"{why}; {without} without it, {within} with it ({scaled_unit} rms, held out){instead}"


def rival_remark(ratio: float, as_good: bool, named: str) -> str:
    """Return why a rival is not named.

    ``ratio``: its held-out residual over that of ``named``; ``as_good``: a paired test finds it within the margin.
    """
    if as_good:
        return f"fits as well as {named}"
    return f"leaves {ratio:.2f} times the residual of {named}"
