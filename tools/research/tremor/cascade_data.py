"""Files for the cascade network: real hands' error plus a pseudo-voluntary motion, made as in Ang 2004, 5.3.3.

There: surgeons held still, so all motion was error (16 s, 250 Hz, one dimension); a voluntary motion, white noise
low-passed at 1 Hz of the same rms, was added. Our hands did not hold still, so what counts as error is what lies above
``Making.error_above_hz``: below that a recording cannot tell error from intention. Everything else follows 5.3.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hal.arrays import Array
from tools.research.tremor.cascade_training import Paths
from tools.research.tremor.signal import TremorSignal

RATE_HZ = 250.0
FILE_S = 16.0
TREMOR_BAND_HZ = (4.0, 14.0)


@dataclass(frozen=True)
class Making:
    """``voluntary_order``: of the 1 Hz Butterworth low-pass, which 5.3.3 does not state. ``noise_rms_m``: of the
    position sensor. ``error_rms_m``: a person's files are scaled together to this mean (of table 5.1's four), because
    the recordings come from different tasks."""

    error_above_hz: float = 2.0
    voluntary_hz: float = 1.0
    voluntary_order: int = 4
    error_rms_m: float = 83e-6
    noise_rms_m: float = 1e-6
    files: int = 5


@dataclass(frozen=True)
class Subject:
    """A person's error files, each (4000,) in m at 250 Hz, sensor noise included."""

    name: str
    errors: tuple[Array, ...]


def subjects(signals: list[TremorSignal], making: Making) -> list[Subject]:
    """Return the subjects, one per person with a gyroscope recording: the calmest ``files`` separate stretches of 16 s.

    The one of median size comes first: it is what networks are trained on. The angle along the axis
    that trembles most, scaled to metres.
    """
    found: list[Subject] = []
    for number, s in enumerate(s for s in signals if s.quantity == "angular rate"):
        angle = integrated(s, making.error_above_hz)
        axis = int(np.argmax(_band_rms(s)))
        path = _at_rate(angle[:, axis], s.rate_hz)
        length = round(FILE_S * RATE_HZ)
        pieces = path[: len(path) // length * length].reshape(-1, length)
        calm = np.argsort(np.std(pieces, axis=1), kind="stable")[: making.files]
        middle = len(calm) // 2
        pieces = pieces[[calm[middle], *calm[:middle], *calm[middle + 1 :]]]
        pieces = pieces * (making.error_rms_m / np.mean(np.std(pieces, axis=1)))
        noise = np.random.default_rng((7, number)).standard_normal(pieces.shape) * making.noise_rms_m
        found.append(Subject(s.subject, tuple(pieces + noise)))
    return found


def voluntary(making: Making, seed: int) -> Array:
    """Pseudo-voluntary motion (4000,), m: Gaussian noise low-passed at 1 Hz, rms that of the error."""
    from scipy.signal import butter, sosfilt

    lead = round(8.0 * RATE_HZ)  # the filter's start is over by then
    white = np.random.default_rng(seed).standard_normal(lead + round(FILE_S * RATE_HZ))
    sos = butter(making.voluntary_order, making.voluntary_hz, fs=RATE_HZ, output="sos")
    slow = np.asarray(sosfilt(sos, white))[lead:]
    return slow * (making.error_rms_m / np.sqrt(np.mean(slow**2)))


def learning_paths(errors: list[Array], making: Making, motions: int, seed: int = 1000) -> tuple[Paths, Paths]:
    """Return training and validation paths: the first three quarters of every error file with each of ``motions``
    voluntary motions, and the last quarter with as many others. Testing uses other seeds."""
    fit: list[tuple[Array, Array]] = []
    hold: list[tuple[Array, Array]] = []
    for n in range(motions):
        early, late = voluntary(making, seed + 2 * n), voluntary(making, seed + 2 * n + 1)
        for error in errors:
            cut = 3 * len(error) // 4
            fit.append((error[:cut] + early[:cut], early[:cut]))
            hold.append((error[cut:] + late[cut:], late[cut:]))
    return Paths(tuple(fit)), Paths(tuple(hold))


def integrated(signal: TremorSignal, above_hz: float) -> Array:
    """Angle (or twice integrated acceleration) above ``above_hz``, zero phase, raised-cosine edge 0.7 to 1.3 of it."""
    values = signal.values - signal.values.mean(axis=0)
    frequency_hz = np.fft.rfftfreq(len(values), 1.0 / signal.rate_hz)
    edge = np.clip((frequency_hz / above_hz - 0.7) / 0.6, 0.0, 1.0)
    w = 2j * np.pi * np.maximum(frequency_hz, 1e-6)
    order = {"acceleration": 2, "angular rate": 1, "displacement": 0}[signal.quantity]
    gain = 0.5 * (1.0 - np.cos(np.pi * edge)) / w**order
    return np.asarray(np.fft.irfft(np.fft.rfft(values, axis=0) * gain[:, None], len(values), axis=0))


def _band_rms(signal: TremorSignal) -> Array:
    from scipy.signal import butter, sosfiltfilt

    sos = butter(4, TREMOR_BAND_HZ, "bandpass", fs=signal.rate_hz, output="sos")
    return np.std(np.asarray(sosfiltfilt(sos, signal.values, axis=0)), axis=0)


def _at_rate(path: Array, rate_hz: float) -> Array:
    from scipy.interpolate import CubicSpline

    t_s = np.arange(len(path)) / rate_hz
    return np.asarray(CubicSpline(t_s, path)(np.arange(int(t_s[-1] * RATE_HZ)) / RATE_HZ))
