"""Estimates the attitude of an inertial sensor with a gyroscope, by one of several filters (Erat 2018, chapter 3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import asin, atan2, degrees
from typing import Any

import numpy as np
from pydantic import Field, field_validator

from firmware_py.records import Record, new
from firmware_py.sensing.attitude_params import gyroscope_error_state
from firmware_py.sensing.gyroscope_filter import GyroscopeMemory, begin_gyroscope, run_gyroscope, step_gyroscope
from hal.arrays import Array
from hal.errors import BenchError
from hal.plugins import FUSION, load, offered
from hal.validation import StrictTable

ALIGN_S = 0.1
METHODS = ("error-state", "vqf")
"""Built-in filters. A source tree offers those of Erat 2018, too (``tools.research.endoscope.published_filters``)."""


class FusionConfig(StrictTable):
    """Selects the filter and its parameters. The defaults are Erat 2018's printed choice (sections 3.3, 3.4).

    ``error-state`` is the Kalman filter of ``error_state.py``: it finds the gyroscope's bias and needs force in m/s^2.
    """

    method: str = "error-state"
    tau_s: float = Field(default=0.1, gt=0.0)
    """Time constant of the complementary filter."""
    beta: float = Field(default=0.03, ge=0.0)
    """Gain of Madgwick's filter, rad/s."""
    field_scale: float = Field(default=1.0, gt=0.0, le=1.0)
    """Madgwick with a magnetometer: 1 is the paper, 0.5 what the widely used C code of 2011 computes by an oversight
    (its predicted field is half as long as the measured one, so the magnetometer counts half)."""
    kp: float = Field(default=1.4, ge=0.0)
    ki: float = Field(default=0.002, ge=0.0)
    """Integral gain of Mahony's filter, 1/s^2. ``kp`` is the proportional gain, 1/s."""
    align_s: float = Field(default=ALIGN_S, ge=0.0, le=10.0)
    """The attitude starts from the mean of so long; 0: from level, heading zero, as the document's tests do."""

    @field_validator("method")
    @classmethod
    def _known(cls, method: str) -> str:
        known = (*METHODS, *sorted(offered(FUSION)))
        if method in known:
            return method
        if method in ("tilt", "gyroscope", "complementary", "madgwick", "mahony"):
            raise ValueError(f"'{method}' is a filter to compare with: only a source tree has it (tools/research)")
        raise ValueError(f"'{method}' is no filter; there are {', '.join(known)}")


@dataclass(frozen=True)
class FusionFilter:
    """A filter of the samples of one sensor, which a package offers in the group ``micron.fusion``.

    ``memory(config, rate_hz)`` has the fields of ``GyroscopeMemory``, and in ``state`` at least ``quaternion`` and
    ``aligned``. ``begin(memory)``, ``step(memory)`` and ``run(memory, rate, force, field, dt_s, out)`` are kernels as
    those of ``gyroscope_filter``.
    """

    memory: Callable[[FusionConfig, float], Record]
    begin: Callable[[Any], None]
    step: Callable[[Any], None]
    run: Callable[..., None]


def _error_state(config: FusionConfig, rate_hz: float) -> Record:
    memory: Record = new(GyroscopeMemory)
    memory["params"]["error_state"] = gyroscope_error_state()
    memory["params"]["align_samples"] = round(config.align_s * rate_hz)
    return memory


ERROR_STATE = FusionFilter(_error_state, begin_gyroscope, step_gyroscope, run_gyroscope)


class Fusion:
    """Filters one sensor, live or in batches: ``step`` and ``run`` use the same arithmetic and may be mixed.

    ``quaternion`` (4,) is body to world, z up, scalar first. Without a magnetometer the heading of the body's x axis
    is zero at the start. ``aligned`` is false while the start attitude is being averaged.
    """

    def __init__(self, config: FusionConfig, rate_hz: float) -> None:
        if not rate_hz > 0.0:
            raise ValueError(f"rate_hz = {rate_hz} must be positive")
        self.config = config
        self.rate_hz = rate_hz
        self._vqf: Any = _open_vqf(rate_hz) if config.method == "vqf" else None
        found = None if config.method in METHODS else load(FUSION, config.method, FusionFilter)
        self._filter = found or ERROR_STATE
        self._memory = self._filter.memory(config, rate_hz)
        self._state = self._memory["state"][0]
        self._rate, self._force, self._field, self._dt_s = (
            self._memory[name][0] for name in ("rate", "force", "field", "dt_s")
        )
        self._period_s = 1.0 / rate_hz
        self.quaternion: Array = self._state["quaternion"][0]
        self.restart()

    @property
    def aligned(self) -> bool:
        return bool(self._state["aligned"][0])

    def restart(self, start: Array | None = None) -> None:
        """Forget everything; the next samples align anew, or ``start`` (4,) is the attitude (not with "vqf" and
        "error-state")."""
        self._filter.begin(self._memory)
        if self._vqf is not None:
            self._vqf.resetState()
        elif start is not None and self._filter is not ERROR_STATE:
            self.quaternion[:] = np.asarray(start) / np.linalg.norm(start)
            self._state["aligned"] = 1

    def step(self, rate: Array, force: Array, field: Array | None = None, dt_s: float | None = None) -> Array:
        """Filter one sample (3,) in the body frame: rate in rad/s, specific force and field in any unit. Return the
        attitude."""
        self._rate[:] = rate
        self._force[:] = force
        self._field[:] = np.nan if field is None else field
        self._dt_s[0] = self._period_s if dt_s is None else dt_s
        if self._vqf is None:
            self._filter.step(self._memory)
        else:
            self._state["aligned"] = 1
            self.quaternion[:] = self._vqf_step()
        return self.quaternion

    def run(self, rate: Array, force: Array, field: Array | None = None, dt_s: Array | None = None) -> Array:
        """A recording: (n, 3) arrays to (n, 4) quaternions. ``dt_s`` (n,): time before each sample."""
        n = len(rate)
        b = np.full((n, 3), np.nan) if field is None else field
        dt = np.full(n, 1.0 / self.rate_hz) if dt_s is None else dt_s
        if not len(force) == len(b) == len(dt) == n:
            raise ValueError(f"rate, force, field, dt have {n}, {len(force)}, {len(b)}, {len(dt)} rows")
        out = np.empty((n, 4))
        if n:
            w, f, b, dt = (np.ascontiguousarray(a, dtype=np.float64) for a in (rate, force, b, dt))
            if self._vqf is None:
                self._filter.run(self._memory, w, f, b, dt, out)
            else:
                for k in range(n):
                    out[k] = self.step(w[k], f[k], b[k])
        return out

    def _vqf_step(self) -> Array:
        if np.isfinite(self._field[0]):
            self._vqf.update(self._rate, self._force, self._field)
            return _north(self._vqf.getQuat9D())
        self._vqf.update(self._rate, self._force)
        return self._vqf.getQuat6D()


def _north(east_north_up: Array) -> Array:
    """Convert a quaternion from a world with x to east to one with x to north: minus 90 degrees about up."""
    w, x, y, z = east_north_up
    h = np.sqrt(0.5)
    return np.array([h * (w + z), h * (x + y), h * (y - x), h * (z - w)])


def _open_vqf(rate_hz: float) -> Any:
    try:
        from vqf import VQF  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise BenchError("fusion method 'vqf' needs the package vqf: pip install vqf, or choose another") from error
    return VQF(1.0 / rate_hz)  # pyright: ignore[reportUnknownVariableType]


def angles_deg(quaternion: Array) -> tuple[float, float, float]:
    """Roll psi, pitch theta, yaw phi in degrees of one quaternion (3.47)-(3.49), erratum 103."""
    w, x, y, z = (float(v) for v in quaternion)
    roll = atan2(2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
    pitch = asin(max(-1.0, min(1.0, 2.0 * (w * y - x * z))))
    yaw = atan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
    return degrees(roll), degrees(pitch), degrees(yaw)
