"""Writes a corrected twin as a Python module that needs numpy alone."""

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
from tools.mismatch.export.effects import PER_FORCE, Slot, Writer, force, numbers, written
from tools.mismatch.export.equations import EquationLines, Inner
from tools.mismatch.export.motion import PlantCode, motion, substeps_of
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_text import describe
from tools.mismatch.twins.base import Force
from tools.mismatch.twins.cascade import BETWEEN, CascadeTwin, between_of
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.ode import OdeTwin
from tools.mismatch.twins.ode_inside import PUSHED
from tools.mismatch.twins.opaque import OpaqueTwin
from tools.mismatch.twins.static import StaticTwin
from tools.mismatch.twins.vocabulary import find_user_kind

WIDTH = 110


def python_module(
    recording: Recording, model: Model, theta: Array, file_units: Mapping[str, str], report: Sequence[str], start: Array
) -> str:
    """Return the text of the module.

    ``file_units``: unit of each signal in the data file; ``report``: lines for its head; ``start``: the state of a
    dynamic twin at the first sample, in the coordinates of its text.
    """
    return _Module(recording, model, theta, file_units, report, start).text()


def _name(signal: str) -> str:
    """Return a signal as a Python name."""
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
        is_force = pl.site == "feedback"
        gain = self.twin.input_gain(self.twin.inputs[0], self.theta) if is_force else 1.0
        if isinstance(self.twin, OdeTwin) and is_force:
            u_in, u_out = self.twin.place_units(pl.target)
            is_force = self.twin.place(pl.target).kind in PUSHED
            gain = self.twin.force_gain(pl.target, self.theta)[0] if is_force else 1.0
        weights = {p.name for p in pl.parts.weights}
        carried = self.twin.input_gain(pl.target, self.theta) if pl.site == "input" and pl.effect.kind == "add" else 1.0
        for key in [key for key in self.writer.parameters if key.startswith(f"{self.labels[k]}.")]:
            value, unit = self.writer.parameters[key]
            stem = key.removeprefix(f"{self.labels[k]}.")
            if stem in weights or any(re.fullmatch(rf"{re.escape(stem)}_?\d+", w) for w in weights):
                # in the engine, weights before the base physics carry its gain; here they are forces and inputs
                value = (np.asarray(value) / (gain * carried)).tolist()
                if is_force:
                    unit = PER_FORCE.get(unit, unit)
            self.writer.parameters[key] = (value, unit.replace("{in}", u_in).replace("{out}", u_out))
        return slot

    def _through(self, site: str, between: bool = False) -> None:
        """Write the effects in front of the base physics (``input``) or behind it (``output``), in order.

        Effects between two filters are written separately.
        """
        for k in sorted(range(len(self.model.placed)), key=lambda k: STAGES.index(self.model.placed[k].stage)):
            pl = self.model.placed[k]
            if pl.site != site or between != (pl.site == "input" and pl.target == between_of(self.twin)):
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
            self._first(twin)
            self._through("input", between=True)
            self._dynamic(twin.second)
        elif isinstance(twin, OdeTwin):
            self._equations(twin)
        else:
            raise InputError(f"a twin of {twin.kind} has no numpy form to write; use --out FILE.toml or FILE.csv")
        self._through("output")

    def _moved(self, signal: str) -> bool:
        """Return True if lines of the base physics name this input."""
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
            self._put("start", self.start.tolist(), f"{x}, {x}/s")
            drive, place, speed = (
                f"{_name(source)} + {offset}",
                "np.array([1.0, 0.0])",
                "np.array([0.0, 1.0])",
            )
            rows = {o: f"x[:, {int(o == 'velocity')}]" for o in twin.outputs}
        else:
            a, b, _, _ = (f"np.array({self._put(n, self.base[n])})" for n in "ABCD")
            self._put("start", self.start.tolist())
            several = "np.stack([" + ", ".join(_name(s) for s in twin.inputs) + "], axis=1)"
            drive = several if len(twin.inputs) > 1 else _name(next(iter(twin.inputs)))
            place = 'np.array(p["C"])[0]'
            cp, bm = (np.asarray(self.base[n], np.float64) for n in "CB")
            if "discrete" in twin.holds.values():
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
        hold, drive = self._held(twin, drive)
        if forces:
            self._forced(twin, forces, PlantCode(a, b, place, speed, hold, start))
            add(f"x = moving({drive})")
        else:
            self.writer.part("linear", f"{a}, {b}, dt, {hold}, {start}", "moving")
            add(f"x = moving({drive})" if len(twin.inputs) > 1 else f"x = moving(({drive})[:, None])")
        for o, code in rows.items():
            add(f"{_name(o)} = {code}")

    def _held(self, twin: DynamicTwin | CascadeTwin, drive: str) -> tuple[str, str]:
        """Return the code of the hold of the inputs, and of what a linear or held course between samples may follow."""
        holds = [twin.holds[s] for s in twin.inputs]
        smooth = [h == "smooth" for h in holds]
        if any(smooth):
            # the future of an input is unknown step by step
            self.writer.used |= {"smoothed"}
            drive = f"smoothed({drive})" if all(smooth) else f"np.where({smooth}, smoothed({drive}), {drive})"
        plain = ["linear" if h == "smooth" else h for h in holds]
        return repr(plain[0] if len(set(plain)) == 1 else plain), drive

    def _first(self, twin: CascadeTwin) -> None:
        """Write the first filter, in front of the effects between two filters; it starts at rest."""
        table: Mapping[str, Any] = self.base["first"]
        a, b, c, d = (f"np.array({self._put(f'first.{n}', table[n])})" for n in "ABCD")
        hold, drive = self._held(twin, _name(twin.inputs[0]))
        self.writer.part("linear", f"{a}, {b}, dt, {hold}, np.zeros(len({a}))", "in_front")
        through = f" + {d}[0, 0] * {drive}" if np.any(np.asarray(table["D"]) != 0.0) else ""
        self.writer.run.append(f"{BETWEEN} = in_front(({drive})[:, None]) @ {c}[0]{through}")

    def _forced(self, twin: DynamicTwin, forces: list[int], plant: PlantCode) -> None:
        codes = [force(self._slot(k, self.model.placed[k].outputs[0])) for k in forces]
        self.writer.used |= {"discretise"}
        substeps = substeps_of(twin, self.model, self.theta, self.recording, forces)
        self.writer.setup += motion(codes, plant, substeps)

    def _equations(self, twin: OdeTwin) -> None:
        for name, value in zip(twin.names, twin.values(self.theta).tolist(), strict=True):
            self._put(name, value, twin.parameter_units.get(name, ""))
        self._put("start", self.start.tolist(), ", ".join(s.unit for s in twin.state_list))
        inner = [
            Inner(twin.place(pl.target), self._slot(k, pl.outputs[0]))
            for k, pl in enumerate(self.model.placed)
            if pl.site == "feedback"
        ]
        gains = {one.place.name: twin.force_gain(one.place.name, self.theta)[0] for one in inner}
        forces = [
            Force(pl.effect, pl.settings, self.theta[a], self.theta[b], b.start, pl.target)
            for pl, (a, b) in ((pl, self.model.slices(k)) for k, pl in enumerate(self.model.placed))
            if pl.site == "feedback"
        ]
        substeps = twin.substeps(self.recording.dt, twin.packed(forces, twin.values(self.theta)))
        lines = EquationLines(twin, _name, substeps, gains, twin.values(self.theta))
        self.writer.run += [f'{_name(s)} = u["{s}"]' for s in lines.see(inner)]
        self.writer.setup += lines.setup(inner)
        self.writer.run += lines.run()

    # -- text ---------------------------------------------------------------------------------------

    def text(self) -> str:
        """Return the whole module."""
        w = self.writer
        self._base()
        outputs = ", ".join(f'"{o}": {_name(o)}' for o in self.twin.outputs)
        opaque = isinstance(self.twin, OpaqueTwin)
        lines = [*self._head(), "", "import numpy as np", "", *self._parameters(), ""]
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

    def _head(self) -> list[str]:
        rec = self.recording
        effects = ", ".join(dict.fromkeys(pl.effect.name.replace("_", " ") for pl in self.model.placed))
        lines = [f'"""Corrected twin: {self.twin.kind} with {effects or "no effects"}. It needs numpy alone.', ""]
        lines += [f"Written by 'micron mismatch apply' for {rec.path.name}: {rec.title}".replace('"""', "'''"), ""]
        for role, names in (("inputs ", [*self.twin.inputs, *self._contexts()]), ("outputs", self.twin.outputs)):
            described = [f"{s} ({self.file_units[s]}, column {rec.column[s]})" for s in names]
            lines += textwrap.wrap(f"{role}  " + ", ".join(described), WIDTH, subsequent_indent=" " * 9)
        lines += [wrapped for line in self.report for wrapped in textwrap.wrap(line, WIDTH, subsequent_indent=" " * 9)]
        if isinstance(self.twin, DynamicTwin | OdeTwin | CascadeTwin):
            lines += ['"start" is the state at the first sample of that recording; another record begins elsewhere.']
        return [*(line.replace("\\", "/") for line in lines), '"""']

    def _contexts(self) -> list[str]:
        code = "\n".join(self.writer.run)
        return [s for s in self.recording.context if f'u["{s}"]' in code]

    def _parameters(self) -> list[str]:
        lines = ["PARAMETERS = {"]
        for key, (value, unit) in self.writer.parameters.items():
            value_text = numbers(value) if not isinstance(value, str | Mapping) else repr(value)
            lines.append(_wrapped(f"{_quoted(key)}: {value_text},", 4) + (f"  # {unit}" if unit else ""))
        return [*lines, "}"]

    def _simulate(self, opaque: bool) -> list[str]:
        dt = numbers(self.recording.dt)
        used = [*self.twin.inputs, *self._contexts()]
        user = find_user_kind(self.twin.kind) if opaque else None
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
    """Return (factor, shift) from a unit of the file to the twin's."""
    if unit == to:
        return 1.0, 0.0
    zero, one = units.convert(np.array([0.0, 1.0]), unit, to).tolist()
    return one - zero, zero


def _scaled(code: str, factor: float, shift: float) -> str:
    return f"{numbers(factor)} * {code}" + (f" + {numbers(shift)}" if shift else "")


def _quoted(key: str) -> str:
    return '"' + key.replace('"', "'") + '"'


def _wrapped(line: str, indent: int) -> str:
    """Wrap a line of code that is too long; its comment moves above it."""
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
    """Return the used functions, with those that they call, in the order of ``parts``."""
    every = set(used)
    while True:
        more = {n for n in SOURCES for u in every if re.search(rf"\b{n}\(", SOURCES[u])} - every
        if not more:
            return [n for n in SOURCES if n in every]
        every |= more
