"""Writes differential equations of a corrected twin as numpy code, with forces and flows inside them.

The lines take the steps that ``twins.ode_run.run_equations`` takes, so that both runs agree to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sim_devices.physics.effect import Array
from sim_devices.physics.flows import PAIRS, flow_pairs, level_names, storages_of
from sim_devices.physics.heat_loss import CONVECTED, POWER, zero_of
from sim_devices.physics.parameter import RATE_SIGN
from tools.errors import InputError
from tools.guest.equations import (
    ABS,
    ADD,
    ATAN,
    ATAN2,
    COS,
    DIV,
    EXP,
    LEQ,
    LESS,
    LOG,
    MAX,
    MIN,
    MUL,
    NEG,
    PICK,
    POW,
    SIGN,
    SIN,
    SQRT,
    SUB,
    TAN,
    TANH,
    Program,
)  # fmt: skip
from tools.mismatch.export.effects import FORCES, ForceCode, Slot, force, joined, numbers
from tools.mismatch.export.motion import bend_code, sum_code
from tools.mismatch.twins.equations import Programs
from tools.mismatch.twins.ode import OdeTwin
from tools.mismatch.twins.ode_inside import PUSHED, Place
from tools.mismatch.twins.ode_run import STEEP

_CALLS = {
    ABS: "abs", SIGN: "np.sign", SQRT: "np.sqrt", EXP: "np.exp", LOG: "np.log", SIN: "np.sin", COS: "np.cos",
    TAN: "np.tan", TANH: "np.tanh", ATAN: "np.arctan", ATAN2: "np.arctan2", MIN: "np.minimum", MAX: "np.maximum",
    PICK: "np.where",
}  # fmt: skip
_BINARY = {ADD: ("+", 1, 1), SUB: ("-", 1, 2), MUL: ("*", 2, 2), DIV: ("/", 2, 3), POW: ("**", 4, 4)}
_COMPARED = {LESS: "<", LEQ: "<="}
_ARGUMENTS = {ATAN2: 2, MIN: 2, MAX: 2, PICK: 3}
ATOM = 9
LONG = 60  # number of characters above which each derivative has a line of its own
TAKEN = ("s", "h", "t", "u", "p", "dt", "np")
"""Reserved names of the generated lines."""


def program_code(program: Program, names: Mapping[int, str]) -> tuple[list[str], list[str]]:
    """Return assignments of shared subexpressions, and the code of each result. ``names``: code of the variables.

    Operations keep their order, so that rounding is that of the program.
    """
    made = {int(row[1]): row for row in program.operations}
    uses: dict[int, int] = {}

    def count(r: int) -> None:
        uses[r] = uses.get(r, 0) + 1
        if uses[r] == 1 and r in made:
            for a in arguments(r):
                count(a)

    def arguments(r: int) -> list[int]:
        code = int(made[r][0])
        return [
            int(a) for a in made[r][2 : 2 + (2 if code in _BINARY or code in _COMPARED else _ARGUMENTS.get(code, 1))]
        ]

    for r in program.results:
        count(int(r))
    lines: list[str] = []
    known: dict[int, tuple[str, int]] = {}

    def code_of(r: int) -> tuple[str, int]:
        """Return code and its precedence."""
        if r in names:
            return names[r], ATOM
        if r not in made:
            value = float(program.registers[r])
            return (numbers(value), ATOM) if value >= 0.0 else (f"({numbers(value)})", ATOM)
        if r not in known:
            text, level = built(r)
            if uses[r] > 1:
                lines.append(f"w{len(lines) + 1} = {text}")
                text, level = f"w{len(lines)}", ATOM
            known[r] = text, level
        return known[r]

    def within(r: int, least: int) -> str:
        text, level = code_of(r)
        return text if level >= least else f"({text})"

    def built(r: int) -> tuple[str, int]:
        code, given = int(made[r][0]), arguments(r)
        if code in _BINARY:
            sign, left, right = _BINARY[code]
            # the right operand is evaluated first
            return f"{within(given[0], left)} {sign} {within(given[1], max(right, left + 1))}", min(left, 3)
        if code in _COMPARED:
            return f"1.0 * ({within(given[0], 1)} {_COMPARED[code]} {within(given[1], 1)})", 2
        if code == NEG:
            return f"-{within(given[0], 3)}", 1
        return f"{_CALLS[code]}({', '.join(code_of(a)[0] for a in given)})", ATOM

    results = [code_of(int(r))[0] for r in program.results]
    return lines, results


@dataclass(frozen=True)
class Inner:
    """Describes a force or flow for the lines: its place and its slot of parameters."""

    place: Place
    slot: Slot


def _products(factors: Mapping[int, Sequence[str]]) -> dict[int, str]:
    return {r: ") * (".join(parts) for r, parts in factors.items()}


@dataclass
class EquationLines:
    """Writes the lines of an ode twin: ``setup`` defines ``moving(t, drive)``, ``run`` calls it and reads outputs."""

    twin: OdeTwin
    name: Callable[[str], str]
    """Returns the name of a signal in ``run``."""
    substeps: tuple[int, int]
    """Steps per sample, and parts of a step in which a body may stick, slip or turn."""
    gains: Mapping[str, float]
    """Change of the derivative at the place of a force, per unit of the force."""
    values: Array
    """Parameters (p,) of the equations."""

    def __post_init__(self) -> None:
        if not isinstance(self.twin.equations, Programs):
            raise InputError(f"a twin of {self.twin.kind} has no numpy form to write; use --out FILE.toml or FILE.csv")
        self.programs = self.twin.equations
        self.signals = tuple(self.twin.inputs)
        self.following: list[Inner] = []

    def see(self, inner: Sequence[Inner]) -> list[str]:
        """Return the context signals that equations or parameters follow; the lines take these and the inputs."""
        first = 1 + len(self.twin.state_list)
        self.following = [one for one in inner if one.place.kind in ("parameter", "state")]
        seen = {int(one.slot.placed.settings[PAIRS][1]) for one in self.following}
        for program in (self.programs.rates_program, self.programs.outputs):
            seen |= {int(r) for r in (*program.operations[:, 2:].flat, *program.results)}
        contexts = [s for i, s in enumerate(self.twin.signals, first) if s not in self.twin.inputs and i in seen]
        self.signals = (*self.twin.inputs, *contexts)
        return contexts

    def _variables(self, states: Sequence[str], signals: Sequence[str], swayed: Mapping[int, str]) -> dict[int, str]:
        every = ["t", *states, *signals, *(f'p["{n}"]' for n in self.twin.names)]
        return {i: f"({n} * ({swayed[i]}))" if i in swayed else n for i, n in enumerate(every)}

    def _followed(self, names: Sequence[str]) -> dict[int, list[str]]:
        """Return the factors of the parameters that follow one of ``names`` (states and signals), by register."""
        out: dict[int, list[str]] = {}
        for one in self.following:
            parameter, signal = (int(v) for v in one.slot.placed.settings[PAIRS])
            centre = numbers(one.slot.setting("centre"))
            over = f"({names[signal - 1]} - {centre})"
            law = f"1 + {one.slot.at('per_unit')} * {over}"
            if one.place.kind == "state":
                law = f"np.exp({one.slot.at('per_unit')} * {over} + {one.slot.at('per_square')} * {over}**2)"
            out.setdefault(parameter, []).append(law)
        return out

    def run(self) -> list[str]:
        """Return the lines that turn inputs into outputs."""
        signals = [self.name(s) for s in self.twin.signals]
        drive = ", ".join(self.name(s) for s in self.signals)
        lines = [f"x = moving(t, np.stack([{drive}], axis=1))"]
        columns = [f"x[:, {i}]" for i in range(len(self.twin.state_list))]
        changed = _products(self._followed([*columns, *signals]))
        shared, read = program_code(self.programs.outputs, self._variables(columns, signals, changed))
        lines += shared
        # all inputs are read before an output of the same name may hide them
        # outputs that depend on parameters alone need a value at every instant, too
        each = [r if "x[:" in r else f"{r} + 0 * t" for r in read]
        return [*lines, f"{', '.join(self.name(o) for o in self.twin.outputs)} = {', '.join(each)}"]

    def setup(self, inner: Sequence[Inner]) -> list[str]:
        """Return the lines that define equations and steps; they continue where the last call stopped."""
        twin = self.twin
        states = [f"{s.name}_" if s.name in TAKEN else s.name for s in twin.state_list]
        signals = [f"{s}_" if s in TAKEN else s for s in twin.signals]
        given = [n for n, s in zip(signals, twin.signals, strict=True) if s in self.signals]
        swayed = self._followed([*states, *signals])
        turned: set[int] = set()
        for one in inner:
            if one.place.kind == "direction":
                parameter, state, way = (int(v) for v in one.slot.placed.settings[PAIRS])
                turned |= {state} if way == RATE_SIGN else set()
                sign = f"way_{state}" if way == RATE_SIGN else f"np.sign({states[state - 1]})"
                swayed.setdefault(parameter, []).append(f"1 + {one.slot.at('relative_change')} * {sign}")
        changed = _products(swayed)
        shared, rates = program_code(self.programs.rates_program, self._variables(states, signals, changed))
        sub, _ = self.substeps
        h = "dt" if sub == 1 else f"dt / {sub}"
        lines = [f'h, s, before, began = {h}, np.array(p["start"]), None, 0.0']
        lines += ["", "def derivatives(t, s, u):", f"    {_unpacked(states)} = s", f"    {_unpacked(given)} = u"]
        if turned:
            still, plain = program_code(self.programs.rates_program, self._variables(states, signals, {}))
            ways = [f"way_{j} = np.sign({plain[j - 1]})" for j in sorted(turned)]
            lines += [f"    {line}" for line in (*still, *ways)]
        lines += [f"    {line}" for line in shared]
        flows = [line for one in inner for line in self._flow(one)]
        moved = [one for one in inner if one.place.kind in PUSHED]
        pushes, more = self._forces(moved)
        if sum(map(len, rates)) > LONG:
            lines += [f"    rate_{i + 1} = {r}" for i, r in enumerate(rates)]
            rates = [f"rate_{i + 1}" for i in range(len(rates))]
        if not flows and not pushes:
            lines.append(f"    return np.array([{', '.join(rates)}])")
        else:
            lines += [f"    rates = np.array([{', '.join(rates)}])", *(f"    {line}" for line in (*flows, *pushes))]
            lines.append("    return rates")
        return [*lines, *more]

    def _flow(self, one: Inner) -> list[str]:
        name = one.slot.placed.effect.name
        if one.place.kind not in ("storage", "storages"):
            return []
        if name in FORCES:
            at, smooth = one.place.target, force(one.slot).smooth.removeprefix(" +")
            return [f"x = s[{at}]", f"rates[{at}] +={smooth}"] if "x" in smooth else [f"rates[{at}] +={smooth}"]
        lines: list[str] = []
        settings = one.slot.placed.settings
        if name == "nonlinear_heat_loss":
            return [self._heat(one)]
        names = level_names("empty_level" if name == "square_root_outflow" else "level", settings)
        levels = dict(zip(storages_of(settings), names, strict=True))
        for weight, (a, b) in zip(one.slot.placed.parts.weights, flow_pairs(settings), strict=True):
            over = f"max(s[{a}] - {one.slot.at(levels[a])}, 0.0)"
            flow = f"np.sqrt({over})" if name == "square_root_outflow" else over
            lines.append(f"rates[{b}] {'-' if a == b else '+'}= {one.slot.at(weight.name)} * {flow}")
        return lines

    def _heat(self, one: Inner) -> str:
        """Return the line that takes heat from a state."""
        settings, loss, at = one.slot.placed.settings, one.slot.at("loss"), f"s[{one.place.target}]"
        if one.slot.placed.effect.equation == CONVECTED.equation:
            over = f"({at} - {one.slot.at('surroundings')})"
            return f"rates[{one.place.target}] -= {loss} * {over} * abs({over}) ** {POWER - 1.0}"
        zero, (low, _) = zero_of(settings), settings["range"]
        return f"rates[{one.place.target}] -= {loss} * (max({at} - {zero}, 0.0) ** 4 - {max(low - zero, 0.0) ** 4})"

    def _forces(self, moved: Sequence[Inner]) -> tuple[list[str], list[str]]:
        """Return the lines inside ``derivatives`` (``s``: states, ``h``: step), and those that define the steps."""
        by: dict[str, list[ForceCode]] = {}
        at: dict[str, Place] = {}
        for one in moved:
            by.setdefault(one.place.name, []).append(force(one.slot))
            at[one.place.name] = one.place
        pushes: list[str] = []
        special = [n for n, codes in by.items() if any(c.limit or c.stiff or c.radii for c in codes)]
        if len(special) > 1:
            raise InputError("friction or memory at several states has no numpy form; use --out FILE.toml or FILE.csv")
        for name, codes in by.items():
            place, gain = at[name], numbers(self.gains[name])
            smooth = "".join(c.smooth for c in codes).strip()
            springs = next((c.springs for c in codes if c.springs), "")
            terms = sum_code(smooth) if smooth else ""
            if springs:
                terms += f"{' ' if terms else ''}- springs @ np.clip(x - held, -radii, radii)"
            if terms:
                pushes += self._push(place, f"{gain} * ({terms})")
        if not special:
            return pushes, self._moving(None, [])
        return pushes, self._moving(at[special[0]], by[special[0]])

    def _push(self, place: Place, push: str) -> list[str]:
        """Return the lines that add a force, in terms of x and v, to one derivative, or to those of a joint."""
        if place.kind != "joint":
            return [f"x, v = s[{place.position}], s[{place.velocity}]", f"rates[{place.target}] += {push}"]
        other, speed, target = (int(i) for i in place.pairs[:3])
        ratio, back = numbers(place.pairs[3]), numbers(self.twin.reaction(place, self.values))
        return [
            f"x, v = s[{place.position}] - {ratio} * s[{other}], s[{place.velocity}] - {ratio} * s[{speed}]",
            f"push = {push}",
            f"rates[{place.target}] += push",
            f"rates[{target}] += {back} * push",
        ]

    def _moving(self, place: Place | None, codes: Sequence[ForceCode]) -> list[str]:
        """Return the lines of ``moving(t, drive)``. ``codes``: the forces at ``place`` that a Runge-Kutta step alone
        cannot take, because they stick or remember."""
        found = joined(codes)
        names, lines = self._memory(place, found)
        whole = "" if self.substeps[1] == 1 else ", whole"
        lines += ["", f"def step(t, s, ua, ub, uc{whole}):  # Runge and Kutta, fourth order", *self._step(place, found)]
        names = [*names, *(["h"] if whole else [])]
        return [*lines, "", "def moving(t, drive):", f"    nonlocal {', '.join(names)}", *self._course(place, found)]

    def _memory(self, place: Place | None, found: ForceCode) -> tuple[list[str], list[str]]:
        """Return the names that keep their values from step to step, and the lines that define them and the forces."""
        names, lines = ["s", "before", "began"], list[str]()
        if place is None:
            return names, lines
        gain = numbers(self.gains[place.name])
        if found.radii:
            names.append("held")
            lines.append(f"radii, springs = np.array({found.radii}), np.array({found.springs})")
            lines.append(f"held = s[{place.position}] + 0 * radii  # where each elastic element is at rest")
        if found.limit:
            lines += ["", "def limit(v, sign):", f"    return {gain} * ({found.limit})"]
        if found.stiff:
            names.append("bristle")
            bend = bend_code(found.lean, "def bend(z, v, since):", "since")
            lines += [f"stiff, bristle, bent = {gain} * ({found.stiff}), 0.0, 0.0", "", *bend]
        return names, lines

    def _step(self, place: Place | None, found: ForceCode) -> list[str]:
        """Return the body of ``step``, which returns the states a step ``h`` later."""
        sticks = place is not None and bool(found.limit) and not found.stiff
        lines: list[str] = []
        if place is not None and found.stiff:
            lines += [
                "    nonlocal bent", "",
                "    def slope(t, s, u, since, mean):  # the bristle bends with the mean speed since the begin",
                "        rates = derivatives(t, s, u)",
                f"        rates[{place.velocity}] -= stiff * bend(bristle, mean, since)",
                "        return rates", "",
            ]  # fmt: skip
        elif place is not None and sticks:
            i = place.velocity
            lines += [
                f"    v, push = s[{i}], derivatives(t, s, ua)[{i}]",
                "    sign = 1.0 if (v or push) > 0 else -1.0",
                "    stuck = v == 0 and abs(push) <= limit(0.0, sign)", "",
                "    def slope(t, s, u):  # the direction of slip is fixed within a step",
                "        rates = derivatives(t, s, u)",
                f"        rates[{i}] = 0.0 if stuck else rates[{i}] - sign * max(limit(s[{i}], sign), 0.0)",
                "        return rates", "",
            ]  # fmt: skip
        slope = "slope" if lines else "derivatives"
        ends = ["", "", "", ""]
        if place is not None and found.stiff:
            v = f"s[{place.velocity}]"
            ends = [f", 0.0, {v}", f", h / 2, {v}"]
            ends += [f", {since}, {v} + h / 2 * {r}[{place.velocity}]" for since, r in (("h / 2", "a"), ("h", "b"))]
        lines += [
            f"    a = {slope}(t, s, ua{ends[0]})",
            f"    b = {slope}(t + h / 2, s + h / 2 * a, ub{ends[1]})",
            f"    c = {slope}(t + h / 2, s + h / 2 * b, ub{ends[2]})",
            f"    d = {slope}(t + h, s + h * c, uc{ends[3]})",
            "    z = s + h / 6 * (a + 2 * b + 2 * c + d)",
        ]
        if place is not None and found.stiff:
            i = place.velocity
            lines += [
                f"    mean = s[{i}] + h / 6 * (a[{i}] + b[{i}] + c[{i}])",
                "    bent = bend(bristle, mean, h)",
            ]
            if self.substeps[1] > 1:
                lines += [
                    f"    turns = z[{i}] * np.sign(s[{i}]) < abs(z[{i}] - s[{i}])",
                    f"    much = stiff * abs(bent - bristle) > {STEEP} * limit(mean, 1.0 if mean > 0 else -1.0)",
                    "    if whole and (turns or much):  # in parts",
                    "        return None",
                ]
        if place is not None and sticks:
            i = place.velocity
            if self.substeps[1] > 1:
                lines += [
                    f"    change = abs(z[{i}] - v)",
                    f"    turns = z[{i}] * sign < change",
                    f"    steep = abs(limit(z[{i}], sign) - limit(v, sign)) * h > {STEEP} * change",
                    "    if whole and not stuck and (turns or steep):  # in parts",
                    "        return None",
                ]
            lines += [
                f"    if stuck or z[{i}] * sign < 0:  # does the rest of the step move it again?",
                f"        crossed = 1.0 if stuck else v / (v - z[{i}])",
                "        rest = z.copy() if stuck else s + crossed * (z - s)",
                f"        rest[{i}] = 0.0",
                f"        after = derivatives(t + h, rest, uc)[{i}]",
                "        over = abs(after) - limit(0.0, 1.0 if after > 0 else -1.0)",
                *(["        if whole and over > 0:", "            return None"] if self.substeps[1] > 1 else []),
                "        part = 0.5 * min(over / (abs(after - push) or 1.0), 1.0) if stuck else 1.0 - crossed",
                f"        z[{i}] = np.sign(after) * max(over, 0.0) * part * h",
            ]
        return [*lines, "    return z"]

    def _course(self, place: Place | None, found: ForceCode) -> list[str]:
        """Return the body of ``moving``, which returns the states at every sample of ``drive``."""
        sub, fine = self.substeps
        parts = sub * fine
        again = f"for j in range({sub} if before is not None else 0):"
        head = ["if before is not None:" if sub == 1 else again]
        if fine > 1:
            head = [f"done, until = 0 if before is not None else {parts}, 0", f"while done < {parts}:"]
        body = self._one_step()
        if fine > 1:
            width = f"width = 1 if done < until else {fine}"
            body = [
                width,
                f"h = dt * width / {parts}",
                *body,
                "if z is None:",
                "    until = done + width",
                "    continue",
            ]
        if place is not None and found.stiff:
            body.append("bristle = bent")
        if place is not None and found.radii:
            body.append(f"held = np.clip(held, z[{place.position}] - radii, z[{place.position}] + radii)")
        low = [s.lowest for s in self.twin.state_list]
        high = [s.highest for s in self.twin.state_list]
        bounded = np.any(np.isfinite(low)) or np.any(np.isfinite(high))
        body.append(f"s = np.clip(z, {_bounds(low)}, {_bounds(high)})" if bounded else "s = z")
        if fine > 1:
            body.append("done += width")
        return [
            "    out = np.empty((len(drive), len(s)))",
            "    for k, now in enumerate(drive):",
            *(f"        {line}" for line in head),
            *("            " + line for line in body),
            "        before, began, out[k] = now, t[k], s",
            "    return out",
        ]

    def _one_step(self) -> list[str]:
        """Return the lines that take ``z`` a step further, with each input held or straight between its samples."""
        held = [bool(h) for h, s in zip(self.twin.held, self.twin.signals, strict=True) if s in self.signals]
        sub, fine = self.substeps
        start = "began" if sub == 1 else "began + j * h"
        whole = ""
        if fine > 1:
            start, whole = f"began + dt * done / {sub * fine}", ", width > 1"
        if np.all(held):
            return [f"z = step({start}, s, before, before, before{whole})"]
        end = "end" if any(held) else "now"
        lines = [f"end = np.where({held}, before, now)  # inputs that are held"] if any(held) else []
        if sub == fine == 1:
            return [*lines, f"z = step({start}, s, before, (before + {end}) / 2, {end})"]
        part = f"(j + c) / {sub} * ({end} - before)"
        if fine > 1:
            part = f"(done + c * width) / {sub * fine} * ({end} - before)"
        step = f"z = step({start}, s, ua, ub, uc{whole})"
        return [*lines, f"ua, ub, uc = (before + {part} for c in (0, 0.5, 1))", step]


def _bounds(values: Sequence[float]) -> str:
    return "[" + ", ".join(repr(v) if np.isfinite(v) else ("-" if v < 0 else "") + "np.inf" for v in values) + "]"


def _unpacked(names: Sequence[str]) -> str:
    return f"({names[0]},)" if len(names) == 1 else ", ".join(names)
