"""Writes the equation of motion of a twin with forces as lines of numpy code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim_devices.physics.effect import Array
from tools.mismatch.export.effects import ForceCode
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
    """As code."""
    start: str


def motion(codes: Sequence[ForceCode], plant: PlantCode, substeps: int) -> list[str]:
    """Return the lines of ``moving(drive)``: a linear plant with forces of its position x and velocity v in free run.

    The scheme is that of ``twins.feedback.run_feedback``, written out for the forces of the twin.
    """
    smooth = "".join(c.smooth for c in codes)
    limits = [c.limit for c in codes if c.limit]
    stiff = " + ".join(c.stiff for c in codes if c.stiff)
    lean = next((c.lean for c in codes if c.lean), "")
    radii = next((c.radii for c in codes if c.radii), "")
    springs = next((c.springs for c in codes if c.springs), "")
    straight = plant.hold == "'linear'"
    step = "dt" if substeps == 1 else f"dt / {substeps}"
    lines = [
        f"ad, g0, g1 = discretise({plant.a}, {plant.b}, {step}, {plant.hold})",
        f"g0, g1, place, speed = g0[:, 0], g1[:, 0], {plant.place}, {plant.speed}  # rows of position and velocity",
        f"s, before = {plant.start}, None",
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
    if stiff:
        lines += ["", *bend_code(lean, "def bend(z, v):", step)]
    if smooth:
        lines += ["", "def smooth(x, v):", f"    return {sum_code(smooth.strip())}"]
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
            f"f = {sum_code(' '.join(terms))}",
            f"z = ad @ s + g0 * (u + f) + g1 * ({plus} + f)",
            f"g = {sum_code(' '.join(later))}",
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
