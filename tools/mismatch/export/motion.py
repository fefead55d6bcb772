"""Writes the equation of motion of a twin with forces as lines of numpy code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim_devices.physics.effect import Array
from tools.mismatch.export.effects import ForceCode, joined
from tools.mismatch.recording import Recording
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_view import View, view_run
from tools.mismatch.twins.base import Force
from tools.mismatch.twins.dynamic import DynamicTwin
from tools.mismatch.twins.feedback import pack


def substeps_of(twin: DynamicTwin, model: Model, theta: Array, recording: Recording, forces: Sequence[int]) -> int:
    """Return the steps per sample that the engine takes with these forces."""
    if twin.holds[twin.inputs[0]] == "discrete":
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


@dataclass(frozen=True)
class PlantCode:
    """Holds the code of a linear plant: its matrices, the rows of position and velocity, and its start state."""

    a: str
    b: str
    place: str
    speed: str
    hold: str
    """Literal of the hold, in quotes."""
    start: str


def motion(codes: Sequence[ForceCode], plant: PlantCode, substeps: int) -> list[str]:
    """Return the lines of ``moving(drive)``: a linear plant with forces of its position x and velocity v in free run.

    The scheme is that of ``twins.feedback.run_feedback``, written out for the forces of the twin.
    """
    found = joined(codes)
    names, lines = _memory(found, plant, "dt" if substeps == 1 else f"dt / {substeps}")
    steps = "if before is not None:" if substeps == 1 else f"for j in range({substeps} if before is not None else 0):"
    return [
        *lines,
        "",
        "def moving(drive):",
        f"    nonlocal {', '.join(names)}",
        "    out = np.empty((len(drive), len(s)))",
        "    for k, now in enumerate(drive):",
        f"        {steps}",
        *("            " + line for line in _step(found, plant.hold == "'linear'", substeps)),
        "        before, out[k] = now, s",
        "    return out",
    ]


def _memory(found: ForceCode, plant: PlantCode, step: str) -> tuple[list[str], list[str]]:
    """Return the names that keep their values from step to step, and the lines that define them and the forces."""
    names = ["s", "before"]
    lines = [
        f"ad, g0, g1 = discretise({plant.a}, {plant.b}, {step}, {plant.hold})",
        f"g0, g1, place, speed = g0[:, 0], g1[:, 0], {plant.place}, {plant.speed}  # rows of position and velocity",
        f"s, before = {plant.start}, None",
    ]
    if found.radii:
        names.append("held")
        lines.append(f"radii, springs = np.array({found.radii}), np.array({found.springs})")
        lines.append("held = place @ s + 0 * radii  # where each elastic element is at rest")
    if found.stiff:
        names.append("bristle")
        lines.append(f"stiff, bristle = {found.stiff}, 0.0")
    if found.limit:
        lines += ["", "def limit(v, sign):", f"    return max({found.limit}, 0.0)"]
    if found.limit and not found.stiff:
        lines += [
            "",
            "def speed_after(v, free, gain):  # dry friction: a body that turns within a step rests, or slips back",
            "    sign = 1.0 if v > 0 or (v == 0 and free > 0) else -1.0",
            "    slipped = free - sign * limit(v, sign) * gain",
            "    if slipped * sign >= 0:",
            "        return slipped",
            "    sign = 1.0 if free > v else -1.0",
            "    over = abs(free - v) - limit(0.0, sign) * gain",
            "    return sign * over * slipped / (slipped - v) if over > 0 else 0.0",
        ]
    if found.stiff:
        lines += ["", *bend_code(found.lean, "def bend(z, v):", step)]
    if found.smooth:
        lines += ["", "def smooth(x, v):", f"    return {sum_code(found.smooth.strip())}"]
    return names, lines


def _step(found: ForceCode, straight: bool, substeps: int) -> list[str]:
    """Return the lines that take the state ``s`` a step further. ``straight``: the input runs straight in it."""
    now, next_ = _terms(found)
    if straight:
        rise = "now - before" if substeps == 1 else f"(now - before) / {substeps}"
        body = [f"rise = {rise}", f"u = before{'' if substeps == 1 else ' + j * rise'}"]
        plus = "u + rise"
    else:
        body, plus = ["u = before"], "u"
    if found.radii:
        body.append("held = np.clip(held, place @ s - radii, place @ s + radii)")
    if now:
        body += [
            f"f = {sum_code(' '.join(now))}",
            f"z = ad @ s + g0 * (u + f) + g1 * ({plus} + f)",
            f"g = {sum_code(' '.join(next_))}",
            f"z = ad @ s + g0 * (u + f) + g1 * ({plus} + g)",
        ]
    else:
        body.append(f"z = ad @ s + g0 * u + g1 * ({plus})")
    if found.stiff:
        body.append("bristle = bend(bristle, 0.5 * speed @ (s + z))")
    elif found.limit:
        body += [
            "v, gain = speed @ z, speed @ (g0 + g1)",
            "z = z + (g0 + g1) * (speed_after(speed @ s, v, gain) - v) / gain",
        ]
    return [*body, "s = z"]


def _terms(found: ForceCode) -> tuple[list[str], list[str]]:
    """Return the code of each force at the start of a step, and at its end."""
    now, next_ = list[str](), list[str]()
    if found.smooth:
        now.append("smooth(place @ s, speed @ s)")
        next_.append("smooth(place @ z, speed @ z)")
    if found.radii:
        now.append("- springs @ (place @ s - held)")
        next_.append("- springs @ np.clip(place @ z - held, -radii, radii)")
    if found.stiff:
        now.append("- stiff * bristle")
        next_.append("- stiff * bend(bristle, 0.5 * speed @ (s + z))")
    return now, next_


def bend_code(lean: str, head: str, since: str) -> list[str]:
    """Return lines for the deflection of bristles after ``since`` seconds at speed v; ``lean``: code of the lean."""
    if lean:
        return [
            f"{head}  # Bouc-Wen: z' = v - stiff (|v| z + lean v |z|) / limit, exact for constant v",
            f"    way, w, lean = abs(v) * {since}, np.sign(v) * z, {lean}",
            "    back, on = (1 - lean) * stiff / limit(v, 1.0), (1 + lean) * stiff / limit(v, 1.0)",
            "    if w < 0:",
            "        rest = np.log1p(-back * w) / back if back else -w",
            "        if rest >= way:",
            "            gone = -np.expm1(-back * way) / back if back else way",
            "            return np.sign(v) * (w * np.exp(-back * way) + gone)",
            "        way, w = way - rest, 0.0",
            "    return np.sign(v) * (w * np.exp(-on * way) - (np.expm1(-on * way) / on if on else -way)) if v else z",
        ]
    return [
        f"{head}  # LuGre: z' = v - stiff |v| z / limit, exact for constant v",
        "    settled = np.sign(v) * limit(v, np.sign(v)) / stiff",
        f"    return settled + (z - settled) * np.exp(-abs(v / settled) * {since}) if settled else z",
    ]


def sum_code(terms: str) -> str:
    """Return the code of a sum whose first term has its sign before a blank."""
    return "-" + terms[2:] if terms.startswith("- ") else terms.removeprefix("+ ")
