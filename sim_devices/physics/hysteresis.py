"""Rate-independent memory: superpositions of play, Dahl and relay operators, chosen by the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.curve import curve_basis
from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.memory import dahl, relays, stops, thresholds
from sim_devices.physics.statistics import runs, signed_least_squares, thin

N_PLAYS = 10
N_FINE = 20
FORMS = ("stops", "dahl", "dahl_stops", "dahl_skewed", "stops_bent", "relays", "stops_curved", "stops_fine")
"""Bases of columns; ``choose`` selects one by the data. Settings store a form's place here, so new ones are appended.
Each fits loops that the others fit badly:

stops        Prandtl-Ishlinskii, Maxwell-slip, Iwan
stops_fine   the same with twice as many thresholds: few plays whose thresholds lie between those of ``stops``
dahl         smooth elements dz = dx - |dx| z / r: Dahl, Bouc-Wen with exponent one (gamma = 0)
dahl_stops   both
dahl_skewed  dz = dx - (|dx| z + g dx |z|) / r as well: Bouc-Wen at large, loops whose branches differ in bend
stops_bent   stops whose weight varies along the range: Preisach densities, generalised Prandtl-Ishlinskii
relays       smooth relays on a triangular grid (Krasnosel'skii-Pokrovskii): any Preisach operator
stops_curved stops and a curve without memory behind them: modified Prandtl-Ishlinskii (Kuhnen 2003, section 4), loops
             whose middle line is bent
"""

WIDE = (1.3, 1.65)  # half ranges
N_DAHL = 7
N_GRID = 8
ONE_WAY_ROUND = ("stops", "stops_fine", "dahl", "dahl_stops", "relays", "stops_curved")
"""Forms whose elements all have weights of one sign. Every loop, also a minor one, has the same sense of rotation,
because each element dissipates energy (Kuhnen 2003, section 2.2: the weights of plays are not negative)."""
OF_ONE_LOOP = ("stops", "dahl", "dahl_stops", "stops_curved")
"""Forms in which the outer loop determines every minor loop (Masing's rule, about a middle line that may be bent)."""
MASING = OF_ONE_LOOP[:3]
SEVERAL_LOOPS = ("stops", "dahl", "dahl_stops", "stops_fine", "dahl_skewed", "stops_bent", "relays")
CURVES = 2
"""Number of Legendre polynomials, from the second degree, in a curve beside stops."""


def one_loop(x: Array, keep: NDArray[np.bool_]) -> bool:
    """Return True if x (n,) turns at only two levels where ``keep`` is set, so that it shows no minor loops."""
    span = float(np.ptp(x[keep])) if keep.any() else 0.0
    if span == 0.0:
        return False
    turns: list[float] = []
    for a, b in runs(keep):
        v = turning_points(x[a:b], 0.02 * span)
        turns += v
    middle = float(np.median(x[keep]))
    high = np.array([v for v in turns if v > middle])
    low = np.array([v for v in turns if v <= middle])
    if min(high.size, low.size) < 3:
        return False
    return all(float(np.quantile(v, 0.9) - np.quantile(v, 0.1)) < 0.05 * span for v in (high, low))


def turning_points(x: Array, least: float) -> list[float]:
    """Return the values at which x (n,) turns by more than ``least``, without the ends."""
    out: list[float] = []
    top = bottom = float(x[0])
    going = 0
    for v in x.tolist():
        top, bottom = max(top, v), min(bottom, v)
        if going >= 0 and top - v > least:
            if going:
                out.append(top)
            going, bottom = -1, v
        elif going <= 0 and v - bottom > least:
            if going:
                out.append(bottom)
            going, top = 1, v
    return out


@dataclass(frozen=True)
class Bent:
    """Holds the loop (x plus the sum of ``weights`` times elements) that a curve behind it acts on, and its range.

    The loop is read off the data once, so that the curve stays linear in its coefficients.
    """

    low: float
    high: float
    weights: tuple[float, ...] = ()

    def along(self, x: Array, elements: Array) -> Array:
        """Return the loop (n,) for elements (n, k)."""
        return x + elements @ np.array(self.weights) if self.weights else x


def columns(
    x: Array,
    form: str,
    lo: float,
    hi: float,
    rest: float,
    starts: tuple[int, ...],
    *,
    wide_too: bool = False,
    before: float | None = None,
    bent: Bent | None = None,
) -> Array:
    """Return the columns (n, k) of a form.

    No column remembers anything from before a start, except one move from ``rest`` to ``before`` and back.
    ``wide_too`` adds elements wider than half the range. ``bent`` is the loop that a curve behind the elements acts on.
    """
    if before is not None:
        return columns(np.concatenate([[rest, before], x]), form, lo, hi, rest, (0,), wide_too=wide_too, bent=bent)[2:]
    at = np.array(starts, np.int64)
    half = 0.5 * (hi - lo)
    radii = np.array(radii_of(form, half, wide_too))
    wide = half * np.geomspace(0.05, 4.0, N_DAHL)
    match form:
        case "stops" | "stops_fine":
            return stops(x, radii, rest, at)
        case "dahl":
            return dahl(x, wide, np.zeros(N_DAHL), rest, at)
        case "dahl_stops":
            return np.concatenate([dahl(x, wide, np.zeros(N_DAHL), rest, at), stops(x, radii, rest, at)], axis=1)
        case "dahl_skewed":
            skew = np.repeat([-0.6, 0.0, 0.6], N_DAHL)
            return dahl(x, np.tile(wide, 3), skew, rest, at)
        case "stops_bent":
            e = stops(x, radii, rest, at)
            z = np.clip((x - 0.5 * (lo + hi)) / half, -1.1, 1.1)[:, None]
            some = e[:, 1:N_PLAYS:2]
            return np.concatenate([e, some * z, some * z * z], axis=1)
        case "stops_curved":
            e = stops(x, radii, rest, at)
            loop = Bent(lo, hi) if bent is None else bent
            return np.concatenate([e, curve_basis(loop.along(x, e), loop.low, loop.high, CURVES + 1)], axis=1)
        case _:
            return relays(x, lo, hi, N_GRID, at)


def slips_once(lo: float, hi: float, rest: float) -> bool:
    """Return True if a record that begins at ``rest`` makes the widest elements slip; else they are only a gain."""
    return max(hi - rest, rest - lo) > WIDE[0] * 0.5 * (hi - lo)


def radii_of(form: str, half: float, wide_too: bool) -> tuple[float, ...]:
    """Return the thresholds of a form's stops. ``wide_too``: also beyond half the range, where nothing slips once the
    extremes were seen; but a record may start at one of them."""
    count = N_FINE if form == "stops_fine" else N_PLAYS
    return (*thresholds(half, count), *(f * half for f in WIDE if wide_too))


def width_of(form: str, wide_too: bool = False) -> int:
    """Return the number of columns of a form."""
    more = len(WIDE) if wide_too else 0
    return {
        "stops": N_PLAYS + more,
        "stops_fine": N_FINE + more,
        "dahl": N_DAHL,
        "dahl_stops": N_DAHL + N_PLAYS + more,
        "dahl_skewed": 3 * N_DAHL,
        "stops_bent": 2 * N_PLAYS + more,
        "relays": N_GRID * (N_GRID + 1) // 2,
        "stops_curved": N_PLAYS + more + CURVES,
    }[form]


def signs_of(form: str, sign: float, count: int) -> Array:
    """Return the signs (count,) of the weights of a form whose elements have the sign ``sign``; 0 leaves one free."""
    signs = np.full(count, sign if form in ONE_WAY_ROUND else 0.0)
    if form == "stops_curved":
        signs[-CURVES:] = 0.0
    return signs


NEED = 0.93
"""Largest ratio of sums of squares at which a form with more columns, or a history, is preferred."""
BEFORE = (0.25, -0.25, 0.5, -0.5, 1.0, -1.0)
"""Moves before a record that are tried, as fractions of its range."""


@dataclass(frozen=True)
class Chosen:
    """Holds a form of memory and its score.

    ``left`` is the sum of squared prediction errors on left-out blocks; ``before`` is how far x moved before the
    record, if the record shows it; ``sign`` is the sign of all weights, 0 where they may differ.
    """

    left: float
    form: str
    before: float | None
    sign: float
    bent: Bent | None = None


def left_out(
    x: Array, residual: Array, ctx: Context, form: str, lo: float, hi: float, *, before: float | None = None
) -> Chosen:
    """Return the form with its sum of squares on left-out blocks and the sign of its weights."""
    index = thin(ctx.keep, 6000)
    fold = (np.arange(index.size) * 8 // max(index.size, 1)) % 2
    straight = ctx.line(x, index)
    first = float(x[0])
    wide = slips_once(lo, hi, first if before is None else before)
    bent = loop_of(x, residual, ctx, lo, hi, wide=wide, before=before) if form == "stops_curved" else None
    e = columns(x, form, lo, hi, first, ctx.starts, wide_too=wide, before=before, bent=bent).T
    a = np.column_stack([straight, *(ctx.to_output(np.ascontiguousarray(c))[index] for c in e)])

    def left(sign: float) -> float:
        total = 0.0
        for out in (0, 1):
            some, y = a[fold != out], residual[index][fold != out]
            w = signed_least_squares(
                some, y, np.concatenate([np.zeros(straight.shape[1]), signs_of(form, sign, len(e))]), 1e-6
            )
            total += float(np.sum((residual[index][fold == out] - a[fold == out] @ w) ** 2))
        return total

    signs = (-1.0, 1.0) if form in ONE_WAY_ROUND else (0.0,)
    return min((Chosen(left(sign), form, before, sign, bent) for sign in signs), key=lambda c: c.left)


def loop_of(x: Array, residual: Array, ctx: Context, lo: float, hi: float, *, wide: bool, before: float | None) -> Bent:
    """Fit the loop of stops to the output."""
    index = thin(ctx.keep, 6000)
    e = columns(x, "stops", lo, hi, float(x[0]), ctx.starts, wide_too=wide, before=before)
    through = [ctx.to_output(np.ascontiguousarray(c))[index] for c in (x, *e.T)]
    a, y = np.column_stack([np.ones(index.size), *through]), ctx.wanted(x, residual)[index]
    found = [signed_least_squares(a, y, np.r_[0.0, 0.0, np.full(e.shape[1], sign)], 1e-6) for sign in (-1.0, 1.0)]
    w = min(found, key=lambda w: float(np.sum((y - a @ w) ** 2)))
    if w[1] == 0.0:
        return Bent(lo, hi)
    loop = x + e @ (w[2:] / w[1])
    return Bent(float(loop.min()), float(loop.max()), tuple(float(v) for v in w[2:] / w[1]))


def choose(x: Array, residual: Array, ctx: Context, lo: float, hi: float, forms: Sequence[str] = FORMS) -> Chosen:
    """Return the form that predicts left-out blocks best.

    A larger form, or one with a move before the record, is chosen only where it is clearly better (``NEED``). A record
    of several starts begins each of them without such a move.
    """

    def best_of(forms: Sequence[str], before: float | None) -> Chosen:
        best = left_out(x, residual, ctx, forms[0], lo, hi, before=before)
        for form in forms[1:]:
            other = left_out(x, residual, ctx, form, lo, hi, before=before)
            if other.left < NEED * best.left:
                best = other
        return best

    plain = best_of(forms, None)
    if len(ctx.starts) > 1:
        return plain
    ways = [float(x[0]) + share * (hi - lo) for share in BEFORE]
    found = min((best_of(forms[:2], way) for way in ways), key=lambda c: c.left)
    return best_of(forms, found.before) if found.left < NEED * plain.left else plain


def _prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    lo, hi = float(x.min()), float(x.max())
    if hi <= lo:
        lo, hi = lo - 0.5, hi + 0.5
    found = choose(x, residual, ctx, lo, hi, OF_ONE_LOOP if one_loop(x, ctx.keep) else SEVERAL_LOOPS)
    first = float(x[0])
    settings = {
        "range": (lo, hi),
        "rest": (first,),
        "form": (float(FORMS.index(found.form)),),
        "wide": (float(slips_once(lo, hi, first if found.before is None else found.before)),),
        "sign": (found.sign,),
    }
    if found.bent is not None:
        settings["bent"] = (found.bent.low, found.bent.high, *found.bent.weights)
    return settings if found.before is None else settings | {"before": (found.before,)}


def way_before(settings: Settings) -> float | None:
    """Return the value that x had before the record, or ``None`` if the memory of the hysteresis does not show it."""
    return settings["before"][0] if "before" in settings else None


def bent_of(settings: Settings) -> Bent | None:
    """Return the loop that a curve behind the elements acts on, or None if there is no such curve."""
    if "bent" not in settings:
        return None
    low, high, *weights = settings["bent"]
    return Bent(low, high, tuple(weights))


def _wide(settings: Settings) -> bool:
    return settings.get("wide", (0.0,))[0] > 0.0


def _form(settings: Settings) -> str:
    return FORMS[int(settings.get("form", (0.0,))[0])]


def _parts(settings: Settings) -> Parts:
    n = width_of(_form(settings), _wide(settings))
    unit = "{out}" if _form(settings) == "relays" else "{out}/{in}"
    signs = signs_of(_form(settings), settings.get("sign", (0.0,))[0], n)
    weights = tuple(
        Parameter(f"w{i + 1}", unit, 0.0 if s > 0.0 else -np.inf, 0.0 if s < 0.0 else np.inf, scale=0.1)
        for i, s in enumerate(signs)
    )
    return Parts((), weights, 0.05 * np.eye(n))


def _basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    lo, hi = settings.get("range", (-1.0, 1.0))
    rest, before = settings.get("rest", (0.0,))[0], way_before(settings)
    wide, bent = _wide(settings), bent_of(settings)
    return columns(x, _form(settings), lo, hi, rest, ctx.starts, wide_too=wide, before=before, bent=bent)


def loop_width(y_of: Array, turns: int) -> float:
    """Return the largest distance of the two branches over the last of ``turns`` equal cycles, relative to the span."""
    n = y_of.size // turns
    last = y_of[-n:]
    # sample i on the way up meets sample n - i on the way down
    up, down = last[1 : n // 2 + 1], last[n // 2 :][::-1]
    span = float(np.ptp(last)) or 1.0
    return float(np.max(np.abs(up - down)) / span)


CYCLE = 200  # samples; even, so that both branches pass the same places


def test_cycle(lo: float, hi: float) -> Array:
    """Return three slow triangular cycles over the range."""
    t = np.arange(3 * CYCLE) / CYCLE
    return lo + (hi - lo) * (1 - np.abs(2 * (t % 1.0) - 1))


def _report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    lo, hi = settings["range"]
    x = test_cycle(lo, hi)
    wide, bent = _wide(settings), bent_of(settings)
    y = scale * x + columns(x, _form(settings), lo, hi, lo, (0,), wide_too=wide, bent=bent) @ p
    return (Human("loop_width_share", loop_width(y, 3), "1"),)


def _force_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    half = 0.5 * float(np.ptp(x)) or 1.0
    return {"thresholds": tuple(float(half * f) for f in (0.01, 0.03, 0.1, 0.3, 0.6))}


def _force_parts(settings: Settings) -> Parts:
    n = len(settings.get("thresholds", (1.0,)))
    return Parts((), tuple(Parameter(f"k{i + 1}", "{out}/s^2/{out}") for i in range(n)), 0.05 * np.eye(n))


def _force_basis(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    return -stops(x, np.array(settings.get("thresholds", (1.0,))), float(x[0]), np.array(ctx.starts, np.int64))


def _force_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    g = scale or 1.0
    level = float(p @ np.array(settings["thresholds"])) / g
    return (
        Human("force_loop_half_height", level, "{in}"),
        Human("presliding_stiffness", float(p.sum()) / g, "{in}/{out}"),
    )


_FORCE = Effect(
    name="hysteresis",
    summary="elastic-plastic elements on the position (Maxwell-slip)",
    kind="feedback",
    stages=("mechanics", "actuator"),
    parts=_force_parts,
    equation=r"m\ddot x + c\dot x + k x = F - \sum_i k_i\,(x - P_{r_i}[x])",
    source="W. D. Iwan, J. Applied Mechanics 33 (1966) 893, eq. 3; F. Al-Bender et al., IEEE Trans. AC 50 (2005) 1883",
    excitation="reversals of motion at several amplitudes",
    prepare=_force_prepare,
    basis=_force_basis,
    fill=lambda q, w, settings: {"thresholds": np.array(settings["thresholds"]), "memory": np.asarray(w)},
    report=_force_report,
    vanishes_with=(("force_loop_half_height",),),
)

HYSTERESIS = Effect(
    name="hysteresis",
    summary="rate-independent memory: the loop does not change with speed",
    kind="add",
    stages=("actuator", "sensor"),
    parts=_parts,
    equation=r"y = x + \sum_i w_i\,E_i[x],\; E_i = x - P_{r_i}[x]"
    r" \text{ or } \mathrm{d}E_i = \mathrm{d}x - |\mathrm{d}x| E_i / r_i",
    source="K. Kuhnen, Eur. J. Control 9 (2003) 407, eqs. 2-5; Dahl 1976; Krasnosel'skii, Pokrovskii 1989, section 36",
    excitation="reversals at several amplitudes; speeds that differ tell it from rate-dependent memory",
    confusable_with=("backlash", "rate_dependent_hysteresis", "creep", "first_order_lag", "dead_time"),
    prepare=_prepare,
    basis=_basis,
    report=_report,
    variants=(_FORCE,),
    weights_beside=lambda settings: CURVES if _form(settings) == "stops_curved" else 0,
    vanishes_with=(("loop_width_share",),),
    # elements whose loop may be closed are a curve
    plain_in={"loop_width_share": (-np.inf, 0.0)},
    plain="backlash",
)
