"""A recorded hand as the instrument would meet it: samples at 1 kHz, and the tremor that they hold.

Recorded motion is a Fourier series in time. Its involuntary part is what lies in ``INVOLUNTARY_HZ`` (soft edges, no
phase); below is the voluntary motion (and the tilt that an accelerometer takes for it). Samples are the whole motion,
slow part and all, through the sensor's RC filter, with the sensor's noise. Hands differ in size by a factor of 1000
and the sensor's noise does not: unless told otherwise a hand is scaled to the instrument's 50 um peak to peak.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter, sosfiltfilt

from firmware_py.tremor.config import TremorConfig
from hal.arrays import Array
from tools.errors import InputError
from tools.reports.figures import band_pass
from tools.research.tremor.signal import TremorSignal
from tools.research.tremor.signals import load_signals
from tools.research.tremor.spectrum import highest_line, periodogram

RATE_HZ = 1000.0
INVOLUNTARY_HZ = (2.0, 4.0, 16.0, 20.0)
TREMOR_RMS_M = 50e-6 / (2.0 * np.sqrt(2.0))
LEVER_M = 0.15  # an angular rate moves a tip this far away
TREMOR_SEARCH_HZ = (3.0, 14.0)
EMULATED = "emulated hands"  # their group
LONGEST_S = 40.0
_FADE_S = 0.5
_SIZE_BAND_HZ = (4.0, 13.0)


@dataclass(frozen=True)
class Case:
    """``samples`` (n, k) in m/s^2 or m as ``sees`` says, ``truth`` (n, k) m: involuntary motion without any sensor.

    ``slow`` (n, k) m: the voluntary path where it is known (synthetic hands), else ``None``.
    """

    name: str
    group: str
    subject: str
    sees: Literal["acceleration", "displacement"]
    samples: Array
    truth: Array
    frequency_hz: float
    slow: Array | None = None
    notes: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        return len(self.samples) / RATE_HZ


def case_of(signal: TremorSignal, seed: int = 0, scale: bool = True, noise: bool = True) -> Case:
    """Make a case of a recorded signal. Raises InputError when it is no motion (pixels) or holds nothing."""
    if signal.quantity not in ("acceleration", "angular rate", "displacement"):
        raise InputError(
            f"{signal.name}: {signal.quantity} in {signal.unit} is no motion of a hand; choose another signal"
        )
    notes: list[str] = []
    if signal.seconds > LONGEST_S:
        signal = signal.part(0.0, LONGEST_S)
        notes.append(f"first {LONGEST_S:g} s")
    config = TremorConfig()
    count = round(signal.seconds * RATE_HZ)
    fade = np.ones(len(signal.values))
    edge = int(_FADE_S * signal.rate_hz)
    fade[:edge] = 0.5 - 0.5 * np.cos(np.pi * (np.arange(edge) + 0.5) / edge)
    fade[-edge:] = fade[:edge][::-1]
    lines = np.fft.rfft((signal.values - signal.values.mean(axis=0)) * fade[:, None], axis=0)
    hz = np.asarray(np.fft.rfftfreq(len(signal.values), 1.0 / signal.rate_hz), dtype=np.float64)
    w = 2.0 * np.pi * np.maximum(hz, hz[1])
    top = 0.45 * signal.rate_hz
    if signal.quantity == "acceleration":
        to_path = -1.0 / w**2
    elif signal.quantity == "angular rate":
        to_path = LEVER_M / (1j * w)
    else:
        to_path = np.ones(len(w), dtype=np.complex128)
    path = lines * (to_path * np.clip((top - hz) / (0.1 * top), 0.0, 1.0))[:, None]
    path[0] = 0.0
    band = involuntary_band(hz)
    lag = 1.0 / (1.0 + 1j * w / config.filter_cutoff_rad_s)

    def in_time(spectrum: NDArray[np.complex128]) -> Array:
        return np.asarray(np.fft.irfft(spectrum, count, axis=0) * (count / len(signal.values)))

    truth = in_time(path * band[:, None])
    samples = in_time(path * (-(w**2) * lag)[:, None])
    size = band_pass(truth, RATE_HZ, _SIZE_BAND_HZ)
    rms = float(np.sqrt(np.mean(np.var(size, axis=0))))
    if rms < 1e-12:
        raise InputError(f"{signal.name}: nothing moves between {_SIZE_BAND_HZ[0]:g} and {_SIZE_BAND_HZ[1]:g} Hz")
    factor = TREMOR_RMS_M / rms if scale else 1.0
    truth, samples = truth * factor, samples * factor
    if noise:
        samples = samples + sensor_noise(samples.shape, seed)
    reference = signal.reference.drive_hz
    frequency = reference if reference is not None else highest_line(periodogram(truth, RATE_HZ), TREMOR_SEARCH_HZ)
    cut = slice(edge * 10, count - edge * 10)
    return Case(
        signal.name,
        signal.data_set,
        signal.subject,
        "acceleration",
        samples[cut],
        truth[cut],
        float(frequency),
        notes=tuple(notes),
    )


def cases_from(source: str, scale: bool = True, noise: bool = True) -> list[Case]:
    """Cases of ``hand:SEED`` (emulated), of a run's recording (.mcap), or of anything that ``load_signals`` reads.

    Signals that are no motion (a cursor in pixels) are left out when others are there. Raises InputError.
    """
    if source.startswith("hand:"):
        seed = source.removeprefix("hand:")
        if not seed.isdigit():
            raise InputError(f"{source}: an emulated hand is hand:SEED, for example hand:3")
        return [emulated_hand(int(seed))]
    if source.endswith(".mcap"):
        return [case_of_run(Path(source))]
    signals = load_signals(source)
    motions = [s for s in signals if s.quantity in ("acceleration", "angular rate", "displacement")]
    return [case_of(s, seed, scale, noise) for seed, s in enumerate(motions or signals)]


def case_of_run(path: Path) -> Case:
    """Make a case of a run's recorded tip acceleration; its own band, RC filter undone, is the truth."""
    from firmware_py.recording.reader import Recording

    if not path.is_file():
        raise InputError(f"{path}: there is no such recording")
    recording = Recording(path)
    samples = np.asarray(recording.array([f"tip_acceleration_{a}" for a in "xyz"]), dtype=np.float64)
    samples = samples[np.all(np.isfinite(samples), axis=1)]
    if len(samples) < 8.0 * RATE_HZ:
        raise InputError(f"{path}: {len(samples) / RATE_HZ:.1f} s; at least 8 s are needed")
    lines = np.fft.rfft(samples - samples.mean(axis=0), axis=0)
    w = 2.0 * np.pi * np.maximum(np.fft.rfftfreq(len(samples), 1.0 / RATE_HZ), 0.1)
    undone = -(1.0 + 1j * w / TremorConfig().filter_cutoff_rad_s) / w**2 * involuntary_band(w / (2.0 * np.pi))
    truth = np.asarray(np.fft.irfft(lines * undone[:, None], len(samples), axis=0))
    frequency = highest_line(periodogram(truth, RATE_HZ), TREMOR_SEARCH_HZ)
    note = "truth is the recording itself, sensor noise included"
    return Case(path.name, "runs", path.stem, "acceleration", samples, truth, float(frequency), notes=(note,))


def involuntary_band(hz: Array) -> Array:
    """1 inside ``INVOLUNTARY_HZ``, soft edges."""
    low, full, fall, none = INVOLUNTARY_HZ
    band = np.clip((hz - low) / (full - low), 0.0, 1.0) * np.clip((none - hz) / (none - fall), 0.0, 1.0)
    return 0.5 - 0.5 * np.cos(np.pi * band)


def sensor_noise(shape: tuple[int, ...], seed: int) -> Array:
    """m/s^2: white noise of the tip's acceleration behind the RC filter, and quantisation after it."""
    a = TremorConfig().adaptive
    rng = np.random.default_rng(seed)
    white = a.sensor_noise_m_s2_rtHz * np.sqrt(0.5 * RATE_HZ) * rng.standard_normal(shape)
    behind = rc_filter(white)
    return behind + a.reading_noise_m_s2 * rng.standard_normal(shape)


def emulated_hand(seed: int, seconds: float = 30.0) -> Case:
    """The emulated instrument's stochastic hand; one seed, one person."""
    from sim_devices.config import HandConfig
    from sim_devices.plant.hand import SyntheticHand

    hand = SyntheticHand(HandConfig(), seed)
    n = round(seconds * RATE_HZ)
    pose, parts = np.zeros((n, 18)), np.zeros((n, 6))
    hand.fill(pose, parts)
    acceleration = rc_filter(pose[:, 12:15]) + sensor_noise((n, 3), seed + 1000)
    return Case(
        f"emulated hand {seed}",
        EMULATED,
        str(seed),
        "acceleration",
        acceleration,
        parts[:, 3:],
        hand.tremor_frequency_hz,
        slow=parts[:, :3],
    )


def rc_filter(x: Array) -> Array:
    """(n, k) through the sensors' RC filter, by the trapezoidal rule: no time of its own beyond the filter's."""
    keep = np.exp(-TremorConfig().filter_cutoff_rad_s / RATE_HZ)
    centred = 0.5 * (1.0 - keep)
    return np.asarray(lfilter([centred, centred], [1.0, -keep], x, axis=0))


def low_pass(x: Array, hz: float) -> Array:
    """Without phase."""
    return np.asarray(sosfiltfilt(butter(4, hz, fs=RATE_HZ, output="sos"), x, axis=0))
