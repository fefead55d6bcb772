"""Designs the parameters of the adaptive filter that are known before the first sample: bank, target, prior spectra.

Features are the states of a bank of fixed filters on the samples. With the prior hand (tremor, voluntary motion,
sensor noise and drift as spectra) their covariance and its cross-covariance with the tremor ahead are integrals over
frequency; solved, they are the Wiener filter of that hand (Wiener 1949, here over a finite basis).

There are two priors, for two levels of motion: a calm hand, whose motion is hardly above the sensor's noise, and a
burst (a reach, a click, strong tremor), whose motion is far above it and wider. One filter cannot be right for both.

The target that the filter learns from is the tremor itself some 0.4 s ago, out of a filter that looks to both sides of
that instant: band, double integration and the sensor's filter in one set of taps, by weighted least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import cos, isfinite, pi, sin, sqrt
from typing import Any

import numpy as np

from firmware_py.designs import design
from firmware_py.tremor.config import AdaptiveConfig, LeverConfig, TremorConfig
from hal.arrays import Array, ComplexArray

GRID_STEP_HZ = 0.02
GRID_STOP_HZ = 250.0
AXES = 3
OUTPUTS = 3
"""Number of a filter's outputs: tremor now, tremor a loop delay later, the part of the latter in the core band."""
LEVELS = 2
"""Number of levels of motion: calm, burst."""


@dataclass(frozen=True)
class Bank:
    """Describes the filter bank: for each channel resonators z <- p z + (1 - |p|) y (two states each), low-passes, and
    the sample itself, in this order."""

    pole: ComplexArray
    slow: Array
    channels: int = 1

    @property
    def one(self) -> int:
        """Number of features of one channel."""
        return 2 * len(self.pole) + len(self.slow) + 1

    @property
    def size(self) -> int:
        return self.channels * self.one

    def response(self, z: ComplexArray) -> ComplexArray:
        """Return the response (one, n) from a channel's sample to its features at ``z`` (n,) = exp(j w / rate)."""
        p, gain = self.pole[:, None], 1.0 - np.abs(self.pole[:, None])
        one, other = gain / (1.0 - p / z), gain / (1.0 - np.conj(p) / z)
        out = np.ones((self.one, len(z)), dtype=np.complex128)
        n = 2 * len(self.pole)
        out[0:n:2], out[1:n:2] = 0.5 * (one + other), (one - other) / 2j
        out[n:-1] = (1.0 - self.slow[:, None]) / (1.0 - self.slow[:, None] / z)
        return out


@dataclass(frozen=True)
class WeightedDesign:
    """Holds the prior as it is seen through the filter of errors ``weight`` (b0 b1 b2 a1 a2).

    Prior of unit tremor power per level: ``tremor`` (2, m, m), ``cross`` (2, 3, m). Of each axis: ``rest`` (3, m, m)
    does not scale with the tremor; ``noise_cross`` (3, 3, m) and ``noise_power`` (3,) are the sensor noise's share in
    learning. ``lean_cross`` (2, 3, one) and ``lean_power`` (2,) are what gravity can add to them.
    ``weighted_power`` (2,), m^2, and ``least_power`` are of the priors' tremor.
    """

    weight: Array
    tremor: Array
    rest: Array
    cross: Array
    noise_cross: Array
    noise_power: Array
    lean_cross: Array
    lean_power: Array
    weighted_power: Array
    least_power: float


@dataclass(frozen=True)
class AdaptiveDesign(WeightedDesign):
    """Holds everything that follows from a configuration; as a ``WeightedDesign`` it is of the whole motion.

    ``core`` is of the tremor band, and with ``core_above`` of what is above it. ``taps`` (3, L) on block means: the
    outputs' targets ``L // 2`` blocks ago. ``gate``: b0 b1 b2 a1 a2; ``gate_power`` (3,) of its output, where both
    levels count the same. Not weighted are, of each axis: ``quiet`` (3, m, m), the penalty on what the filter passes
    above the band; ``start`` (3, 2, 3, m), the priors' filters; ``onward`` (3, C, m), next samples from present
    features. ``lean`` says by how much gravity adds ``lean_cross`` and ``lean_power``.
    """

    bank: Bank
    block_ticks: int
    taps: Array
    gate: Array
    gate_power: Array
    quiet: Array
    lean: Lean
    start: Array
    onward: Array
    core: WeightedDesign


@dataclass(frozen=True)
class _Spectra:
    """One-sided densities over ``hz``: unit tremor m^2/Hz per level, the rest as seen, noise of the sensor as seen.

    All are of the tip; ``motion_in_channels`` and ``noise_in_channels`` say how much of them the lever's channels see.
    """

    hz: Array
    seen: ComplexArray  # from displacement to sample
    tremor: Array  # (2, f)
    rest: Array
    noise: Array


def bank_of(config: AdaptiveConfig, tick_hz: float, channels: int = 1) -> Bank:
    """Return the filter bank that ``config`` describes, for samples at ``tick_hz``."""
    centre = np.asarray(config.centres_hz)
    pole = np.exp((-pi * config.bandwidth_hz + 2j * pi * centre) / tick_hz)
    return Bank(pole, np.exp(-2.0 * pi * np.asarray(config.slow_hz) / tick_hz), channels)


def motion_in_channels(config: TremorConfig) -> Array:
    """Return the covariance (C, C) of the channels for a motion of the tip of unit variance.

    The prior hand's turn about the point that is known best is independent of that point's own motion and has
    ``lever_share`` of the variance. It turns about the arm as much as across it, independently.
    """
    share = config.adaptive.lever_share
    if config.lever is None:
        return np.ones((1, 1))
    channels = np.array([[1.0, share, 0.0], [share, share, 0.0], [0.0, 0.0, share]])
    return channels if config.lever.noise else channels[:2, :2]


def noise_in_channels(config: TremorConfig, axis: int = 0) -> Array:
    """Return the covariance (C, C) of the channels' noise for noise of the tip of unit variance."""
    if config.lever is None:
        return np.ones((1, 1))
    if config.lever.noise is None:
        turning = (config.lever.noise_m_s2_rtHz[axis] / config.lever.tip_noise_m_s2_rtHz[axis]) ** 2
        return np.array([[1.0, turning], [turning, turning]])
    signals = lever_signals(config.lever)[axis]
    noise = signals @ np.array(config.lever.noise) @ signals.T
    return np.asarray(noise / noise[0, 0])


def lever_signals(lever: LeverConfig) -> Array:
    """Return (3, C, 6), which gives the channels of each axis from the tip's specific force and angular acceleration.

    They are the tip's own, arm x alpha along the axis (the turn's part of it) and arm . alpha (the turn about the arm).
    """
    x, y, z = lever.arm_m
    signals = np.zeros((AXES, 3, 6))
    signals[:, 0, :3] = np.eye(AXES)
    signals[:, 1, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    signals[:, 2, 3:] = lever.arm_m
    return signals


@dataclass(frozen=True)
class Lean:
    """Describes the noise that gravity carries into the tip's acceleration, as a function of up (3,) in the body frame.

    Noise alpha turns the estimated attitude by -alpha / w^2, and so gravity by g up x alpha / w^2. ``by_up`` (3, C, 3)
    times up gives the covariance of each channel of an axis with the tip's along it, to be divided by w^2;
    ``by_square`` (3, 3, 3) with up twice the tip's own, by w^4.
    """

    by_up: Array
    by_square: Array


def lean_of(config: TremorConfig) -> Lean:
    """Return zeros without a lever."""
    lever = config.lever
    if lever is None or lever.noise is None:
        return Lean(np.zeros((AXES, 2 if lever else 1, 3)), np.zeros((AXES, 3, 3)))
    noise, signals = np.array(lever.noise), lever_signals(lever)
    # e_k x alpha along axis i: (3, 3, 6) by i, k
    carried = np.zeros((AXES, 3, 6))
    carried[:, :, 3:] = lever.gravity_m_s2 * np.moveaxis(np.cross(np.eye(3)[:, None], np.eye(3)[None]), 2, 0)
    by_up = np.einsum("icn,nm,ikm->ick", signals, noise, carried)
    by_up[:, 0] *= 2.0
    return Lean(by_up, np.einsum("ikn,nm,ilm->ikl", carried, noise, carried))


def sensor_response(config: TremorConfig, hz: Array) -> ComplexArray:
    """Return the response from displacement to sample: the RC filter, and -w^2 for an accelerometer."""
    w = 2.0 * pi * hz
    cutoff = config.filter_cutoff_rad_s
    low_pass = 1.0 / (1.0 + (1j * w / cutoff if isfinite(cutoff) else 0j * w))
    return _complex(-(w**2) * low_pass if config.sees == "acceleration" else low_pass)


def sensor_noise(config: TremorConfig, hz: Array, axis: int = 0) -> Array:
    """Return the one-sided density of the sensor's noise in a sample, in the sample's unit squared per Hz."""
    a, per_sample = config.adaptive, 2.0 / config.tick_hz
    if config.sees == "displacement":
        return np.full(len(hz), a.reading_noise_m**2 * per_sample)
    low_pass = np.abs(sensor_response(config, hz) / (2.0 * pi * hz) ** 2) ** 2
    density = (a.sensor_noise_m_s2_rtHz if config.lever is None else config.lever.tip_noise(axis)) ** 2
    return np.asarray(low_pass * density + a.reading_noise_m_s2**2 * per_sample)


def _penalty_above_band(config: TremorConfig, bank: Bank, axis: int) -> Array:
    """Return the bank's covariance (m, m) for ``quiet`` times the sensor's noise above the cancelled band.

    The penalty rises over one octave from the upper edge of the band and holds up to half the tick rate. A tip has
    nothing to cancel there: all that a filter passes shakes it, and the stacks' resonance amplifies it
    (``shaking_power``).
    """
    a = config.adaptive
    hz = np.arange(a.cancel_to_hz[1], 0.5 * config.tick_hz, 0.5)
    above = np.clip(hz / a.cancel_to_hz[1] - 1.0, 0.0, 1.0)
    features = bank.response(_complex(np.exp(2j * pi * hz / config.tick_hz)))
    density = a.quiet * above * sensor_noise(config, hz, axis) * np.maximum(1.0, shaking_power(config, hz))
    of_tip = np.real((features * density) @ features.conj().T) * 0.5
    return np.asarray(np.kron(noise_in_channels(config, axis), of_tip), dtype=np.float64)


def shaking_power(config: TremorConfig, hz: Array) -> Array:
    """Return the share (n,) of a command's power at ``hz`` (n,), below half the tick rate, that shakes the actuators.

    A command is held for a tick. So its spectrum repeats about the tick rate, under the hold's sinc, and the first
    image can lie on the actuators' resonance although the command itself cannot. The resonance is anywhere in
    ``shaken_hz``: the power is the mean over it. 1 everywhere without one.
    """
    a, tick_hz = config.adaptive, config.tick_hz
    if not a.shaken_hz:
        return np.ones(len(hz))
    resonance_hz: Array = np.linspace(*a.shaken_hz, 11)[:, None]
    power: Array = np.zeros(len(hz))
    for at_hz in (hz, tick_hz - hz):
        ratio = at_hz / resonance_hz
        gain = 1.0 / np.abs(1.0 - ratio**2 + 2j * a.shaken_damping * ratio)
        power += np.mean(gain**2, axis=0) * np.sinc(at_hz / tick_hz) ** 2
    return power


def spectra(config: TremorConfig, axis: int = 0) -> _Spectra:
    """Return the spectra of the prior hand as the sensor measures them along ``axis``."""
    a = config.adaptive
    hz = np.arange(GRID_STEP_HZ, min(GRID_STOP_HZ, 0.5 * config.tick_hz), GRID_STEP_HZ)
    seen = sensor_response(config, hz)
    narrow = 1.0 / (1.0 + np.abs((hz - a.tremor_hz) / a.tremor_half_width_hz) ** 6)
    narrow /= np.sum(narrow) * GRID_STEP_HZ
    # as recorded people move; beyond what their recordings hold, the fourth power
    top_hz = a.burst_hz[-1]
    level_dB = np.interp(np.log(hz), np.log(a.burst_hz), a.burst_dB)
    burst = 10.0 ** (0.1 * level_dB) / np.maximum(1.0, hz / top_hz) ** 4
    burst /= np.sum(burst * band(hz, (*a.cancel_from_hz, *a.cancel_to_hz))) * GRID_STEP_HZ
    mixed = a.burst_share * burst + (1.0 - a.burst_share) * narrow
    slow = a.voluntary_m**2 / a.voluntary_hz / (1.0 + (hz / a.voluntary_hz) ** 6)
    slow += a.unsteadiness_m**2 * 0.6 / (1.0 + hz**2) ** 2
    noise = sensor_noise(config, hz, axis)
    rest = noise + _drift(config, hz) + np.abs(seen) ** 2 * slow
    return _Spectra(hz, seen, np.stack([narrow, mixed]), rest, noise)


def band(hz: Array, edges_hz: tuple[float, float, float, float]) -> Array:
    """Return 0 up to the first edge, 1 from the second to the third, 0 from the fourth on, raised cosines between."""
    low, full, fall, none = edges_hz
    inside = np.clip((hz - low) / (full - low), 0.0, 1.0) * np.clip((none - hz) / (none - fall), 0.0, 1.0)
    return np.asarray(0.5 - 0.5 * np.cos(pi * inside))


def target_taps(
    config: TremorConfig, block_ticks: int, advance_s: float, edges_hz: tuple[float, float, float, float]
) -> Array:
    """Return taps (L,) on block means that give the displacement (m) in the band ``edges_hz``, L // 2 blocks ago plus
    ``advance_s``.

    Least squares over frequency of the displacement's error: fully counted where ``band`` is 0 or 1, a tenth on its
    edges; below the first edge by what voluntary motion and drift are there against a tremor of the prior's size.
    """
    a = config.adaptive
    rate_hz = config.tick_hz / block_ticks
    half = round(a.half_width_s * rate_hz)
    hz = np.arange(0.02, 0.5 * rate_hz, 0.04)
    wanted = band(hz, edges_hz)
    seen = sensor_response(config, hz) * block_response(hz, block_ticks, config.tick_hz)
    lag = np.exp(-2j * pi * hz[:, None] / rate_hz * (np.arange(2 * half + 1) - half)[None, :])
    rows, goal = lag * seen[:, None], wanted * np.exp(2j * pi * hz * advance_s)
    weight = np.where((wanted > 0.0) & (wanted < 1.0), 0.5, 1.0)
    below = hz <= edges_hz[0]
    voluntary = a.voluntary_m / a.tremor_rms_m
    weight[below] *= np.sqrt(1.0 + voluntary**2 / (1.0 + (hz[below] / a.voluntary_hz) ** 6))
    # drift is no displacement: it enters behind the sensor's double differentiation
    floor = np.sqrt(edges_hz[2] * _drift(config, hz)) / a.tremor_rms_m
    parts = [rows * weight[:, None], lag[below] * floor[below, None]]
    matrix = np.concatenate([part for p in parts for part in (p.real, p.imag)])
    aim = np.concatenate([(goal * weight).real, (goal * weight).imag, np.zeros(2 * np.count_nonzero(below))])
    return np.asarray(np.linalg.lstsq(matrix, aim, rcond=None)[0], dtype=np.float64)


def _drift(config: TremorConfig, hz: Array) -> Array:
    """Return the density of residual gravity and bias, in the sample's unit squared per Hz; 0 for a displacement."""
    a = config.adaptive
    if config.sees == "displacement":
        return np.zeros(len(hz))
    low_pass = np.abs(sensor_response(config, hz) / (2.0 * pi * hz) ** 2) ** 2
    return np.asarray(low_pass * 4.0 * a.drift_m_s2**2 * a.drift_s / (1.0 + (2.0 * pi * hz * a.drift_s) ** 2))


def block_response(hz: Array, block_ticks: int, tick_hz: float) -> ComplexArray:
    """Return the frequency response of the mean over a block, timed at its last sample."""
    lag = np.exp(-1j * pi * hz * (block_ticks - 1) / tick_hz)
    return _complex(lag * np.sinc(hz * block_ticks / tick_hz) / np.sinc(hz / tick_hz))


def solve_scaled(matrix: Array, right: Array) -> Array:
    """Solve a positive definite system (m, m) whose unknowns differ in size. Return (k, m) for ``right`` (k, m). Raises
    ``LinAlgError`` for a singular matrix, which no valid configuration gives."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    scaled = matrix * scale[:, None] * scale[None, :] + 1e-9 * np.eye(len(matrix))
    return np.asarray(np.linalg.solve(scaled, (right * scale).T).T * scale)


def _complex(x: Any) -> ComplexArray:
    return np.asarray(x, dtype=np.complex128)


def _polynomial(coefficients: Array, x: ComplexArray) -> ComplexArray:
    """Return c0 + c1 x + c2 x^2."""
    return coefficients[0] + x * (coefficients[1] + x * coefficients[2])


def _peak(hz: float, q: float, tick_hz: float) -> tuple[Array, Array]:
    b, denominator = design("iirpeak", hz, q, fs=tick_hz)
    return b, denominator


def _high_pass(denominator: Array) -> Array:
    """Return the numerator of the high-pass with this ``denominator``: its gain is 1 at half the tick rate."""
    return np.array([1.0, -2.0, 1.0]) * (denominator[0] - denominator[1] + denominator[2]) / 4.0


def _shelf(hz: float, gain: float, tick_hz: float) -> tuple[Array, Array]:
    """Return numerator and denominator of a filter that is 1 far below ``hz`` and ``gain`` far above it.

    (1 + s q / g + s^2) g / (1 + s q g + s^2) of s = tan(w / 2) scaled by the root of ``gain``: a bilinear transform.
    """
    w = 2.0 * pi * hz / tick_hz
    root, c = sqrt(gain), cos(w)
    slope = sqrt(2.0 * root) * sin(w)
    high, low = root + 1.0 + (root - 1.0) * c, root + 1.0 - (root - 1.0) * c
    across = root - 1.0 + (root + 1.0) * c, root - 1.0 - (root + 1.0) * c
    numerator = root * np.array([high + slope, -2.0 * across[0], high - slope])
    return numerator / (low + slope), np.array([low + slope, 2.0 * across[1], low - slope]) / (low + slope)


@dataclass(frozen=True)
class _Prior:
    """Holds what the whole design and that of the core share: spectra, features ``plain`` (m, n) of the bank, targets
    (3, n) on block means and as they are ``wanted``, and which channels see the motion of the tip."""

    config: TremorConfig
    s: _Spectra
    plain: ComplexArray
    target: ComplexArray
    wanted: list[Array]
    moving: Array

    @property
    def axes(self) -> range:
        """Return the axes that differ: one without a lever, whose design all three have."""
        return range(1 if self.config.lever is None else AXES)


@lru_cache(maxsize=8)
def design_adaptive(config: TremorConfig) -> AdaptiveDesign:
    """Return everything that follows from ``config``: the axes' designs, stacked. A run asks for it several times, so
    it is kept, read-only. Without a lever the axes are one."""
    a = config.adaptive
    moving = motion_in_channels(config)
    bank = bank_of(a, config.tick_hz, len(moving))
    block = max(1, round(a.block_s * config.tick_hz))
    s = spectra(config)
    w = 2.0 * pi * s.hz
    whole, core = (*a.cancel_from_hz, *a.cancel_to_hz), a.core_hz
    outputs = ((0.0, whole), (config.loop_delay_s, whole), (config.loop_delay_s, core))
    taps = np.stack([target_taps(config, block, h, edges) for h, edges in outputs])
    half = len(taps[0]) // 2
    in_blocks = np.exp(-1j * w[None, :] * block / config.tick_hz * (np.arange(len(taps[0])) - half)[:, None])
    target = (taps @ in_blocks) * block_response(s.hz, block, config.tick_hz)
    wanted = [band(s.hz, edges) * np.exp(1j * w * h) for h, edges in outputs]
    plain = bank.response(_complex(np.exp(1j * w / config.tick_hz)))
    prior = _Prior(config, s, plain, target, wanted, moving)
    back = _complex(1.0 / _complex(np.exp(1j * w / config.tick_hz)))
    whole_design = _weighted(prior, _filter_of_errors(config), back)
    # the same delay, rounded as in the versions whose recordings replay bit for bit
    in_core = _complex(np.exp(-2j * pi * s.hz / config.tick_hz))
    core_design = _weighted(prior, _core_filter(config), in_core)
    gate_b, gate_a = _peak(a.gate_hz, a.gate_q, config.tick_hz)
    found = AdaptiveDesign(
        **vars(whole_design),
        bank=bank,
        core=core_design,
        lean=lean_of(config),
        block_ticks=block,
        taps=taps,
        gate=np.array([*gate_b, *gate_a[1:]]) / gate_a[0],
        **_unweighted(prior, bank, _polynomial(gate_b, back) / _polynomial(gate_a, back)),
    )
    for array in (*vars(found).values(), *vars(core_design).values(), *vars(found.lean).values()):
        if isinstance(array, np.ndarray):
            array.flags.writeable = False
    return found


def _filter_of_errors(config: TremorConfig) -> tuple[Array, Array]:
    """Return numerator and denominator of the filter through which errors count: a peak at the tremor, or a shelf."""
    a = config.adaptive
    if a.above > 1.0:
        return _shelf(a.above_hz, a.above, config.tick_hz)
    b, denominator = _peak(a.emphasis_hz, a.emphasis_q, config.tick_hz)
    return denominator + (a.emphasis - 1.0) * b, denominator


def _core_filter(config: TremorConfig) -> tuple[Array, Array]:
    """Return numerator and denominator of the filter of the core: a peak, 1 there, and a share of what is above it."""
    a = config.adaptive
    b, denominator = _peak(a.emphasis_hz, a.core_q, config.tick_hz)
    b = (b + a.core_above * _high_pass(denominator)) / sqrt(1.0 + (a.core_above * a.core_q) ** 2)
    return b, denominator


def _unweighted(prior: _Prior, bank: Bank, through_gate: ComplexArray) -> dict[str, Any]:
    """Return the fields of ``AdaptiveDesign`` that no filter of errors weighs, stacked over the axes."""
    config, s, plain, moving, a = prior.config, prior.s, prior.plain, prior.moving, prior.config.adaptive
    z = _complex(np.exp(1j * (2.0 * pi * s.hz) / config.tick_hz))
    as_seen = np.abs(s.seen) ** 2 * s.tremor
    power = np.array([a.tremor_rms_m**2, a.burst_rms_m**2])
    tremor = [p * _covariance(plain, seen, moving) for p, seen in zip(power, as_seen, strict=True)]
    crosses = [
        p * np.stack([_cross(plain * s.seen, t * e, moving[0]) for e in prior.wanted])
        for p, t in zip(power, s.tremor, strict=True)
    ]
    moved = _covariance(plain, s.rest - s.noise, moving)
    next_motion = np.stack([_cross(plain, (power[0] * as_seen[0] + s.rest - s.noise) * z, row) for row in moving])
    fields: dict[str, list[Array]] = {"gate_power": [], "quiet": [], "start": [], "onward": []}
    for axis in prior.axes:
        noise, noisy = sensor_noise(config, s.hz, axis), noise_in_channels(config, axis)
        quiet = _penalty_above_band(config, bank, axis)
        rest = moved + _covariance(plain, noise, noisy)
        sums = [part + rest + quiet for part in tremor]
        gate = np.sum((s.rest + (noise - s.noise)) * np.abs(through_gate) ** 2) * GRID_STEP_HZ
        onward = next_motion + np.stack([_cross(plain, noise * z, row) for row in noisy])
        fields["gate_power"].append(np.asarray(a.gate_ratio * gate))
        fields["quiet"].append(quiet)
        fields["start"].append(np.stack([solve_scaled(m, r) for m, r in zip(sums, crosses, strict=True)]))
        fields["onward"].append(solve_scaled(sums[0], onward))
    return {name: _over_axes(each) for name, each in fields.items()}


def _over_axes(each: Sequence[Array]) -> Array:
    """Return one value of each axis, stacked; a single one counts for all axes."""
    return np.stack([*each] * (AXES // len(each)))


def _weighted(prior: _Prior, errors: tuple[Array, Array], back: ComplexArray) -> WeightedDesign:
    """Return the prior as it is seen through the filter ``errors`` (numerator, denominator). ``back`` (n,): response of
    a delay of one tick."""
    config, s, target, a = prior.config, prior.s, prior.target, prior.config.adaptive
    numerator, denominator = errors
    weight = _polynomial(numerator, back) / _polynomial(denominator, back)
    phi = prior.plain * weight
    unit = np.array([np.sum(t * np.abs(prior.wanted[0] * weight) ** 2) * GRID_STEP_HZ for t in s.tremor])
    moved = _covariance(phi, s.rest - s.noise, prior.moving)
    noises = [(sensor_noise(config, s.hz, axis), noise_in_channels(config, axis)) for axis in prior.axes]
    lean_cross, lean_power = _lean_noise(config, s, phi, weight, target)
    return WeightedDesign(
        weight=np.array([*numerator, *denominator[1:]]) / denominator[0],
        tremor=np.stack(
            [_covariance(phi, np.abs(s.seen) ** 2 * t, prior.moving) / u for t, u in zip(s.tremor, unit, strict=True)]
        ),
        rest=_over_axes([moved + _covariance(phi, noise, noisy) for noise, noisy in noises]),
        cross=np.stack(
            [
                np.stack([_cross(phi * s.seen, weight * t * e, prior.moving[0]) for e in prior.wanted]) / u
                for t, u in zip(s.tremor, unit, strict=True)
            ]
        ),
        noise_cross=_over_axes(
            [np.stack([_cross(phi, noise * weight * t, noisy[0]) for t in target]) for noise, noisy in noises]
        ),
        lean_cross=lean_cross,
        lean_power=lean_power,
        noise_power=_over_axes(
            [np.asarray(np.sum(n * np.abs(weight * target[0]) ** 2) * GRID_STEP_HZ) for n, _ in noises]
        ),
        weighted_power=np.array([a.tremor_rms_m**2, a.burst_rms_m**2]) * unit,
        least_power=a.least_rms_m**2 * float(unit[0]),
    )


def _lean_noise(
    config: TremorConfig, s: _Spectra, phi: ComplexArray, weight: ComplexArray, target: ComplexArray
) -> tuple[Array, Array]:
    """Return (2, OUTPUTS, one) and (2,): what noise of unit density over w^2 and over w^4 adds to a channel's
    ``noise_cross`` and to ``noise_power``."""
    if config.lever is None:
        return np.zeros((2, OUTPUTS, len(phi))), np.zeros(2)
    w2 = (2.0 * pi * s.hz) ** 2
    low_pass = np.abs(s.seen / w2) ** 2
    fourth = s.hz**4
    lean = fourth / (fourth + config.lever.lean_from_hz**4) / w2
    densities = [low_pass * lean, low_pass * lean**2]
    cross = [[_cross(phi, density * weight * t, np.ones(1)) for t in target] for density in densities]
    return np.array(cross), np.array([np.sum(d * np.abs(weight * target[0]) ** 2) * GRID_STEP_HZ for d in densities])


def _covariance(features: ComplexArray, density: Array, channels: Array) -> Array:
    of_tip = np.real((features * density) @ features.conj().T) * GRID_STEP_HZ
    return np.asarray(np.kron(channels, of_tip), dtype=np.float64)


def _cross(features: ComplexArray, density: ComplexArray | Array, channel: Array) -> Array:
    """Return the cross-covariance (m,) of all channels' features with a signal that ``channel`` (C,) relates to
    them."""
    of_tip = np.real(np.conj(features) @ density) * GRID_STEP_HZ
    return np.asarray(np.kron(channel, of_tip), dtype=np.float64)
