"""Writes each effect of the vocabulary as lines of numpy: the setup of an exported twin, and the change of a signal."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np

from sim_devices.physics import hysteresis, rate_hysteresis
from sim_devices.physics.axes import vector_of
from sim_devices.physics.effect import Array
from tools.errors import InputError
from tools.mismatch.placed import Placed

PER_FORCE = {
    "{out}/s^2": "{in}",
    "1/s": "{in} s/{out}",
    "1/s^2": "{in}/{out}",
    "{out}/s^2/{out}": "{in}/{out}",
    "1/({out} s^2)": "{in}/{out}^2",
    "1/({out}^2 s^2)": "{in}/{out}^3",
    "1/({out}^4 s^2)": "{in}/{out}^5",
    "1/{out}": "{in} s^2/{out}^2",
    "1/({out}^2 s)": "{in} s/{out}^3",
}
"""Maps units of a force's weights per unit of mass to units of force."""


@dataclass
class Writer:
    """Collects the lines of an exported twin.

    ``parameters`` has value and unit under each key; ``setup`` has the lines that run once, ``run`` those that process
    samples; ``used`` lists functions of ``parts``.
    """

    dt: float
    samples: int
    signals: Mapping[str, Array]
    parameters: dict[str, tuple[object, str]] = field(default_factory=dict[str, tuple[object, str]])
    setup: list[str] = field(default_factory=list[str])
    run: list[str] = field(default_factory=list[str])
    used: set[str] = field(default_factory=set[str])

    def part(self, name: str, arguments: str, call: str) -> str:
        """Set up function ``name`` of ``parts`` under a new local name; returns that name."""
        self.used.add(name)
        local = call
        while any(line.startswith(f"{local} = ") for line in self.setup):
            local += "_"
        self.setup.append(f"{local} = {name}({arguments})")
        return local


@dataclass
class Slot:
    """Writes the code of a placed effect: ``at(name)`` is that of a parameter, ``group(stem)`` that of a list."""

    writer: Writer
    placed: Placed
    label: str
    values: Mapping[str, float]
    output: str

    def __post_init__(self) -> None:
        self.place: dict[str, str] = {}
        units = {p.name: p.unit for p in (*self.placed.parts.nonlinear, *self.placed.parts.weights)}
        numbered = re.compile(r"(.*?\D)_?(\d+)$")

        def stem(name: str) -> str:
            m = numbered.fullmatch(name)
            return m[1].rstrip("_") if m else ""

        for s, run in groupby(self.values, stem):
            names = list(run)
            if s and len(names) > 1:
                self._put(s, [self.values[n] for n in names], units[names[0]])
                self.place |= {n: f'p["{self.label}.{s}"][{i}]' for i, n in enumerate(names)}
                continue
            for n in names:
                self._put(n, self.values[n], units[n])
                self.place[n] = f'p["{self.label}.{n}"]'

    def _put(self, name: str, value: object, unit: str) -> None:
        self.writer.parameters[f"{self.label}.{name}"] = (value, unit)

    def at(self, name: str) -> str:
        """Return the code of a parameter."""
        return self.place[name]

    def group(self, *stems: str) -> str:
        """Return the code of the weights of several lists, one after the other."""
        every = [f'p["{self.label}.{s}"]' for s in stems]
        return every[0] if len(every) == 1 else f"np.concatenate([{', '.join(every)}])"

    def setting(self, name: str) -> float:
        """Return the first number of a setting."""
        return self.placed.settings[name][0]

    def part(self, name: str, arguments: str) -> str:
        """See Writer; the local name contains that of the effect."""
        return self.writer.part(name, arguments, re.sub(r"\W", "_", self.label))


def numbers(values: object) -> str:
    """Return the exact code of numbers (any nesting)."""
    a = np.asarray(values, np.float64)
    if a.ndim == 0:
        return repr(float(a))
    return "[" + ", ".join(numbers(v) for v in a) + "]"


Expression = Callable[[Slot, str, str], str]
"""(slot, signal, driver) -> code of the changed signal."""


def _ac(s: Slot, x: str, d: str) -> str:
    if "period_by_2pi_s" in s.values:
        period, damping = s.at("period_by_2pi_s"), s.at("damping_ratio")
        slow = s.part("mode", f"1 / (2 * np.pi * {period}), {damping}, dt, settled={s.at('settled_share')}")
        return f"{x} - np.array([1, 2 * {damping}]) @ {slow}({x}) + {s.at('zero')}"
    slow = s.part("low_pass", f"{s.at('time_constant_s')}, dt, settled={s.at('settled_share')}")
    return f"{x} - {slow}({x}) + {s.at('zero')}"


def _resonance(s: Slot, x: str, d: str) -> str:
    mode = s.part("mode", f"{s.at('frequency_Hz')}, {s.at('damping_ratio')}, dt")
    weights = f"np.array([{s.at('share')}, {s.at('rate_share')}])"
    return f"(1 - {s.at('share')}) * {x} + {weights} @ {mode}({x})"


def _delay(s: Slot, x: str, d: str) -> str:
    cubic = "delay_s" in s.values
    late = s.at("delay_s" if cubic else "late_s")
    return f"{s.part('resample', f'-{late} / dt, 1.0, 0.0, {cubic}')}({x})"


def _skew(s: Slot, x: str, d: str) -> str:
    if "skew_at_begin_ppm" in s.values:
        bend = f"0.5e-6 * {s.at('skew_change_ppm')} / {s.writer.samples}"
        begin = s.at("skew_at_begin_ppm")
        return f"{s.part('resample', f'0.0, 1 + 1e-6 * {begin}, {bend}, True')}({x})"
    cubic = "skew_ppm" in s.values
    skew = s.at("skew_ppm" if cubic else "apart_ppm")
    return f"{s.part('resample', f'0.0, 1 + 1e-6 * {skew}, 0.0, {cubic}')}({x})"


def _slew(s: Slot, x: str, d: str) -> str:
    if "asymptotic_rate" in s.values:
        rate = s.at("asymptotic_rate")
        lag = s.at("small_signal_s")
        return f"{s.part('slew', f'{rate}, {rate}, {lag}, dt, rounded=True')}({x})"
    up, down = ("rate", "rate") if "rate" in s.values else ("rate_up", "rate_down")
    arguments = ", ".join(s.at(n) for n in (up, down, "time_constant_s"))
    return f"{s.part('slew', arguments + ', dt')}({x})"


def _saturation(s: Slot, x: str, d: str) -> str:
    s.writer.used.add("limit")
    lo, hi = sorted(("lower_limit", "upper_limit"), key=lambda n: s.values[n])
    return f"limit({x}, {s.at(lo)}, {s.at(hi)}, {s.at('corner')})"


def _conduction(s: Slot, x: str, d: str) -> str:
    s.writer.used.add("conducted")
    return f"conducted({x}, {s.at('knee')}, {s.at('width')}, {numbers(s.setting('side'))})"


def _zero(s: Slot, x: str, d: str) -> str:
    return f"{x} + {s.at(s.placed.parts.weights[0].name)}"


def _quantization(s: Slot, x: str, d: str) -> str:
    if s.setting("step") <= 0:
        return x
    s.writer.used.add("rounded")
    return f"rounded({x}, {numbers(s.setting('step'))}, {numbers(s.setting('origin'))}, {s.at('dither_rms')})"


def _elements(s: Slot, d: str) -> str:
    """Return the code of the columns of a hysteresis, (n, elements)."""
    settings = s.placed.settings
    lo, hi = settings["range"]
    half, rest = 0.5 * (hi - lo), numbers(settings["rest"][0])
    form = hysteresis.FORMS[int(settings.get("form", (0.0,))[0])]
    wide = settings.get("wide", (0.0,))[0] > 0
    radii = hysteresis.radii_of(form, half, wide)
    smooth = half * np.geomspace(0.05, 4.0, hysteresis.N_DAHL)
    before = hysteresis.way_before(settings)

    def element(name: str, arguments: str) -> str:
        local = s.part(name, arguments)
        if before is not None:
            s.writer.setup.append(f"{local}(np.array([{rest}, {numbers(before)}]))  # the way before the record")
        return f"{local}({d})"

    def plain() -> str:
        return element("stops", f"{numbers(radii)}, {rest}")

    def soft(radii: Array, skew: Array) -> str:
        return element("dahl", f"np.array({numbers(radii)}), {numbers(skew)}, {rest}")

    n = hysteresis.N_DAHL
    match form:
        case "stops" | "stops_fine":
            return plain()
        case "dahl":
            return soft(smooth, np.zeros(n))
        case "dahl_stops":
            return f"np.hstack([{soft(smooth, np.zeros(n))}, {plain()}])"
        case "dahl_skewed":
            return soft(np.tile(smooth, 3), np.repeat([-0.6, 0.0, 0.6], n))
        case "stops_bent":
            z = f"np.clip(({d} - {numbers(0.5 * (lo + hi))}) / {numbers(half)}, -1.1, 1.1)[:, None]"
            s.writer.used.add("bent")
            return f"bent({plain()}, {z})"
        case "stops_curved":
            s.writer.used.add("curved")
            bent = hysteresis.bent_of(settings) or hysteresis.Bent(lo, hi, (0.0,) * len(radii))
            ends = f"{numbers(bent.low)}, {numbers(bent.high)}"
            return f"curved({plain()}, {d}, {numbers(bent.weights)}, {ends}, {hysteresis.CURVES + 1})"
        case _:
            return element("relays", f"{numbers(lo)}, {numbers(hi)}, {hysteresis.N_GRID}")


def _rate_hysteresis(s: Slot, x: str, d: str) -> str:
    settings = s.placed.settings
    lo, hi = settings["range"]
    half, rest = 0.5 * (hi - lo), numbers(settings["rest"][0])
    radii = hysteresis.thresholds(half, rate_hysteresis.N_PLAYS)
    wide = half * np.geomspace(0.1, 3.0, rate_hysteresis.N_DAHL)
    plays = s.part("stops", f"{numbers(radii)}, {rest}")
    soft = s.part("dahl", f"np.array({numbers(wide)}), {numbers(np.zeros(wide.size))}, {rest}")
    before = hysteresis.way_before(settings)
    if before is not None:
        way = f"np.array([{rest}, {numbers(before)}])"
        s.writer.setup += [f"{plays}({way})  # the way before the record", f"{soft}({way})"]
    lag = f"{s.at('time_constant_s')}, dt"
    late, late_x, speed = s.part("low_pass", lag), s.part("low_pass", lag), s.part("slope", "dt")
    s.writer.used.add("loop_with_speed")
    usual = numbers(settings["usual_slope"][0])
    columns = f"loop_with_speed({d}, np.hstack([{plays}({d}), {soft}({d})]), {speed}({d}) / {usual}, {late}, {late_x})"
    keys = ", ".join(f'p["{s.label}.{n}"]' for n in ("w", "v", "l", "lag"))
    weights = f"np.r_[{keys}]"
    return f"{x} + {columns} @ {weights}"


def _creep(s: Slot, x: str, d: str) -> str:
    taus = numbers(s.placed.settings["time_constants_s"])
    # every mode is a separate low-pass that begins at rest
    modes = s.part("low_pass", f"np.array({taus}), dt, rest={s.at('rest')}")
    return f"{x} + {modes}({d}) @ {s.group('c')}"


def _backlash(s: Slot, x: str, d: str) -> str:
    play = s.part("stops", f"[{s.at('half_gap')}], first={s.at('first_in_gap')}")
    return f"{x} - {_lost(s)}{play}({d})[:, 0]"


def _lost(s: Slot) -> str:
    """Return the factor of a slope that is lost in part; none where it is lost whole."""
    return f"{s.at('missing_slope')} * " if "missing_slope" in s.values else ""


def _dead_zone(s: Slot, x: str, d: str) -> str:
    width = s.at("half_width")
    return f"{x} - {_lost(s)}np.clip({d} - {s.at('centre')}, -{width}, {width})"


def _curve(s: Slot, x: str, d: str) -> str:
    if "power" in s.values:
        size = numbers(s.setting("size"))
        return f"{size} * np.abs({x} / {size}) ** {s.at('power')} + {s.at('zero')}"
    lo, hi = s.placed.settings["range"]
    shape = int(s.placed.settings.get("shape", (3.0,))[0])
    middle, half = 0.5 * (lo + hi), 0.5 * (hi - lo)
    z = f"({d} - {numbers(middle)}) / {numbers(half)}"
    straight = f" + {s.at('slope')} * {z}" if "slope" in s.values else ""
    if shape > 1:
        s.writer.used.add("legendre")
        weights = s.group("legendre") if shape > 2 else f"[{s.at('legendre2')}]"
        return f"{x} + legendre({d}, {numbers(lo)}, {numbers(hi)}, {shape}) @ {weights}{straight}"
    knots = np.linspace(-1, 1, len([n for n in s.values if n.startswith("hinge")]) + 2)[1:-1]
    if lo < 0 < hi:
        knots[int(np.argmin(np.abs(knots + middle / half)))] = -middle / half
    kinks = f"np.abs({d}[:, None] - np.array({numbers(middle + half * knots)})) / {numbers(half)}"
    return f"{x} + {kinks} @ {s.group('hinge')}{straight}"


def _warm_up(s: Slot, x: str, d: str) -> str:
    if "rise" in s.values:
        return f"{x} + {s.at('rise')} / (1 + np.exp(-(t - {s.at('middle_s')}) / {s.at('width_s')}))"
    tau = s.at("time_constant_s")
    fast = f" + {s.at('fast')} * np.exp(-t / ({tau} * {s.at('ratio')}))" if "fast" in s.values else ""
    return f"{x} + {s.at('slow')} * np.exp(-t / {tau}){fast}"


def _line(s: Slot, x: str, d: str) -> str:
    knots = s.placed.settings.get("knots_s", (0.0,))
    terms: list[str] = []
    for order in s.placed.settings.get("orders", (1.0,)):
        for wave in ("sin", "cos"):
            name = f"{wave}{int(order)}"
            size = s.at(name) if len(knots) == 1 else f"np.interp(t, {numbers(knots)}, {s.group(name)})"
            terms.append(f"{size} * np.{wave}({2 * int(order)} * np.pi * {s.at('frequency_Hz')} * t)")
    return " + ".join([x, *terms])


def _condition(signal: str, lag: str, name: str) -> Expression:
    def expression(s: Slot, x: str, d: str) -> str:
        change = f'u["{signal}"] - {numbers(s.setting("reference"))}'
        if s.values[lag] > 0.1 * s.writer.dt:
            change = f"{s.part('low_pass', f'{s.at(lag)}, dt')}({change})"
        s.writer.run.append(f"{name} = {change}")
        first, second, *gain = [n for n in s.values if n != lag]
        scale = f" + {s.at(gain[0])} * ({d} - {numbers(s.setting('centre'))})" if gain else ""
        return f"{x} + ({s.at(first)} + {s.at(second)} * {name}{scale}) * {name}"

    return expression


def _current(s: Slot, x: str, d: str) -> str:
    name = next(n for n in ("actuator_current", "current") if n in s.writer.signals)
    return f'{x} + {s.at("per_A")} * u["{name}"] + {s.at("per_A2")} * u["{name}"] ** 2'


def _axes(s: Slot) -> dict[str, str]:
    """Return axis letter -> code of the input vector's component."""
    return {a: f'u["{name}"]' for a, name in vector_of(s.writer.signals).items()}


def _misalignment(s: Slot, x: str, d: str) -> str:
    here = _here(s)
    if "rotation_x" in s.values:
        i = "xyz".index(s.output[-1])
        j, k = "xyz"[(i + 1) % 3], "xyz"[(i + 2) % 3]
        terms = [f" - {s.at(f'rotation_{j}')} * {here[k]}"] if k in here else []
        terms += [f" + {s.at(f'rotation_{k}')} * {here[j]}"] if j in here else []
        return x + "".join(terms)
    return x + "".join(f" + {s.at(n)} * {here[n[-1]]}" for n in s.values)


def _here(s: Slot) -> dict[str, str]:
    """Return axis letter -> code of the vector at the sensor's position."""
    from tools.mismatch.twins.cluster import location

    vector = _axes(s)
    if not s.output.startswith("accel_"):
        return vector
    place = f'R["{location(s.output)}"]'
    whole = f"(np.cross(alpha, {place}) + np.cross(omega, np.cross(omega, {place})))"
    return {a: f"({v} + {whole}[:, {'xyz'.index(a)}])" for a, v in vector.items()}


def _cross_axis(s: Slot, x: str, d: str) -> str:
    vector = _axes(s)
    return x + "".join(f" + {s.at(n)} * {' * '.join(vector[a] for a in n.removeprefix('k_'))}" for n in s.values)


def _scale_variation(s: Slot, x: str, d: str) -> str:
    here, own = _here(s), _axes(s)[s.output[-1]]
    terms: list[str] = []
    for a in dict.fromkeys(n[2] for n in s.values):
        terms.append(f"{s.at(f'k_{a}1')} * {here[a]} + {s.at(f'k_{a}2')} * {here[a]} ** 2")
    return f"{x} + {own} * ({' + '.join(terms)})"


def _soft_iron(s: Slot, x: str, d: str) -> str:
    own = s.output[-1]
    return x + "".join(f" + {s.at(min(own, a) + max(own, a))} * {v}" for a, v in _axes(s).items() if a != own)


def _centripetal(s: Slot, x: str, d: str) -> str:
    from tools.mismatch.twins.cluster import location

    place, axis = f'R["{location(s.output)}"]', "xyz".index(s.output[-1])
    return f"{x} + {s.at('share')} * np.cross(omega, np.cross(omega, {place}))[:, {axis}]"


def _elsewhere(s: Slot, x: str, d: str) -> str:
    axis, shift = "xyz".index(s.output[-1]), f"[{s.at('dx')}, {s.at('dy')}, {s.at('dz')}]"
    turned = f" + np.cross(omega, np.cross(omega, {shift}))" if s.placed.settings["centripetal"][0] else ""
    return f"{x} + (np.cross(alpha, {shift}){turned})[:, {axis}]"


EXPRESSIONS: Mapping[str, Expression] = {
    "hysteresis": lambda s, x, d: f"{x} + {_elements(s, d)} @ {s.group('w')}",
    "rate_dependent_hysteresis": _rate_hysteresis,
    "creep": _creep,
    "backlash": _backlash,
    "dead_zone": _dead_zone,
    "saturation": _saturation,
    "static_nonlinearity": _curve,
    "one_sided_conduction": _conduction,
    "slew_limit": _slew,
    "first_order_lag": lambda s, x, d: f"{s.part('low_pass', s.at('time_constant_s') + ', dt')}({x})",
    "ac_coupling": _ac,
    "resonance": _resonance,
    "dead_time": _delay,
    "misalignment": _misalignment,
    "cross_axis_nonlinearity": _cross_axis,
    "scale_factor_variation": _scale_variation,
    "thermal_drift": _warm_up,
    "temperature_sensitivity": _condition("temperature", "thermal_lag_s", "dT"),
    "supply_sensitivity": _condition("supply", "supply_lag_s", "dV"),
    "current_coupling": _current,
    "soft_iron": _soft_iron,
    "mains_interference": _line,
    "vibration": _line,
    "clock_skew": _skew,
    "quantization": _quantization,
    "centripetal_acceleration": _centripetal,
    "sensor_position_error": _elsewhere,
    "channel_delay": _delay,
    "constant_load": _zero,
    "scale_error": lambda s, x, d: f"(1 + {s.at('gain_error')}) * ({x})",
    "zero_error": _zero,
}
"""Writers of the effects of a signal path. ``FORCES`` has those of forces inside an equation of motion."""


@dataclass(frozen=True)
class ForceCode:
    """Holds the code of a force.

    It consists of ``smooth`` (code in position x and velocity v), ``limit`` of dry friction (code in v and sign),
    ``stiff`` bristles and the ``lean`` of their loop, and elastic elements that yield at ``radii`` with ``springs``.
    """

    smooth: str = ""
    limit: str = ""
    stiff: str = ""
    lean: str = ""
    radii: str = ""
    springs: str = ""


def joined(codes: Sequence[ForceCode]) -> ForceCode:
    """Return the forces at one place as one: sums, and the memory of the force that has one."""
    limit, stiff = (" + ".join(part for c in codes if (part := getattr(c, name))) for name in ("limit", "stiff"))
    lean, radii, springs = (
        next((part for c in codes if (part := getattr(c, name))), "") for name in ("lean", "radii", "springs")
    )
    return ForceCode("".join(c.smooth for c in codes), limit, stiff, lean, radii, springs)


def _friction(s: Slot) -> ForceCode:
    has = s.values.__contains__
    level = s.at("level")
    if has("full_speed"):
        return ForceCode(limit=f"{level} * (1 - np.exp(-((v / {s.at('full_speed')}) ** 2)))")
    limit = level + (f" + sign * {s.at('asymmetry')}" if has("asymmetry") else "")
    if has("extra"):
        if has("decay_speed"):
            fall = f"* np.exp(-abs(v) / {s.at('decay_speed')})"
        elif has("half_speed"):
            fall = f"/ (1 + (v / {s.at('half_speed')}) ** 2)"
        else:
            fall = f"* np.exp(-((v / {s.at('stribeck_speed')}) ** 2))"
        limit += f" + {s.at('extra')} {fall}"
    smooth = f" - {s.at('viscous_asymmetry')} * abs(v)" if has("viscous_asymmetry") else ""
    bent = next((n for n in ("presliding", "yield_distance") if has(n)), "")
    return ForceCode(smooth, limit, f"{level} / {s.at(bent)}" if bent else "", s.at("lean") if has("lean") else "")


def _spring(s: Slot) -> ForceCode:
    powers = {"linear": "x", "quadratic": "x**2", "cubic": "x**3", "quintic": "x**5", "loss": "x**2 * v"}
    return ForceCode("".join(f" - {s.at(n)} * {powers[n]}" for n in s.values))


def _linear_spring(s: Slot) -> ForceCode:
    return ForceCode(f" - {s.at('linear')} * x" + (f" + {s.at('preload')}" if "preload" in s.values else ""))


def _clearance(s: Slot) -> ForceCode:
    inside = f"np.clip(x - {s.at('centre')}, -{s.at('half_gap')}, {s.at('half_gap')})"
    if "joint" in s.placed.effect.acts_on:
        return ForceCode(f" + {s.at('stiffness')} * {inside}")
    return ForceCode(f" - {s.at('stiffness')} * (x - {s.at('centre')} - {inside})")


def _cogging(s: Slot) -> ForceCode:
    waves = [(f"{w}{h}", f"np.{w}({2 * h} * np.pi * x / {s.at('period')})") for h in (1, 2) for w in ("sin", "cos")]
    return ForceCode("".join(f" + {s.at(n)} * {wave}" for n, wave in waves))


def _force_memory(s: Slot) -> ForceCode:
    if "yield_distance" in s.values:
        return _friction(s)
    return ForceCode(radii=numbers(s.placed.settings["thresholds"]), springs=s.group("k"))


FORCES: Mapping[str, Callable[[Slot], ForceCode]] = {
    "hysteresis": _force_memory,
    "coulomb_friction": _friction,
    "stribeck_friction": _friction,
    "cubic_stiffness": _spring,
    "cogging": _cogging,
    "gravity_load": lambda s: ForceCode(f" + {s.at('sine')} * np.sin(x) + {s.at('cosine')} * np.cos(x)"),
    "quadratic_drag": lambda s: ForceCode(f" - {s.at('drag')} * abs(v) * v"),
    "amplitude_dependent_damping": lambda s: ForceCode(f" - {s.at('growth')} * x**2 * v"),
    "clearance": _clearance,
    "constant_load": lambda s: ForceCode(f" + {s.at('load')}"),
    "viscous_friction": lambda s: ForceCode(f" - {s.at('viscous')} * v"),
    "linear_stiffness": _linear_spring,
    "linear_loss": lambda s: ForceCode(f" - {s.at('loss')} * x + {s.at('constant')}"),
}


def written(slot: Slot, x: str, driver: str) -> str:
    """Return the code of a signal ``x`` behind a placed effect. Raises InputError for an effect of a user's package."""
    name = slot.placed.effect.name
    if name not in EXPRESSIONS:
        raise InputError(
            f"{name}: has no numpy form to write; use --out FILE.toml with 'micron mismatch simulate', or FILE.csv"
        )
    return EXPRESSIONS[name](slot, x, driver)


def force(slot: Slot) -> ForceCode:
    """Return the code of a force. Raises InputError as ``written`` does."""
    name = slot.placed.effect.name
    if name not in FORCES:
        raise InputError(f"{name}: has no numpy form to write as a force; use --out FILE.toml or FILE.csv")
    return FORCES[name](slot)
