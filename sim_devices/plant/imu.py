"""Simulates the analog side of an inertial measurement unit: the outputs of its sensing elements.

out = (I + S) u + b + k (T - 25 degC) + G f + drift, through one pole at the chip's bandwidth, plus noise.
S: scale errors and misalignment, G: sensitivity of a gyroscope to specific force, drift: first-order Gauss-Markov.
Noise has rms = density x sqrt(bandwidth) (errata no. 114). A seed draws one chip; data sheet limits are four
standard deviations. Sources: MPU-6050 product specification rev. 3.4 sec. 6.1, 6.2; LSM6DS3 data sheet rev. 10
Tables 3; BMX055 data sheet rev. 1.3 Tables 2 to 4; Erat 2018, Tables 5.1 and 5.2.
Not simulated: nonlinearity, structural resonance, vibration rectification, a delay beyond that of the pole.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from hal.compiled import kernel
from sim_devices.plant.body_motion import BodyMotion, MotionSource, Mount
from sim_devices.plant.sensors import STANDARD_GRAVITY, rc_weights
from sim_devices.plant.streams import stream

Vector = tuple[float, float, float]

REFERENCE_C = 25.0
_SIGMAS = 4.0
_NOISE_BLOCK = 256
_MG = STANDARD_GRAVITY * 1e-3
_DPS = math.pi / 180.0


def _each(value: float) -> Vector:
    return value, value, value


@dataclass(frozen=True)
class TriadSpec:
    """Limits of one kind of three-axis sensor in its SI unit (m/s^2, rad/s or uT; per K; per sqrt(Hz))."""

    bias: Vector
    bias_per_K: Vector
    scale: float
    cross_axis: float
    noise_density: float
    scale_per_K: float = 0.0
    per_m_s2: float = 0.0
    """Sensitivity to specific force, unit per m/s^2."""
    drift: float = 0.0
    """Slow wander at constant temperature, rms."""
    drift_s: float = 100.0


@dataclass(frozen=True)
class ImuSpec:
    accelerometer: TriadSpec
    gyroscope: TriadSpec
    magnetometer: TriadSpec | None = None
    self_heating_K: float = 2.0
    temperature_spread_K: float = 3.0
    """Limit of the temperature sensor's offset."""


MPU6050_SPEC = ImuSpec(
    TriadSpec((50 * _MG, 50 * _MG, 80 * _MG), (0.5 * _MG, 0.5 * _MG, 0.86 * _MG), 0.03, 0.02, 0.4 * _MG, 2e-4),
    TriadSpec(
        _each(20 * _DPS),
        _each(0.16 * _DPS),
        0.03,
        0.02,
        5e-3 * _DPS,
        1.6e-4,
        0.1 * _DPS / STANDARD_GRAVITY,
        3e-3 * _DPS,
    ),
)
LSM6DS3_SPEC = ImuSpec(
    TriadSpec(_each(40 * _MG), _each(0.5 * _MG), 0.01, 0.01, 0.09 * _MG, 1e-4),
    TriadSpec(
        _each(10 * _DPS),
        _each(0.05 * _DPS),
        0.015,
        0.01,
        7e-3 * _DPS,
        1.2e-4,
        0.1 * _DPS / STANDARD_GRAVITY,
        2e-3 * _DPS,
    ),
    self_heating_K=0.8,
    temperature_spread_K=5.0,
)
BMX055_SPEC = ImuSpec(
    TriadSpec(_each(80 * _MG), _each(1.0 * _MG), 0.01, 0.01, 0.15 * _MG, 2e-4),
    TriadSpec(
        _each(1 * _DPS), _each(0.015 * _DPS), 0.01, 0.01, 14e-3 * _DPS, 3e-4, 0.1 * _DPS / STANDARD_GRAVITY, 2e-3 * _DPS
    ),
    TriadSpec(_each(40.0), _each(0.0), 0.02, 0.01, 0.0),
    self_heating_K=1.5,
    temperature_spread_K=5.0,
)


@dataclass(frozen=True)
class TriadUnit:
    """Holds the parameters of one three-axis sensor, which the seed draws. ``gain`` (3, 3) is I + S."""

    gain: Array
    bias: Array
    bias_per_K: Array
    scale_per_K: Array
    per_m_s2: Array
    noise_density: float
    drift: float
    drift_s: float


def triad_unit(spec: TriadSpec, rng: np.random.Generator, errors: float = 1.0, noise: float = 1.0) -> TriadUnit:
    """Draw a unit. ``errors`` and ``noise`` scale everything constant and everything random: 0 is ideal."""
    draw = rng.standard_normal((6, 3)).clip(-_SIGMAS, _SIGMAS) * errors / _SIGMAS
    cross = spec.cross_axis * rng.standard_normal((3, 3)).clip(-_SIGMAS, _SIGMAS) * errors / _SIGMAS
    np.fill_diagonal(cross, 1.0 + spec.scale * draw[0])
    per_m_s2 = spec.per_m_s2 * rng.standard_normal((3, 3)).clip(-_SIGMAS, _SIGMAS) * errors / _SIGMAS
    return TriadUnit(
        cross,
        np.array(spec.bias) * draw[1],
        np.array(spec.bias_per_K) * draw[2],
        spec.scale_per_K * draw[3],
        per_m_s2,
        spec.noise_density * noise,
        spec.drift * noise,
        spec.drift_s,
    )


@kernel
def _triad_step(unit, felt, state, draw, weights, out):
    """Compute one sample ``out`` (3,) and update ``state`` (4, 3). ``draw`` (6,) is standard normal; ``felt``: what is
    measured, the specific force, and how far the sensor is above its reference temperature."""
    gain, bias, bias_per_K, scale_per_K, per_m_s2 = unit
    feels, force, warm_K = felt
    keep, start, end, sigma, drift_keep, drift = weights
    for i in range(3):
        u = gain[i, 0] * feels[0] + gain[i, 1] * feels[1] + gain[i, 2] * feels[2]
        u = u * (1.0 + scale_per_K[i] * warm_K) + bias[i] + bias_per_K[i] * warm_K
        u += per_m_s2[i, 0] * force[0] + per_m_s2[i, 1] * force[1] + per_m_s2[i, 2] * force[2]
        state[1, i] = keep * state[1, i] + start * state[0, i] + end * u
        state[0, i] = u
        state[2, i] = keep * state[2, i] + math.sqrt(1.0 - keep * keep) * sigma * draw[i]
        state[3, i] = drift_keep * state[3, i] + drift * math.sqrt(1.0 - drift_keep * drift_keep) * draw[3 + i]
        out[i] = state[1, i] + state[2, i] + state[3, i]


class Triad:
    """A three-axis sensor in time. ``feel`` gives (what is measured, specific force, temperature) at an instant."""

    def __init__(
        self, unit: TriadUnit, feel: Callable[[int], tuple[Array, Array, float]], rng: np.random.Generator
    ) -> None:
        self.unit = unit
        self._feel, self._rng = feel, rng
        self._t_ns = -1
        self._state = np.zeros((4, 3))  # input before, filter, noise, drift
        self._state[3] = unit.drift * rng.standard_normal(3)
        self._block, self._used = np.zeros((_NOISE_BLOCK, 6)), _NOISE_BLOCK
        self._weights: dict[tuple[float, int], tuple[float, float, float, float]] = {}

    def sample(self, t_ns: int, bandwidth_hz: float) -> Array:
        """Return a sample (3,) behind one pole at ``bandwidth_hz``. The signal is linear between calls."""
        feels, force, temperature_C = self._feel(t_ns)
        unit = self.unit
        keep, start, end, drift_keep = 0.0, 0.0, 1.0, 1.0  # the first sample is settled
        if self._t_ns >= 0:
            keep, start, end, drift_keep = self._steps(bandwidth_hz, max(1, t_ns - self._t_ns))
        self._t_ns = max(t_ns, self._t_ns)
        out = np.empty(3)
        _triad_step(
            (unit.gain, unit.bias, unit.bias_per_K, unit.scale_per_K, unit.per_m_s2),
            (feels, force, temperature_C - REFERENCE_C),
            self._state,
            self._draw(),
            (keep, start, end, unit.noise_density * math.sqrt(bandwidth_hz), drift_keep, unit.drift),
            out,
        )
        return out

    def _draw(self) -> Array:
        if self._used == _NOISE_BLOCK:
            self._rng.standard_normal(out=self._block)
            self._used = 0
        self._used += 1
        return self._block[self._used - 1]

    def _steps(self, bandwidth_hz: float, step_ns: int) -> tuple[float, float, float, float]:
        key = (bandwidth_hz, step_ns)
        if key not in self._weights:
            if len(self._weights) > 64:
                self._weights.clear()
            step_s = step_ns * 1e-9
            weights = rc_weights(0.5 / math.pi / bandwidth_hz, step_s)
            self._weights[key] = (*weights, math.exp(-step_s / self.unit.drift_s))
        return self._weights[key]


class Imu:
    """Simulates the sensing elements of one chip on a moving body. All times are bench ns and do not run backwards."""

    def __init__(
        self,
        spec: ImuSpec,
        motion: MotionSource,
        *,
        seed: int = 1,
        name: str = "imu",
        mount: Mount | None = None,
        errors: float = 1.0,
        noise: float = 1.0,
    ) -> None:
        self._motion, self._mount = motion, mount or Mount()
        self.noise = noise
        self._heating_K = spec.self_heating_K * errors
        self._at_ns, self._now = -1, None
        units, hiss = stream(seed, f"{name}.unit"), stream(seed, f"{name}.noise")
        self.temperature_offset_K = spec.temperature_spread_K / _SIGMAS * float(units.standard_normal()) * errors
        self.accelerometer = Triad(triad_unit(spec.accelerometer, units, errors, noise), self._force, hiss)
        self.gyroscope = Triad(triad_unit(spec.gyroscope, units, errors, noise), self._rate, hiss)
        self.magnetometer = None
        if spec.magnetometer is not None:
            self.magnetometer = Triad(triad_unit(spec.magnetometer, units, errors, noise), self._field, hiss)
        self._load_kernels()
        self.self_test_gain = 1.0 + 0.05 * units.standard_normal(6).clip(-2.0, 2.0) * errors
        """Differences of this chip's self-test responses from the factory's, accelerometer then gyroscope."""

    def _load_kernels(self) -> None:
        """Compile or load now, not when the first sample is due in real time."""
        self._mount.felt(BodyMotion(np.eye(3), np.zeros(3), np.zeros(3)))
        unit, zeros = self.accelerometer.unit, np.zeros(3)
        errors = unit.gain, unit.bias, unit.bias_per_K, unit.scale_per_K, unit.per_m_s2
        weights = (0.0, 0.0, 1.0, 0.0, 1.0, 0.0)
        _triad_step(errors, (zeros, zeros, 0.0), np.zeros((4, 3)), np.zeros(6), weights, np.empty(3))

    def temperature_C(self, t_ns: int) -> float:
        """Return the temperature of the die in degC, as its own sensor measures it."""
        return self._look(t_ns)[2] + self.temperature_offset_K

    def _look(self, t_ns: int) -> tuple[Array, Array, float, BodyMotion]:
        if self._now is None or t_ns != self._at_ns:
            motion = self._motion(t_ns)
            force, rate = self._mount.felt(motion)
            self._at_ns, self._now = t_ns, (force, rate, motion.temperature_C + self._heating_K, motion)
        return self._now

    def _force(self, t_ns: int) -> tuple[Array, Array, float]:
        force, _, temperature_C, _ = self._look(t_ns)
        return force, force, temperature_C

    def _rate(self, t_ns: int) -> tuple[Array, Array, float]:
        force, rate, temperature_C, _ = self._look(t_ns)
        return rate, force, temperature_C

    def _field(self, t_ns: int) -> tuple[Array, Array, float]:
        force, _, temperature_C, motion = self._look(t_ns)
        return self._mount.field_uT(motion), force, temperature_C
