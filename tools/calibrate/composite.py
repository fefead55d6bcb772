"""The physical model of Ang 2004 sec. 3.2.1 for single accelerometer axes, from poses whose attitude is known.

    V = B + S ((theta . f) (1 + r1 Lz + r2 Lz^2) + p2 Ly^2 + q2 Lz^2),   L = (V - B) / S of the neighbour

f in g, V at nominal supply. This is (3.11) solved for V. The linear parts p1, q1 of (3.8) and (3.10) are not fitted:
at rest they look exactly as a turn of the sensing axis theta, which carries both (as erratum 29 for the constants).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import t as student

from hal.arrays import Array
from tools.calibrate.multi_position import Estimate, estimates_of, missing_poses
from tools.errors import InputError
from tools.numbers import rms

NAMES = ("bias_V", "s_x", "s_y", "s_z", "in_plane_2", "out_of_plane_2", "scale_1", "scale_2")
DRIFT = "drift_V"
LARGEST_CONDITION = 100.0
UNKNOWN = Estimate(0.0, -np.inf, np.inf)


@dataclass(frozen=True)
class AxisFit:
    """Holds the fit of one axis: parameters with 95 % intervals (``s_*`` in V/g, the others as in ``SensingConfig``),
    residual rms V.

    ``linear_rms_V``: of bias, scale and direction alone. ``held_out_rms_V``: every fifth pose, from the others.
    ``drift``: change of the bias in V from the first pose to the last; an infinite interval: the poses cannot show it.
    """

    parameters: dict[str, Estimate]
    residual_rms_V: float
    linear_rms_V: float
    held_out_rms_V: float
    condition: float
    drift: Estimate

    def value(self, name: str) -> float:
        return self.parameters[name].value

    @property
    def scale_V_per_g(self) -> float:
        return float(np.linalg.norm([self.value(n) for n in NAMES[1:4]]))

    @property
    def direction(self) -> tuple[float, float, float]:
        s = np.array([self.value(n) for n in NAMES[1:4]]) / self.scale_V_per_g
        return float(s[0]), float(s[1]), float(s[2])


@dataclass(frozen=True)
class CompositeFit:
    """Holds the fits of all axes, and the directions of gravity that no pose covers."""

    axes: tuple[AxisFit, ...]
    poses: int
    missing: tuple[str, ...]


def _forward(x: Array, force: Array, y: Array, z: Array, when: Array) -> Array:
    scale = float(np.linalg.norm(x[1:4]))
    along = force @ x[1:4]
    return x[0] + along * (1.0 + z * (x[6] + x[7] * z)) + scale * (x[4] * y * y + x[5] * z * z) + x[8] * when


def _fit(volts: Array, force: Array, y: Array, z: Array, when: Array, free: list[int]) -> tuple[Array, Array]:
    """Nine numbers (``NAMES`` and drift) of which ``free`` are fitted, and the Jacobian over those."""
    start = np.zeros(9)
    design = np.column_stack([np.ones(len(force)), force])
    start[:4] = np.linalg.lstsq(design, volts, rcond=None)[0]

    def residual(p: Array) -> Array:
        x = start.copy()
        x[free] = p
        return _forward(x, force, y, z, when) - volts

    solution = least_squares(residual, start[free], method="lm", xtol=1e-14, ftol=1e-14)
    x = start.copy()
    x[free] = solution.x
    return x, np.asarray(solution.jac)


def fit_composite(
    volts: Array,
    force: Array,
    in_plane: tuple[int, ...],
    out_of_plane: tuple[int, ...],
    *,
    quadratic: bool = True,
    fit_drift: bool = False,
) -> CompositeFit:
    """Identify every column of ``volts`` (n, k) at nominal supply; ``force`` (n, 3) in g, body axes, poses in order.

    ``in_plane`` and ``out_of_plane`` (k,) name the column that stands for V_y and V_z. InputError when the poses do
    not show all parameters. ``fit_drift`` takes a drift of the bias off; otherwise it is only told.
    """
    n, k = volts.shape
    if n < 12:
        raise InputError(f"{n} poses: eight parameters an axis need at least 12, and better 50")
    directions = force / np.linalg.norm(force, axis=1)[:, None]
    missing = missing_poses(directions)
    when = np.linspace(-0.5, 0.5, n)
    design = np.column_stack([np.ones(n), force])
    # poses that run from one pole to the other cannot tell a drift from the axis along which they run
    is_determined = float(np.linalg.cond(np.column_stack([design, when]))) < LARGEST_CONDITION
    if fit_drift and not is_determined:
        raise InputError("the poses follow gravity so regularly that a drift does not show; take them in another order")
    model = list(range(8 if quadratic else 4))
    free = [*model, 8] if is_determined else model
    lines = np.linalg.lstsq(design, volts, rcond=None)[0]
    bias, scale = lines[0], np.linalg.norm(lines[1:], axis=0)
    if np.any(scale == 0.0) or np.linalg.cond(design) > LARGEST_CONDITION:
        raise InputError(f"{n} poses do not turn gravity through all axes; missing: {', '.join(missing) or 'variety'}")
    fits: list[tuple[Array, Array]] = []
    for _ in range(3):  # the neighbours' lines come from the same fit
        reading = (volts - bias) / scale
        fits = [
            _fit(volts[:, i], force, reading[:, in_plane[i]], reading[:, out_of_plane[i]], when, free) for i in range(k)
        ]
        bias, scale = np.array([x[0] for x, _ in fits]), np.array([np.linalg.norm(x[1:4]) for x, _ in fits])
    reading = (volts - bias) / scale
    kept = np.arange(n) % 5 != 4
    axes = []
    for i, (x, jacobian) in enumerate(fits):
        y, z = reading[:, in_plane[i]], reading[:, out_of_plane[i]]
        intervals, condition = _intervals(x, jacobian, volts[:, i] - _forward(x, force, y, z, when), free)
        if condition > LARGEST_CONDITION:
            raise InputError(
                f"axis {i}: condition number {condition:.0f}; the poses do not tell its parameters apart "
                f"(missing: {', '.join(missing) or 'poses between the axes'})"
            )
        drift = intervals.pop(DRIFT) if is_determined else UNKNOWN
        if not fit_drift:
            x, jacobian = _fit(volts[:, i], force, y, z, when, model)
            intervals, condition = _intervals(x, jacobian, volts[:, i] - _forward(x, force, y, z, when), model)
            intervals.pop(DRIFT, None)
        inner, _ = _fit(volts[kept, i], force[kept], y[kept], z[kept], when[kept], free if fit_drift else model)
        out = ~kept
        held_out = volts[out, i] - _forward(inner, force[out], y[out], z[out], when[out])
        linear = volts[:, i] - design @ lines[:, i]
        axes.append(
            AxisFit(
                intervals,
                rms(volts[:, i] - _forward(x, force, y, z, when)),
                rms(linear),
                rms(held_out),
                condition,
                drift,
            )
        )
    return CompositeFit(tuple(axes), n, missing)


def _intervals(x: Array, jacobian: Array, residual: Array, free: list[int]) -> tuple[dict[str, Estimate], float]:
    freedom = len(residual) - jacobian.shape[1]
    sigma2 = float(residual @ residual) / freedom
    size = np.linalg.norm(jacobian, axis=0)
    condition = float(np.linalg.cond(jacobian / size))
    spread = np.zeros(9)
    spread[free] = np.sqrt(np.diag(sigma2 * np.linalg.pinv(jacobian.T @ jacobian)))
    reach = float(student.ppf(0.975, freedom)) * spread
    return estimates_of((*NAMES, DRIFT), x, reach), condition
