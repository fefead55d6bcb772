"""A corrected twin as a Python module that needs numpy alone."""

from __future__ import annotations

import ast
import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim_devices.physics.effect import STAGES, Array
from tools.errors import InputError
from tools.mismatch import units
from tools.mismatch.export import parts
from tools.mismatch.export.effects import PER_FORCE, ForceCode, Slot, Writer, force, numbers, written
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_text import describe
from tools.mismatch.twins.base import Force
from tools.mismatch.twins.cascade import CascadeTwin
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.opaque import OpaqueTwin
from tools.mismatch.twins.static import StaticTwin
from tools.mismatch.twins.vocabulary import user_kinds

WIDTH = 110


def python_module(
    recording: Recording, model: Model, theta: Array, file_units: Mapping[str, str], report: Sequence[str], start: Array
) -> str:
    """The text of the module.

    ``file_units``: unit of each signal in the data file; ``report``: lines for its head; ``start``: the state of a
    dynamic twin at the first sample, in the coordinates of its text.
    """
    return _Module(recording, model, theta, file_units, report, start).text()


def _name(signal: str) -> str:
    """A signal as a Python name."""
    name = re.sub(r"\W", "_", signal)
    return f"_{name}" if name[:1].isdigit() or name in ("t", "u", "p", "dt", "np", "") else name


class _Module:
    def __init__(
        self,
        recording: Recording,
        model: Model,
        theta: Array,
        file_units: Mapping[str, str],
        report: Sequence[str],
        start: Array,
    ) -> None:
        self.recording, self.model, self.theta = recording, model, theta
        self.file_units, self.report, self.start = file_units, report, start
        self.twin = model.twin
        self.writer = Writer(recording.dt, recording.n, recording.signals)
        self.base: Mapping[str, Any] = describe(model, theta)["parameters"]
        self.labels = self._labels()

    def _labels(self) -> list[str]:
        names = [pl.effect.name for pl in self.model.placed]
        labels: list[str] = []
        for pl in self.model.placed:
            label = pl.effect.name if names.count(pl.effect.name) == 1 else f"{pl.effect.name}[{pl.target}]"
            while label in labels:
                label += "'"
            labels.append(label)
        return labels

    # -- effects ------------------------------------------------------------------------------------

    def _slot(self, k: int, output: str) -> Slot:
        pl = self.model.placed[k]
        a, b = self.model.slices(k)
        names = [p.name for p in (*pl.parts.nonlinear, *pl.parts.weights)]
        values = dict(zip(names, [*self.theta[a].tolist(), *self.theta[b].tolist()], strict=True))
        slot = Slot(self.writer, pl, self.labels[k], values, output)
        drive = self.twin.drive(pl.outputs[0]) or pl.target
        u_in = self.twin.units.get(pl.target if pl.site == "input" else drive, "1")
        u_out = self.twin.units.get(pl.outputs[0], "1")
        if pl.site == "feedback" and self.twin.counted:
            u_out = u_out.removesuffix("/s")
        weights = {p.name for p in pl.parts.weights}
        gain = self.twin.input_gain(self.twin.inputs[0], self.theta) if pl.site == "feedback" else 1.0
        carried = self.twin.input_gain(pl.target, self.theta) if pl.site == "input" and pl.effect.kind == "add" else 1.0
        for key in [key for key in self.writer.parameters if key.startswith(f"{self.labels[k]}.")]:
            value, unit = self.writer.parameters[key]
            stem = key.removeprefix(f"{self.labels[k]}.")
            if stem in weights or any(re.fullmatch(rf"{re.escape(stem)}_?\d+", w) for w in weights):
                # weights before the base physics carry its gain inside the engine; here they are forces and inputs
                value = (np.asarray(value) / (gain * carried)).tolist()
                if pl.site == "feedback":
                    unit = PER_FORCE.get(unit, unit)
            self.writer.parameters[key] = (value, unit.replace("{in}", u_in).replace("{out}", u_out))
        return slot

    def _through(self, site: str) -> None:
        """Lines for the effects in front of the base physics (``input``) or behind it (``output``), in order."""
        for k in sorted(range(len(self.model.placed)), key=lambda k: STAGES.index(self.model.placed[k].stage)):
            pl = self.model.placed[k]
            if pl.site != site:
                continue
            for o in pl.outputs[:1] if site == "input" else pl.outputs:
                x = _name(pl.target if site == "input" else o)
                drive = self.twin.drive(o)
                behind = site == "output" and self.twin.static and drive and pl.effect.kind == "add"
                code = written(self._slot(k, o), x, _name(drive) if behind else x)
                self.writer.run.append(f"{x} = {code}")

    # -- base physics -------------------------------------------------------------------------------

    def _put(self, name: str, value: object, unit: str = "") -> str:
        self.writer.parameters[name] = (value, unit)
        return f'p["{name}"]'

    def _base(self) -> None:
        for s in self.twin.inputs:
            if self._moved(s):
                self.writer.run.append(f'{_name(s)} = u["{s}"]')
        self._through("input")
        twin = self.twin
        if isinstance(twin, OpaqueTwin):
            self._opaque(twin)
        elif twin.kind == "accelerometer_cluster":
            self._cluster()
        elif isinstance(twin, DynamicTwin):
            self._dynamic(twin)
        elif isinstance(twin, StaticTwin):
            self._static()
        elif isinstance(twin, CascadeTwin):
            raise InputError("two filters with an effect between them have no numpy form; use --out FILE.toml or .csv")
        else:
            raise InputError(f"a twin of {twin.kind} has no numpy form to write; use --out FILE.toml or FILE.csv")
        self._through("output")

    def _moved(self, signal: str) -> bool:
        """Return whether lines of the base physics name this input."""
        return self.twin.kind != "accelerometer_cluster" or not signal.startswith("angular_rate")

    def _static(self) -> None:
        offset, scale = self.base
        for o in self.twin.outputs:
            tag = f"[{o}]" if isinstance(self.base[offset], Mapping) else ""
            a, b = (v[o] if isinstance(v, Mapping) else v for v in (self.base[offset], self.base[scale]))
            drive = self.twin.drive(o)
            first = self._put(offset + tag, a, self.twin.units[o])
            second = self._put(scale + tag, b, f"{self.twin.units[o]}/{self.twin.units[drive]}")
            self.writer.run.append(f"{_name(o)} = {first} + {second} * {_name(drive)}")

    def _cluster(self) -> None:
        from tools.mismatch.twins.cluster import location

        places = ", ".join(f'"{k}": {numbers(v)}' for k, v in self.base["positions_m"].items())
        self.writer.setup.append(f"R = {{{places}}}")
        rates = [f'u["angular_rate_{a}"]' if f"angular_rate_{a}" in self.twin.inputs else "0 * t" for a in "xyz"]
        turn = self.writer.part("derivative", "dt", "turn")
        self.writer.run += [f"omega = np.stack([{', '.join(rates)}], axis=1)", f"alpha = {turn}(omega)"]
        for o in self.twin.outputs:
            axis = "xyz".index(o[-1])
            bias, scale = (
                self._put(f"bias[{o}]", self.base["bias"][o], "m/s^2"),
                self._put(f"scale[{o}]", self.base["scale"][o], "1"),
            )
            turned = f'np.cross(alpha, R["{location(o)}"])[:, {axis}]'
            self.writer.run.append(f"{_name(o)} = {bias} + {scale} * ({_name(self.twin.drive(o))} + {turned})")

    def _opaque(self, twin: OpaqueTwin) -> None:
        for k, v in self.base.items():
            self._put(k, v)
        given = ", ".join(f'"{s}": {_name(s)}' for s in twin.inputs)
        self.writer.run.append(f'y = base({{{given}, "t": t}}, p)')
        self.writer.run += [f'{_name(o)} = np.asarray(y["{o}"])' for o in twin.outputs]

    def _dynamic(self, twin: DynamicTwin) -> None:
        add = self.writer.run.append
        u = twin.units
        if twin.kind == "mechanical_axis":
            source, f = twin.inputs[0], u[twin.inputs[0]]
            x = u[twin.outputs[0]].removesuffix("/s")
            m = self._put("mass", self.base["mass"], f"{f} s^2/{x}")
            c = self._put("damping", self.base["damping"], f"{f} s/{x}")
            k = self._put("stiffness", self.base["stiffness"], f"{f}/{x}") if "stiffness" in self.base else "0.0"
            offset = self._put("offset_force", self.base["offset_force"], f)
            a, b = f"np.array([[0.0, 1.0], [-{k} / {m}, -{c} / {m}]])", f"np.array([[0.0], [1 / {m}]])"
            hold = self.base.get("hold", "linear")
            self._put("start", self.start.tolist(), f"{x}, {x}/s")
            drive, place, speed = (
                f"{_name(source)} + {offset}",
                "np.array([1.0, 0.0])",
                "np.array([0.0, 1.0])",
            )
            rows = {o: f"x[:, {int(o == 'velocity')}]" for o in twin.outputs}
        else:
            a, b, _, _ = (f"np.array({self._put(n, self.base[n])})" for n in "ABCD")
            hold = "discrete" if self.base.get("discrete") else self.base.get("hold", "linear")
            self._put("start", self.start.tolist())
            several = "np.stack([" + ", ".join(_name(s) for s in twin.inputs) + "], axis=1)"
            drive = several if len(twin.inputs) > 1 else _name(next(iter(twin.inputs)))
            place = 'np.array(p["C"])[0]'
            cp, bm = (np.asarray(self.base[n], np.float64) for n in "CB")
            if hold == "discrete":
                speed = 'np.array(p["C"])[0] @ (np.array(p["A"]) - np.eye(len(p["A"]))) / dt'
            elif abs(float(cp[0] @ bm[:, 0])) < 1e-12 * float(np.abs(cp[0]) @ np.abs(bm[:, 0]) + 1e-300):
                speed = 'np.array(p["C"])[0] @ np.array(p["A"])'
            else:
                speed = 'np.array(p["C"])[0]'
            rows = {}
            direct = bool(np.any(np.asarray(self.base["D"]) != 0.0))
            for i, o in enumerate(twin.outputs):
                times = f'drive @ np.array(p["D"])[{i}]' if len(twin.inputs) > 1 else f'p["D"][{i}][0] * drive'
                through = f" + {times}" if direct else ""
                rows[o] = f'x @ np.array(p["C"])[{i}]{through} + p["y0"][{i}]'
            self._put("y0", self.base["y0"], ", ".join(u[o] for o in twin.outputs))
            if direct:
                add(f"drive = {drive}")
                drive = "drive"
        start = 'np.array(p["start"])'
        forces = [k for k, pl in enumerate(self.model.placed) if pl.site == "feedback"]
        if hold == "smooth":
            # what is known of an input ahead of time: no use step by step
            self.writer.used |= {"smoothed"}
            hold, drive = "linear", f"smoothed({drive})"
        if forces:
            self._forced(twin, forces, a, b, place, speed, str(hold), start)
            add(f"x = moving({drive})")
        else:
            self.writer.part("linear", f"{a}, {b}, dt, {str(hold)!r}, {start}", "moving")
            add(f"x = moving({drive})" if len(twin.inputs) > 1 else f"x = moving(({drive})[:, None])")
        for o, code in rows.items():
            add(f"{_name(o)} = {code}")

    def _forced(
        self, twin: DynamicTwin, forces: list[int], a: str, b: str, place: str, speed: str, hold: str, start: str
    ) -> None:
        codes = [force(self._slot(k, self.model.placed[k].outputs[0])) for k in forces]
        self.writer.used |= {"discretise"}
        substeps = substeps_of(twin, self.model, self.theta, self.recording, forces)
        self.writer.setup += motion(codes, a, b, place, speed, hold, start, substeps)

    # -- text ---------------------------------------------------------------------------------------

    def text(self) -> str:
        """The whole module."""
        w = self.writer
        self._base()
        outputs = ", ".join(f'"{o}": {_name(o)}' for o in self.twin.outputs)
        opaque = isinstance(self.twin, OpaqueTwin)
        lines = [*self._head(), "", *self._imports(), "", *self._parameters(), ""]
        lines += [line for name in _order(w.used) for line in ("", *SOURCES[name].splitlines(), "")]
        lines += ["", "def twin(p, dt, base):" if opaque else "def twin(p, dt):"]
        lines += [
            '    """The twin as a function of time (n,) and inputs (n,) that goes on where its last call stopped."""'
        ]
        lines += [_wrapped(line, 4) for line in w.setup]
        lines += ["", "    def run(t, u):"]
        lines += [_wrapped(line, 8) for line in w.run]
        lines += [f"        return {{{outputs}}}", "", "    return run", "", ""]
        lines += self._simulate(opaque)
        return "\n".join(lines) + "\n"

    def _imports(self) -> list[str]:
        return ["import numpy as np"]

    def _head(self) -> list[str]:
        rec = self.recording
        effects = ", ".join(dict.fromkeys(pl.effect.name.replace("_", " ") for pl in self.model.placed))
        lines = [f'"""Corrected twin: {self.twin.kind} with {effects or "no effects"}. It needs numpy alone.', ""]
        lines += [f"Written by 'micron mismatch apply' for {rec.path.name}: {rec.title}".replace('"""', "'''"), ""]
        for role, names in (("inputs ", [*self.twin.inputs, *self._contexts()]), ("outputs", self.twin.outputs)):
            said = [f"{s} ({self.file_units[s]}, column {rec.column[s]})" for s in names]
            lines += textwrap.wrap(f"{role}  " + ", ".join(said), WIDTH, subsequent_indent=" " * 9)
        lines += [wrapped for line in self.report for wrapped in textwrap.wrap(line, WIDTH, subsequent_indent=" " * 9)]
        if isinstance(self.twin, DynamicTwin):
            lines += ['"start" is the state at the first sample of that recording; another record begins elsewhere.']
        return [*(line.replace("\\", "/") for line in lines), '"""']

    def _contexts(self) -> list[str]:
        code = "\n".join(self.writer.run)
        return [s for s in self.recording.context if f'u["{s}"]' in code]

    def _parameters(self) -> list[str]:
        lines = ["PARAMETERS = {"]
        for key, (value, unit) in self.writer.parameters.items():
            shown = numbers(value) if not isinstance(value, str | Mapping) else repr(value)
            lines.append(_wrapped(f"{_quoted(key)}: {shown},", 4) + (f"  # {unit}" if unit else ""))
        return [*lines, "}"]

    def _simulate(self, opaque: bool) -> list[str]:
        dt = numbers(self.recording.dt)
        used = [*self.twin.inputs, *self._contexts()]
        user = user_kinds().get(self.twin.kind) if opaque else None
        head = f"def simulate(inputs, parameters=None, dt={dt}{', base=None' if opaque else ''}):"
        lines = [
            head,
            '    """Outputs (n,) by name for inputs (n,) by name, in the units above, from rest or "start"."""',
        ]
        if opaque and user is not None:
            module, _, thing = str(getattr(user, "value", "")).partition(":")
            lines += ["    if base is None:", f"        from {module} import {thing}", ""]
            lines += [f"        base = {thing}().simulate"]
        elif opaque:
            lines += [
                "    if base is None:",
                f'        raise ValueError("give your own {self.twin.kind}: base(inputs, parameters) -> outputs")',
            ]
        lines.append("    u = {s: np.asarray(x, float) for s, x in inputs.items()}")
        change = {s: _affine(self.file_units[s], self.recording.unit[s]) for s in (*used, *self.twin.outputs)}
        for s in used:
            if change[s] != (1.0, 0.0):
                factor, shift = change[s]
                code = f'u["{s}"]'
                lines.append(f"    {code} = {_scaled(code, factor, shift)}  # in {self.recording.unit[s]}")
        lines.append(f'    t = dt * np.arange(len(u["{self.twin.inputs[0]}"]))')
        call = f"twin({{**PARAMETERS, **(parameters or {{}})}}, dt{', base' if opaque else ''})(t, u)"
        if all(change[o] == (1.0, 0.0) for o in self.twin.outputs):
            return [*lines, f"    return {call}"]
        lines.append(f"    y = {call}")
        for o in self.twin.outputs:
            factor, shift = change[o]
            if (factor, shift) != (1.0, 0.0):
                lines.append(
                    f'    y["{o}"] = (y["{o}"] - {numbers(shift)}) / {numbers(factor)}  # in {self.file_units[o]}'
                )
        return [*lines, "    return y"]


def _affine(unit: str, to: str) -> tuple[float, float]:
    """(factor, shift) from a unit of the file to the twin's."""
    if unit == to:
        return 1.0, 0.0
    zero, one = units.convert(np.array([0.0, 1.0]), unit, to).tolist()
    return one - zero, zero


def _scaled(code: str, factor: float, shift: float) -> str:
    return f"{numbers(factor)} * {code}" + (f" + {numbers(shift)}" if shift else "")


def _quoted(key: str) -> str:
    return '"' + key.replace('"', "'") + '"'


def _wrapped(line: str, indent: int) -> str:
    """A line of code; what is too long goes on below, its comment stands above."""
    code = line.strip()
    if not code:
        return ""
    pad = " " * (indent + len(line) - len(line.lstrip()))
    if len(code) + len(pad) <= WIDTH:
        return pad + code
    code, _, comment = code.partition("  # ")
    above = [f"{pad}# {comment}"] if comment else []
    if len(code) + len(pad) <= WIDTH:
        return "\n".join([*above, pad + code])
    name, equals, value = code.partition(" = ")
    if code.startswith("return "):
        name, value = "return", code.removeprefix("return ")
    elif equals and '"' not in name and "(" not in name:
        name += " ="
    else:
        name = ""
    if name:
        inside = textwrap.wrap(value, WIDTH - len(pad) - 4, break_long_words=False, break_on_hyphens=False)
        return "\n".join([*above, f"{pad}{name} (", *(f"{pad}    {part}" for part in inside), f"{pad})"])
    parts = textwrap.wrap(
        code, WIDTH - len(pad), subsequent_indent="    ", break_long_words=False, break_on_hyphens=False
    )
    return "\n".join([*above, *(pad + part for part in parts)])


SOURCES: dict[str, str] = {}
for _node in ast.parse(Path(parts.__file__).read_text(encoding="utf-8")).body:
    if isinstance(_node, ast.FunctionDef):
        SOURCES[_node.name] = ast.get_source_segment(Path(parts.__file__).read_text(encoding="utf-8"), _node) or ""


def _order(used: set[str]) -> list[str]:
    """Functions that are used, with those that they call, in the order of ``parts``."""
    every = set(used)
    while True:
        more = {n for n in SOURCES for u in every if re.search(rf"\b{n}\(", SOURCES[u])} - every
        if not more:
            return [n for n in SOURCES if n in every]
        every |= more


def substeps_of(twin: DynamicTwin, model: Model, theta: Array, recording: Recording, forces: Sequence[int]) -> int:
    """Steps per sample that the engine takes with these forces."""
    from tools.mismatch.simulate_view import View, view_run
    from tools.mismatch.twins.feedback import pack

    if twin.hold == "discrete":
        return 1
    placed = [(model.placed[k], *model.slices(k)) for k in forces]
    packed = pack([Force(pl.effect, pl.settings, theta[a], theta[b], b.start) for pl, a, b in placed])
    plant = twin.plant_of(theta)
    row = np.zeros(plant.a.shape[0])
    if twin.counted:
        row[0] = 1.0
    else:
        carried = twin.input_gain(twin.inputs[0], theta) != 1.0
        for link in twin.links:
            if link.output == twin.feedback_on and link.source == twin.inputs[0] and link.row >= 0:
                row[link.row] = 1.0 if carried else theta[link.j]
    push = float(row @ plant.a @ plant.b) or 1.0
    return twin._substeps(view_run(twin, View.whole(recording)), packed, push)


def motion(
    codes: Sequence[ForceCode], a: str, b: str, place: str, speed: str, hold: str, start: str, substeps: int
) -> list[str]:
    """Lines of ``moving(drive)``: a linear plant with forces of its position x and velocity v in free run.

    The scheme is that of ``twins.feedback.run_feedback``, written out for the forces that there are.
    """
    smooth = "".join(c.smooth for c in codes)
    limits = [c.limit for c in codes if c.limit]
    stiff = " + ".join(c.stiff for c in codes if c.stiff)
    lean = next((c.lean for c in codes if c.lean), "")
    radii = next((c.radii for c in codes if c.radii), "")
    springs = next((c.springs for c in codes if c.springs), "")
    straight = hold == "linear"
    step = "dt" if substeps == 1 else f"dt / {substeps}"
    lines = [
        f"ad, g0, g1 = discretise({a}, {b}, {step}, {hold!r})",
        f"g0, g1, place, speed = g0[:, 0], g1[:, 0], {place}, {speed}  # rows of position and velocity",
        f"s, before = {start}, None",
    ]
    terms, later = (["smooth(place @ s, speed @ s)"], ["smooth(place @ z, speed @ z)"]) if smooth else ([], [])
    memory = ["s", "before"]
    if radii:
        memory.append("held")
        lines.append(f"radii, springs = np.array({radii}), np.array({springs})")
        lines.append("held = place @ s + 0 * radii  # where each elastic element is at rest")
        terms.append("- springs @ (place @ s - held)")
        later.append("- springs @ np.clip(place @ z - held, -radii, radii)")
    if stiff:
        memory.append("bristle")
        lines.append(f"stiff, bristle = {stiff}, 0.0")
        terms.append("- stiff * bristle")
        later.append("- stiff * bend(bristle, 0.5 * speed @ (s + z))")
    if limits:
        lines += ["", "def limit(v, sign):", f"    return max({' + '.join(limits)}, 0.0)"]
    if lean:
        lines += [
            "",
            "def bend(z, v):  # Bouc-Wen: z' = v - stiff (|v| z + lean v |z|) / limit, exact for constant v",
            f"    way, w, lean = abs(v) * {step}, np.sign(v) * z, {lean}",
            "    back, on = (1 - lean) * stiff / limit(v, 1.0), (1 + lean) * stiff / limit(v, 1.0)",
            "    if w < 0:",
            "        rest = np.log1p(-back * w) / back if back else -w",
            "        if rest >= way:",
            "            gone = -np.expm1(-back * way) / back if back else way",
            "            return np.sign(v) * (w * np.exp(-back * way) + gone)",
            "        way, w = way - rest, 0.0",
            "    return np.sign(v) * (w * np.exp(-on * way) - (np.expm1(-on * way) / on if on else -way)) if v else z",
        ]
    elif stiff:
        lines += [
            "",
            "def bend(z, v):  # LuGre: z' = v - stiff |v| z / limit, exact for constant v",
            "    settled = np.sign(v) * limit(v, np.sign(v)) / stiff",
            f"    return settled + (z - settled) * np.exp(-abs(v / settled) * {step}) if settled else z",
        ]
    if smooth:
        lines += ["", "def smooth(x, v):", f"    return {_sum(smooth.strip())}"]
    lines += ["", "def moving(drive):", f"    nonlocal {', '.join(memory)}", "    out = np.empty((len(drive), len(s)))"]
    steps = "if before is not None:" if substeps == 1 else f"for j in range({substeps} if before is not None else 0):"
    lines += ["    for k, now in enumerate(drive):", f"        {steps}"]
    if straight:
        rise = "now - before" if substeps == 1 else f"(now - before) / {substeps}"
        body = [f"rise = {rise}", f"u = before{'' if substeps == 1 else ' + j * rise'}"]
        plus = "u + rise"
    else:
        body, plus = ["u = before"], "u"
    if radii:
        body.append("held = np.clip(held, place @ s - radii, place @ s + radii)")
    if terms:
        body += [
            f"f = {_sum(' '.join(terms))}",
            f"z = ad @ s + g0 * (u + f) + g1 * ({plus} + f)",
            f"g = {_sum(' '.join(later))}",
            f"z = ad @ s + g0 * (u + f) + g1 * ({plus} + g)",
        ]
    else:
        body.append(f"z = ad @ s + g0 * u + g1 * ({plus})")
    if stiff:
        body.append("bristle = bend(bristle, 0.5 * speed @ (s + z))")
    elif limits:
        body += [
            "v, push = speed @ z, speed @ (g0 + g1)",
            "most = limit(speed @ s, 1.0 if v > 0 else -1.0)  # dry friction takes no more than stops the motion",
            "z = z - (g0 + g1) * (np.sign(v) * most if abs(v) > most * push else v / push)",
        ]
    body.append("s = z")
    lines += ["            " + line for line in body]
    return [*lines, "        before, out[k] = now, s", "    return out"]


def _sum(terms: str) -> str:
    """Code of a sum whose first term has its sign before a blank."""
    return "-" + terms[2:] if terms.startswith("- ") else terms.removeprefix("+ ")
