"""Implements the band-limited multiple Fourier linear combiner, a comb over the tremor band (Veluvolu, Ang 2011).

Three methods adapt the weights: LMS (BMFLC); LMS that forgets over a memory window while its band follows the tremor
(E-BMFLC); a Kalman filter with weights as random walk (BMFLC-KF). Each frequency's sensor factor is known, so the
weights give displacement now and ahead.
"""

from __future__ import annotations

from cmath import exp as cexp
from math import exp, pi
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from firmware_py.biquads import cascade_step
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.own import OwnEstimator
from firmware_py.tremor.prefilter import SECTIONS, prefilter_gain, prefilter_sections
from firmware_py.tremor.sensor_model import invert_sensor, sensor_params
from hal.arrays import Array
from hal.compiled import kernel
from hal.errors import BenchError
from hal.validation import Positive, StrictTable, validate_table

FOLLOW_TICKS = 50  # the band of E-BMFLC moves this often
MEMORY, NUMBERS = 4096, 256
MOST = 29
"""Largest comb that fits into the memory."""


class BmflcConfig(StrictTable):
    """Band-limited multiple Fourier linear combiner in its three forms (Veluvolu, Ang 2011).

    ``memory_s`` is the window of E-BMFLC, ``memory_gain`` its gain; its band follows the centroid of the weights by
    ``band_gain`` per second.
    ``walk`` is the weights' random walk per sample of the Kalman form, in units of the reading's noise, ``bias_walk``
    that of the bias weight.
    """

    low_hz: Positive = 7.0
    high_hz: Positive = 13.0
    step_hz: Positive = 0.5
    gain: Positive = 0.002
    memory_gain: Positive = 0.01
    bias_gain: Positive = 0.003
    memory_s: Positive = 0.3
    band_gain: Positive = 0.5
    walk: Positive = 0.05
    bias_walk: Annotated[float, Field(ge=0.0)] = 0.05


class Comb(NamedTuple):
    """Numbers of the comb and of the sensor, as the kernels read them (``_comb``)."""

    size: int
    tick_hz: float
    lag_s: float  # of the RC filter
    accelerates: bool
    delay_s: float  # of the loop
    behind_prefilter: bool
    gain: float
    bias_gain: float
    keep: float
    follow: float  # of the centroid, per FOLLOW_TICKS; 0: the band stays
    kalman: bool
    walk2: float
    bias_walk2: float
    sections: Array  # (3, 5)
    omega: Array  # (size,) rad/sample


SCALARS = 13
FROM = SCALARS + 5 * SECTIONS  # of omega in the numbers


class Weights(NamedTuple):
    """An axis' memory as the kernels read it (``_axis``). ``weights``: sine, cosine of each frequency; bias."""

    steady: Array  # (2,): ticks so far, shift of the band in rad/sample
    filter: Array  # (3, 2)
    weights: Array  # (2 size + 1,)
    regressor: Array
    gain: Array
    covariance: Array  # (2 size + 1, 2 size + 1), in units of the reading's noise
    phasor: NDArray[np.complex128]  # (size,)
    turn: NDArray[np.complex128]  # of the phasor, per sample
    undo: NDArray[np.complex128]  # (2 size,) m/sample: now, then ahead


def comb_size(comb: BmflcConfig) -> int:
    """Return the number of frequencies in the comb."""
    return int((comb.high_hz - comb.low_hz) / comb.step_hz + 1.0 + 1e-9)


def bmflc_numbers(config: TremorConfig) -> Array:
    """Return the numbers of ``Comb``, one after the other, for ``config.method``."""
    c = validate_table(BmflcConfig, config.own, "[firmware.tremor.own]")
    size, moves = comb_size(c), config.method == "ebmflc"
    seen: Any = sensor_params(config)[0]
    if not c.low_hz < c.high_hz < 0.5 * config.tick_hz or size > MOST:
        raise BenchError(f"bmflc: low_hz < high_hz < tick_hz / 2 and at most {MOST} frequencies are needed")
    scalars = [
        size, seen["tick_hz"], seen["lag_s"], seen["accelerates"], seen["delay_s"], config.behind_prefilter,
        c.memory_gain if moves else c.gain, c.bias_gain,
        exp(-1.0 / (c.memory_s * config.tick_hz)) if moves else 1.0,
        c.band_gain * FOLLOW_TICKS / config.tick_hz if moves else 0.0,
        config.method == "bmflc_kalman", c.walk**2, c.bias_walk**2,
    ]  # fmt: skip
    sections = prefilter_sections(config.wflc, config.tick_hz).ravel()
    omega = 2.0 * pi * (c.low_hz + c.step_hz * np.arange(size)) / config.tick_hz
    return np.concatenate([scalars, sections, omega], dtype=np.float64)


@kernel
def _comb(n: Array) -> Comb:
    size = int(n[0])
    sections = n[SCALARS:FROM].reshape(SECTIONS, 5)
    return Comb(
        size, n[1], n[2], n[3] != 0.0, n[4], n[5] != 0.0, n[6], n[7], n[8], n[9], n[10] != 0.0, n[11], n[12], sections,
        n[FROM : FROM + size],
    )  # fmt: skip


@kernel
def _axis(memory: Array, size: int) -> Weights:
    """Cut the memory of an axis; at its first tick set it: no amplitude, the configured band, unknown weights."""
    w = 2 * size + 1
    c = 8 + 2 * SECTIONS  # keeps complex numbers at even places
    steady, filter_memory = memory[:2], memory[2 : 2 + 2 * SECTIONS].reshape(SECTIONS, 2)
    phasor = memory[c : c + 2 * size].view(np.complex128)
    turn = memory[c + 2 * size : c + 4 * size].view(np.complex128)
    undone = memory[c + 4 * size : c + 8 * size].view(np.complex128)
    r = c + 8 * size
    weights, regressor, gain = memory[r : r + w], memory[r + w : r + 2 * w], memory[r + 2 * w : r + 3 * w]
    covariance = memory[r + 3 * w : r + 3 * w + w * w].reshape(w, w)
    if steady[0] == 0.0:
        phasor[:] = 1.0
        for i in range(w):
            covariance[i, i] = 100.0
    return Weights(steady, filter_memory, weights, regressor, gain, covariance, phasor, turn, undone)


@kernel
def _tune(axis: Weights, comb: Comb) -> None:
    """Set turns and sensor factors for the present band."""
    size, shift = comb.size, axis.steady[1]
    seen: Any = comb
    middle = 0.5 * (comb.omega[0] + comb.omega[size - 1]) + shift
    for r in range(size):
        omega = comb.omega[r] + shift
        axis.turn[r] = cexp(1j * omega)
        behind = 1.0 + 0.0j
        if comb.behind_prefilter:
            # a short memory smears the tremor over the comb; the band's middle is where it is
            behind = prefilter_gain(comb.sections, middle if comb.follow > 0.0 else omega)
        axis.undo[r] = invert_sensor(omega * comb.tick_hz, 0.0, seen) / behind
        axis.undo[size + r] = invert_sensor(omega * comb.tick_hz, comb.delay_s, seen) / behind


@kernel
def _tick(axis: Weights, comb: Comb) -> None:
    """Advance one tick: the phases run on, and the weights walk."""
    size = comb.size
    if axis.steady[0] == 0.0:
        _tune(axis, comb)
    for r in range(size):
        z = axis.phasor[r] * axis.turn[r]
        axis.phasor[r] = z * (1.5 - 0.5 * (z.real * z.real + z.imag * z.imag))  # back to length 1
    axis.steady[0] += 1.0
    if comb.follow > 0.0 and int(axis.steady[0]) % FOLLOW_TICKS == 0:
        _follow(axis, comb)
    if comb.kalman:
        for j in range(2 * size):
            axis.covariance[j, j] += comb.walk2
        axis.covariance[2 * size, 2 * size] += comb.bias_walk2


@kernel
def _follow(axis: Weights, comb: Comb) -> None:
    """Move the band's middle towards the centroid of the weights' power, within half its width."""
    size, omega = comb.size, comb.omega
    total, moment = 0.0, 0.0
    for r in range(size):
        power = axis.weights[2 * r] ** 2 + axis.weights[2 * r + 1] ** 2
        total += power
        moment += power * omega[r]
    if total <= 0.0:
        return
    middle = 0.5 * (omega[0] + omega[size - 1])
    limit = 0.25 * (omega[size - 1] - omega[0])
    shift = axis.steady[1] + comb.follow * (moment / total - middle)
    axis.steady[1] = max(-limit, min(limit, shift))
    _tune(axis, comb)


@kernel
def _correct(sample: float, axis: Weights, comb: Comb) -> None:
    """Process the sample of the present tick."""
    size, w, x = comb.size, axis.weights, axis.regressor
    if comb.behind_prefilter:
        sample = cascade_step(sample, axis.filter, comb.sections)
    error = sample - w[2 * size]
    for r in range(size):
        x[2 * r], x[2 * r + 1] = axis.phasor[r].imag, axis.phasor[r].real
        error -= w[2 * r] * x[2 * r] + w[2 * r + 1] * x[2 * r + 1]
    x[2 * size] = 1.0
    if comb.kalman:
        _kalman_gain(axis)
        for j in range(2 * size + 1):
            w[j] += axis.gain[j] * error
    else:
        for j in range(2 * size):
            w[j] = comb.keep * w[j] + 2.0 * comb.gain * x[j] * error
        w[2 * size] += 2.0 * comb.bias_gain * error


@kernel
def _kalman_gain(axis: Weights) -> None:
    """Gain for the present regressor and the covariance after it; reading noise is the unit."""
    p, x, gain = axis.covariance, axis.regressor, axis.gain
    n = len(x)
    spread = 1.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += p[i, j] * x[j]
        gain[i] = total
        spread += total * x[i]
    for i in range(n):
        for j in range(i + 1):
            p[i, j] -= gain[i] * gain[j] / spread
            p[j, i] = p[i, j]
    for i in range(n):
        gain[i] /= spread


@kernel
def bmflc_step(memory: Array, numbers: Array, sample: float, have: bool, out: Array) -> None:
    """Compute one tick of one axis; see ``OwnEstimator``."""
    comb = _comb(numbers)
    axis = _axis(memory, comb.size)
    _tick(axis, comb)
    if have:
        _correct(sample, axis, comb)
    for o in range(2):
        total = 0.0
        for r in range(comb.size):
            weight = axis.weights[2 * r + 1] - 1j * axis.weights[2 * r]
            total += (weight * axis.phasor[r] * axis.undo[o * comb.size + r]).real
        out[o] = total


COMB = OwnEstimator(bmflc_numbers, bmflc_step, MEMORY, NUMBERS)
