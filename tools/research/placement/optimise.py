"""Positions and directions of accelerometers with the least angular or tip noise in a given space.

Cost: trace of W C with C = sigma^2 (H^T H)^-1, H the firmware's observation matrix; its gradient is written out
(dC = -C d(H^T H) C). Coarse first: how many packages in which box, corners and directions drawn; then
L-BFGS-B from the best, positions bounded by their box, directions as rotation vectors (axes stay orthogonal). Angular
noise alone would give translation up: the force at the tip and the weakest direction of the axes have limits, first as
soft walls, then as hard ones, and a result that breaks them is not taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from firmware_py.sensing.kinematics import observation_matrix
from hal.arrays import Array
from tools.research.placement.configurations import Placement
from tools.research.placement.space import Space

LENGTH_M = 0.05
"""Unit of position in the optimiser, so that its variables are of one size."""
DRAWS = 200
REFINED = 6
WALLS = (1.0, 1e2, 1e4)
"""Weights of the walls, one refinement after the other."""
MARGIN = 1e-3
"""The walls stand this share inside their limits, since a wall gives way a little."""


def weight_matrix(space: Space) -> tuple[Array, Array]:
    """(6, 6) weights W of the cost, and of the limit on the tip's specific force."""
    x, y, z = np.array(space.tip_mm) * 1e-3
    carry = np.hstack([np.eye(3), np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])])
    tip = carry.T @ carry
    angular = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    return (angular if space.least == "angular" else tip), tip


def cost_and_gradient(positions: Array, axes: Array, weight: Array) -> tuple[float, Array, Array]:
    """trace(W (H^T H)^-1) and its gradients by positions (N, 3) and axes (N, 3); inf for a singular placement."""
    h = observation_matrix(positions, axes)
    normal = h.T @ h
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        return float("inf"), np.zeros_like(positions), np.zeros_like(axes)
    cost = float(np.trace(weight @ inverse))
    if not np.isfinite(cost) or cost <= 0.0:
        return float("inf"), np.zeros_like(positions), np.zeros_like(axes)
    by_h = -2.0 * h @ (inverse @ weight @ inverse)
    force, turn = by_h[:, :3], by_h[:, 3:]
    # row = (s, r x s): d(r x s) = dr x s + r x ds
    return cost, np.cross(axes, turn), force + np.cross(turn, positions)


def weakest_direction(axes: Array) -> tuple[float, Array]:
    """Least eigenvalue of the sum of s s^T over unit ``axes`` (N, 3), and its direction (3,)."""
    values, vectors = np.linalg.eigh(axes.T @ axes)
    return float(values[0]), vectors[:, 0]


@dataclass(frozen=True)
class Optimum:
    placement: Placement
    boxes: tuple[str, ...]
    noise: Array
    """(4,) rms of alpha x, y, z and of the vector, rad/s^2."""
    cost: float


def optimise(space: Space, seed: int = 0) -> Optimum:
    """The best placement found; deterministic for a seed. Raises ValueError when none is observable."""
    from tools.research.placement.variance import angular_noise

    rng = np.random.default_rng(seed)
    weight, tip = weight_matrix(space)
    m = space.axes_per_package
    package = np.repeat(np.arange(space.packages), m)
    limit = (space.largest_force_noise_m_s2 / space.noise_m_s2) ** 2
    inside, least = limit * (1.0 - MARGIN), space.least_translation * (1.0 + MARGIN)
    best: tuple[float, Array, Array, tuple[int, ...]] | None = None

    def unpack(x: Array) -> tuple[Array, Array]:
        positions = x[: 3 * space.packages].reshape(-1, 3) * LENGTH_M
        turns = Rotation.from_rotvec(x[3 * space.packages :].reshape(-1, 3)).as_matrix()
        return positions[package], np.concatenate([turn.T[:m] for turn in turns])

    def allowed(positions: Array, axes: Array) -> bool:
        reach = cost_and_gradient(positions, axes, tip)[0]
        return reach <= limit and weakest_direction(axes)[0] >= space.least_translation

    def total(x: Array, wall: float = 1.0) -> tuple[float, Array]:
        positions, axes = unpack(x)
        value, by_r, by_s = cost_and_gradient(positions, axes, weight)
        if not np.isfinite(value):
            return 1e12, np.zeros_like(x)
        reach, more_r, more_s = cost_and_gradient(positions, axes, tip)
        by_r, by_s = by_r / value, by_s / value
        value = float(np.log(value))
        if not np.isfinite(reach):
            return 1e12, np.zeros_like(x)
        if reach > inside:  # all six degrees of freedom stay observable
            over = float(np.log(reach / inside))
            value += wall * over * over
            by_r, by_s = by_r + 2.0 * wall * over * more_r / reach, by_s + 2.0 * wall * over * more_s / reach
        seen, direction = weakest_direction(axes)
        if seen < least:
            under = least - seen
            value += wall * under * under
            by_s = by_s - 4.0 * wall * under * np.outer(axes @ direction, direction)
        gradient = np.zeros_like(x)
        np.add.at(gradient[: 3 * space.packages].reshape(-1, 3), package, by_r * LENGTH_M)
        # s = R e: a small world-frame turn d changes s by d x s; rotation vectors need the left Jacobian
        torque = np.zeros((space.packages, 3))
        np.add.at(torque, package, np.cross(axes, by_s))
        vectors = x[3 * space.packages :].reshape(-1, 3)
        gradient[3 * space.packages :] = np.concatenate(
            [_left_jacobian(v).T @ g for v, g in zip(vectors, torque, strict=True)]
        )
        return value, gradient

    for boxes in combinations_with_replacement(range(len(space.box)), space.packages):
        low = np.array([space.box[b].low_mm for b in boxes]) * 1e-3 / LENGTH_M
        high = np.array([space.box[b].high_mm for b in boxes]) * 1e-3 / LENGTH_M
        starts = []
        for k in range(DRAWS):
            share = rng.integers(0, 2, low.shape).astype(float) if k % 2 == 0 else rng.random(low.shape)
            x = np.concatenate([(low + share * (high - low)).ravel(), rng.normal(0.0, 1.2, 3 * space.packages)])
            starts.append((total(x)[0], k, x))
        starts.sort(key=lambda start: start[:2])
        bounds = [*zip(low.ravel(), high.ravel(), strict=True), *[(None, None)] * (3 * space.packages)]
        for value, _, start in starts[:REFINED]:
            if value >= 1e11:
                continue
            x = start
            for wall in WALLS:
                x = minimize(total, x, (wall,), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 150}).x
            positions, axes = unpack(x)
            cost = float(np.log(cost_and_gradient(positions, axes, weight)[0]))
            if allowed(positions, axes) and (best is None or cost < best[0]):
                best = (cost, positions, axes, boxes)
    if best is None:
        raise ValueError(
            f"{space.title}: no placement in this space keeps the force at the tip to "
            f"{space.largest_force_noise_m_s2:g} m/s^2 and every direction seen by {space.least_translation:g} axes"
        )
    cost, positions, axes, boxes = best
    placement = Placement(f"{space.packages} packages of {m} axes, optimised", positions, axes)
    return Optimum(placement, tuple(space.box[b].name for b in boxes), angular_noise(placement, space.noise_m_s2), cost)


def _left_jacobian(v: Array) -> Array:
    """d(turn) / d(rotation vector), world frame."""
    angle = float(np.linalg.norm(v))
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    if angle < 1e-6:
        return np.eye(3) + 0.5 * cross
    a, b = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.eye(3) + a * cross + b * cross @ cross
