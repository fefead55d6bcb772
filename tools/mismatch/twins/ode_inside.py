"""Packs forces and flows for the compiled loop of differential equations, and says how finely that is to step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sim_devices.physics.effect import Acting, Array
from sim_devices.physics.forces import FLOW
from tools.mismatch import units
from tools.mismatch.twins.base import Force
from tools.mismatch.twins.feedback import Rows, fastest_of, pack
from tools.mismatch.twins.ode_run import JOINT, SWAY, Packed

MOST_SUBSTEPS = 200
PUSHED = ("motion", "joint")
"""Kinds of places at which a force acts."""
VARYING = ("parameter", "state", "direction")
"""Kinds of places at which a parameter is no constant."""


@dataclass(frozen=True)
class Place:
    """Describes a place at which a force or flow may act.

    ``position``, ``velocity`` and ``target`` are indices of states; for a storage (a level, a current, a temperature)
    all three are that state. ``name`` is the state whose derivative the force is added to.
    """

    name: str
    kind: Acting
    position: int
    velocity: int
    target: int
    unit: str
    """Unit of the position, or of the stored quantity."""
    pairs: tuple[float, ...] = ()
    """Pairs of a storage (``flows.PAIRS``), or the registers of a parameter and of what it may follow: a signal, a
    state, or the direction of a state. Of a joint: position, velocity and target of its other side, the ratio b of
    x_1 - b x_2, and the typical size and speed of that."""


@dataclass(frozen=True)
class Inside:
    """Packs forces and flows of a run for the compiled loop (``ode_run.run_equations``)."""

    place: NDArray[np.int64]
    """Indices (p, 4) of the states that hold position and velocity, of the one whose derivative the force is added to,
    and 1 if any force there is smooth."""
    rows: tuple[Rows, ...]
    flows: Array
    sway: Array
    joints: Array
    """Rows (k, JOINT), see there."""
    fastest_per_s: float = 0.0

    @cached_property
    def packed(self) -> Packed:
        """Return the forces of all places, one behind the other, as the compiled loop takes them."""
        rows = self.rows

        def join(parts: list[Array]) -> Array:
            return np.concatenate(parts) if parts else np.zeros(0)

        return Packed(
            self.place,
            join([r.friction for r in rows]),
            join([r.spring for r in rows]),
            join([r.cogging for r in rows]),
            np.array([r.thresholds.size for r in rows], np.int64),
            join([r.thresholds for r in rows]),
            join([r.memory for r in rows]),
            self.flows,
            self.sway,
            self.joints,
        )


NO_SWAY = np.zeros((0, SWAY))
NOTHING = Inside(np.zeros((0, 4), np.int64), (), np.zeros((0, FLOW)), NO_SWAY, np.zeros((0, JOINT)))


def sway_of(forces: Sequence[Force], place_of: Callable[[str], Place]) -> Array:
    """Return the rows (k, SWAY) of the parameters that vary, in the order of their places."""
    by: dict[str, list[Array]] = {}
    for f in forces:
        if f.effect.fill is not None and place_of(f.target).kind in VARYING:
            by.setdefault(f.target, []).append(f.effect.fill(f.q, f.weights, f.settings)["sway"])
    return np.array([row for rows in by.values() for row in rows], np.float64).reshape(-1, SWAY)


def pack_inside(
    forces: Sequence[Force], place_of: Callable[[str], Place], reaction_of: Callable[[Place], float]
) -> Inside:
    """Return forces and flows, packed for the compiled loop; ``reaction_of`` as ``OdeTwin.reaction``."""
    by: dict[str, list[Force]] = {}
    for f in forces:
        by.setdefault(f.target, []).append(f)
    place: list[tuple[int, int, int, int]] = []
    rows: list[Rows] = []
    flows: list[Array] = []
    joints: list[Array] = []
    for name, here in by.items():
        filled = [f.effect.fill(f.q, f.weights, f.settings) for f in here if f.effect.fill is not None]
        flows += [r["flows"].reshape(-1, FLOW) for r in filled if "flows" in r]
        solid = [f for f, r in zip(here, filled, strict=True) if not {"flows", "sway"} & set(r)]
        if solid and place_of(name).kind == "joint":
            p = place_of(name)
            other, speed, target, ratio = p.pairs[:4]
            sides = [p.position, p.velocity, p.target, other, speed, target, ratio, reaction_of(p)]
            joints.append(np.array([*sides, *pack(solid).spring]))
        elif solid:
            p, row = place_of(name), pack(solid)
            smooth = bool(np.any(row.spring) or np.any(row.cogging) or row.friction[4])
            place.append((p.position, p.velocity, p.target, int(smooth)))
            rows.append(row)
    return Inside(
        np.array(place, np.int64).reshape(-1, 4),
        tuple(rows),
        np.concatenate(flows) if flows else np.zeros((0, FLOW)),
        sway_of(forces, place_of),
        np.array(joints, np.float64).reshape(-1, JOINT),
        fastest_of(forces),
    )


def substeps_of(dt: float, inside: Inside, plain_per_s: float, speeds: Array) -> tuple[int, int]:
    """Return the steps per sample, and the parts of a step in which a body may stick, slip or turn.

    ``plain_per_s``: the fastest mode without forces; ``speeds`` (s,): typical size of each state.

    There are four steps per radian of the fastest mode, two per radian of the stiffest memory (a power of two, so
    that it seldom changes during a fit) and six per period of cogging. Where friction may stick, or a bristle
    turn, there are at least two parts per sample and up to eight, for 32 per radian, because a part in which the
    velocity crosses zero is of second order only.
    """
    fastest_per_s = inside.fastest_per_s or plain_per_s
    sub, parts = int(np.ceil(dt * fastest_per_s / 0.25)), 1
    for (position, velocity, *_), rows in zip(inside.place, inside.rows, strict=True):
        springs = float(np.sum(np.abs(rows.memory))) + max(float(rows.friction[5]), 0.0)
        stiff = dt * np.sqrt(springs) / 0.5
        if stiff > sub:
            sub = 1 << int(np.ceil(np.log2(min(stiff, MOST_SUBSTEPS))))
        if np.any(rows.friction[:3] != 0.0):
            least = max(2, min(8, int(np.ceil(32 * dt * fastest_per_s))))
            parts = max(parts, least)
        if rows.cogging[0] > 0.0 and position != velocity:
            sub = max(sub, int(np.ceil(6 * speeds[velocity] * dt / rows.cogging[0])))
    sub = int(np.clip(sub, 1, MOST_SUBSTEPS))
    return sub, -(-parts // sub)


def weight_scale(unit: str, push: float, size: float, speed: float) -> float:
    """Return the typical size of a weight: the derivative ``push`` over the size of the quantity that it multiplies.

    That size follows from the ``unit`` of the weight (``{out}`` stands for the unit of the position) and from typical
    position and velocity.
    """
    try:
        d = units.parse(unit.replace("{out}", "m")).dimension
    except units.UnitError:
        return push
    # weight times column is m/s^2
    return push / (size ** (1 - d[0]) * (size / speed) ** (d[2] + 2))
