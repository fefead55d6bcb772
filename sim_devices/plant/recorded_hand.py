"""A real hand's tremor on the instrument: a recording, band-limited, integrated and resampled with its derivatives.

The recording is taken as periodic (its ends are faded into each other) and treated as a Fourier series: the band is
cut there, acceleration becomes displacement by division by -w^2, an angular rate an angle by division by i w, and the
first and second derivatives follow exactly. Nodes of (p, p', p'') every 4 ms and quintics between them carry it to the
plant's rate; with the band below 20 Hz the interpolation error is below 1e-6 of the signal. A run longer than the
recording starts it again.

The sensor is taken to sit at the grip. Displacement (or twice integrated acceleration) moves the instrument as a
whole; recorded angular rate turns it about the grip and so moves the tip as well. Without angular rate the turn is
the synthetic hand's share of the lateral motion. Voluntary motion and drift are the synthetic hand's: a recording's own
slow part is tilt and sensor noise after two integrations.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.compiled import kernel
from sim_devices.config import HandConfig
from sim_devices.plant.hand import NODE_S, SyntheticHand
from sim_devices.plant.hand_file import HandFileError, HandRecording, load_hand
from sim_devices.plant.hand_kernel import between, pose_between

TREMOR_BAND_HZ = (8.0, 12.0)
_NODES_HZ = 250.0
_FADE_S = 0.5


class RecordedHand:
    """Plays a recorded tremor within a synthetic voluntary motion.

    ``scale`` ``None``: the mean over the moving axes of the tip's rms in 8 to 12 Hz becomes that of
    ``config.tremor_pp_um`` (one factor for all axes and frequencies). A number multiplies the motion as recorded.
    """

    def __init__(self, config: HandConfig, seed: int, recording: HandRecording, scale: float | None = None) -> None:
        calm = {"tremor_pp_um": 0.0, "roll_tremor_mrad": 0.0, "unsteadiness_rms_um": 0.0, "jerk_um": 0.0}
        self._voluntary = SyntheticHand(config.model_copy(update=calm), seed)
        self.frame = self._voluntary.frame
        self.recording = recording
        frequency_hz, body = _spectrum(config, recording)
        found_m = _band_rms_m(frequency_hz, body, recording)
        if scale is None:
            if found_m < 1e-12:
                raise HandFileError(f"{recording.name}: nothing moves in 8 to 12 Hz, so it cannot be scaled to that")
            scale = config.tremor_pp_um * 1e-6 / (2.0 * math.sqrt(2.0)) / found_m
        self.scale = float(scale)
        self.tremor_rms_m = found_m * self.scale
        """Tremor in 8 to 12 Hz at the tip, rms, mean over the moving axes."""
        body = body * self.scale
        body[:, :3] = body[:, :3] @ self.frame.T
        self._table, self._span_s = _nodes(frequency_hz, body, recording)
        self._step = 0

    def start(self, pose: Array, parts: Array) -> None:
        self._voluntary.start(pose, parts)
        add_recorded(self._table, self._span_s, 0, pose[None, :], parts[None, :])

    def fill(self, pose: Array, parts: Array) -> None:
        self._voluntary.fill(pose, parts)
        add_recorded(self._table, self._span_s, self._step + 1, pose, parts)
        self._step += pose.shape[0]


def make_hand(
    config: HandConfig, seed: int, file: str | Path | None = None, scale: float | None = None
) -> SyntheticHand | RecordedHand:
    """The hand of a run: recorded when ``file`` names one, else synthetic. Raises HandFileError."""
    if file is not None:
        return RecordedHand(config, seed, load_hand(file), scale)
    if scale is not None:
        config = config.model_copy(
            update={
                "tremor_pp_um": config.tremor_pp_um * scale,
                "roll_tremor_mrad": config.roll_tremor_mrad * scale,
            }
        )
    return SyntheticHand(config, seed)


def _spectrum(config: HandConfig, recording: HandRecording) -> tuple[Array, NDArray[np.complex128]]:
    """Return frequencies (m,) in Hz and Fourier coefficients (m, 6): tip displacement (body axes, m) and body angles
    (rad)."""
    count = round(recording.seconds * recording.rate_hz)
    frequency_hz: Array = np.asarray(np.fft.rfftfreq(count, 1.0 / recording.rate_hz), dtype=np.float64)
    low, high = config.recorded_band_hz
    window = _band(frequency_hz, low, min(high, 0.4 * recording.rate_hz))
    w = 2.0 * math.pi * np.maximum(frequency_hz, frequency_hz[1])
    body = np.zeros((len(frequency_hz), 6), dtype=np.complex128)
    if recording.displacement is not None:
        body[:, :3] = _transform(recording.displacement, recording.rate_hz) * window[:, None]
    elif recording.acceleration is not None:
        body[:, :3] = _transform(recording.acceleration, recording.rate_hz) * (-window / w**2)[:, None]
    arm_m = config.grip_to_tip_mm * 1e-3
    if recording.angular_rate is not None:
        body[:, 3:] = _transform(recording.angular_rate, recording.rate_hz) * (window / (1j * w))[:, None]
        body[:, 0] += arm_m * body[:, 4]
        body[:, 1] -= arm_m * body[:, 3]
    else:
        body[:, 3] = -config.rotation_share / arm_m * body[:, 1]
        body[:, 4] = config.rotation_share / arm_m * body[:, 0]
    return frequency_hz, body


def _transform(signal: Array, rate_hz: float) -> NDArray[np.complex128]:
    """(m, 3) Fourier coefficients of the signal less its mean, faded at both ends."""
    count = len(signal)
    fade = np.ones(count)
    edge = int(_FADE_S * rate_hz)
    ramp = 0.5 - 0.5 * np.cos(math.pi * (np.arange(edge) + 0.5) / edge)
    fade[:edge], fade[-edge:] = ramp, ramp[::-1]
    return np.fft.rfft((signal - signal.mean(axis=0)) * fade[:, None], axis=0)


def _band(frequency_hz: Array, low_hz: float, high_hz: float) -> Array:
    """Return a window that is 1 within the band, with raised-cosine edges a tenth wide on either side."""
    rise = np.clip((frequency_hz / low_hz - 0.9) / 0.2, 0.0, 1.0)
    fall = np.clip((1.1 - frequency_hz / high_hz) / 0.2, 0.0, 1.0)
    return 0.25 * (1.0 - np.cos(math.pi * rise)) * (1.0 - np.cos(math.pi * fall))


def _band_rms_m(frequency_hz: Array, body: NDArray[np.complex128], recording: HandRecording) -> float:
    count = round(recording.seconds * recording.rate_hz)
    inside = (frequency_hz >= TREMOR_BAND_HZ[0]) & (frequency_hz <= TREMOR_BAND_HZ[1])
    power = 2.0 * np.sum(np.abs(body[inside, :3]) ** 2, axis=0) / count**2
    moving = power > 1e-6 * power.max()
    return math.sqrt(float(np.mean(power[moving]))) if moving.any() else 0.0


def _nodes(frequency_hz: Array, body: NDArray[np.complex128], recording: HandRecording) -> tuple[Array, float]:
    """Return nodes (N + 1, 18) over one period, the last equal to the first, and their distance in seconds."""
    count = round(recording.seconds * recording.rate_hz)
    nodes = max(count, math.ceil(recording.seconds * _NODES_HZ))
    iw = 2j * math.pi * frequency_hz[:, None]
    table = np.zeros((nodes + 1, 18))
    for order in range(3):
        table[:-1, 6 * order : 6 * order + 6] = np.fft.irfft(body * iw**order, nodes, axis=0) * (nodes / count)
    table[-1] = table[0]
    return table, recording.seconds / nodes


@kernel
def add_recorded(table, span_s, first, pose, parts):
    """Adds the periodic motion of ``table`` to nodes ``first``, ``first`` + 1, ... (milliseconds) of a hand."""
    quintic = np.empty((6, 6))
    here = np.empty(18)
    for j in range(pose.shape[0]):
        at = (first + j) * NODE_S / span_s
        whole = math.floor(at)
        k = int(whole) % (table.shape[0] - 1)
        between(table[k], table[k + 1], span_s, quintic)
        pose_between(quintic, at - whole, span_s, here)
        for c in range(18):
            pose[j, c] += here[c]
        for c in range(3):
            parts[j, 3 + c] += here[c]
