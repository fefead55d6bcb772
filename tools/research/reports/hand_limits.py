"""Computes bounds for any instrument of this kind in a hand: the manipulator's stroke, and causal estimation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_py.actuation.config import ActuationConfig
from firmware_py.actuation.stage import Actuation
from firmware_py.frame import CONFIDENCE, DESIRED_TIP, LAYOUT, TREMOR_AHEAD, TREMOR_CORE
from firmware_py.tremor.adaptive_design import band
from firmware_py.tremor.config import AdaptiveConfig
from hal.arrays import Array
from sim_devices.plant.kernel import STEP_NS
from tools.closed_loop.simulate import SimulatedRun
from tools.numbers import vector_rms
from tools.reports.figures import FOUR_BANDS_HZ, TREMOR_BAND_HZ, band_pass
from tools.research.tremor.cases import RATE_HZ
from tools.research.tremor.ideal import bound_residual

SWING_S = 3.0
FINE_HZ = 1e9 / STEP_NS
"""Rate of the plant's steps: the actuators' resonance lies above half of the truth's 1000 Hz."""
ABOVE_HZ = FOUR_BANDS_HZ[3]


@dataclass(frozen=True)
class Swing:
    """The strongest ``seconds`` of a hand in 8 to 12 Hz: their share of the power of all that was scored."""

    start_s: float
    """After the start of the run."""
    seconds: float
    share: float
    rms_um: float
    rest_um: float
    """rms of all the rest; 0 where there is none."""


def strongest(truth: Mapping[str, Array], from_ns: int, to_ns: int) -> Swing:
    """Return the strongest swing of the hand alone (manipulator at rest) between two instants of the run."""
    t_ns = np.asarray(truth["t_ns"])
    moved = np.asarray(truth["tip_rigid_m"]) - np.asarray(truth["intended_m"])
    power = np.sum(band_pass(moved, RATE_HZ, TREMOR_BAND_HZ) ** 2, axis=1)
    rows = np.flatnonzero((t_ns >= from_ns) & (t_ns < to_ns))
    length = min(round(SWING_S * RATE_HZ), len(rows))
    so_far = np.concatenate([[0.0], np.cumsum(power[rows])])
    sums = so_far[length:] - so_far[:-length]
    best = int(np.argmax(sums))
    whole, inside, others = float(so_far[-1]), float(sums[best]), len(rows) - length
    return Swing(
        float(t_ns[rows[best]] - t_ns[0]) * 1e-9,
        length / RATE_HZ,
        inside / whole,
        float(1e6 * np.sqrt(inside / length)),
        float(1e6 * np.sqrt(max(whole - inside, 0.0) / others)) if others else 0.0,
    )


def band_rms_um(x: Array, keep: NDArray[np.bool_], band_hz: tuple[float, float] = TREMOR_BAND_HZ) -> float:
    """``x`` (n, 3) m in ``band_hz`` over the rows ``keep``, as a vector, um."""
    return 1e6 * vector_rms(band_pass(x, RATE_HZ, band_hz)[keep])


def known_tremor(truth: Mapping[str, Array], body: Array, config: ActuationConfig) -> Array:
    """(n, 3) m left if the tremor were known: only the strokes and the way slow motion yields to them.

    ``body`` (3, 3): axes of the body as columns, in the world.
    """
    moved = (np.asarray(truth["tip_rigid_m"]) - np.asarray(truth["intended_m"])) @ body
    moved = moved - moved.mean(axis=0)
    hz = np.asarray(np.fft.rfftfreq(len(moved), 1.0 / RATE_HZ), dtype=np.float64)
    lines = np.fft.rfft(moved, axis=0)
    a = AdaptiveConfig()
    whole, core = (
        np.asarray(np.fft.irfft(lines * band(hz, edges)[:, None], len(moved), axis=0))
        for edges in ((*a.cancel_from_hz, *a.cancel_to_hz), a.core_hz)
    )
    frames = np.zeros((len(moved), LAYOUT.size))
    frames[:, CONFIDENCE : CONFIDENCE + 3] = 1.0
    frames[:, TREMOR_AHEAD : TREMOR_AHEAD + 3] = whole
    frames[:, TREMOR_CORE : TREMOR_CORE + 3] = core
    stage = Actuation(config.model_copy(update={"mounting": tuple(map(tuple, np.eye(3)))}))
    for frame in frames:
        stage.step(frame)
    return moved + frames[:, DESIRED_TIP : DESIRED_TIP + 3]


def known_tremor_um(truth: Mapping[str, Array], keep: NDArray[np.bool_], body: Array, config: ActuationConfig) -> float:
    """um rms left in 8 to 12 Hz if the tremor were known (``known_tremor``), with the strokes clipped.

    Nothing is to be kept still above the band here, so the swing of the core is not kept within the strokes.
    """
    return band_rms_um(known_tremor(truth, body, config.model_copy(update={"overdrive": 0.0})), keep)


@dataclass(frozen=True)
class BandParts:
    """Motion of the tip in a band, um rms, and what carries it.

    ``known_um``: with the tremor known beforehand and these strokes, which a better estimate of the same motion does
    not lower. ``wish_um``: by the estimator, if no stroke ended and the actuators did exactly what it says.
    """

    hand_um: float
    known_um: float
    wish_um: float
    tip_um: float

    def added_um(self, whole_um: float) -> float:
        """Return what is added to the hand's own motion where ``whole_um`` is left: root of the powers' difference."""
        return float(np.sqrt(max(whole_um**2 - self.hand_um**2, 0.0)))


@dataclass(frozen=True)
class FineMotion:
    """Error of the path above 20 Hz in every step of the plant (8 kHz), um rms: of the hand alone, and of the tip."""

    hand_um: float
    tip_um: float

    @property
    def added_um(self) -> float:
        """Return what is added to the hand's own motion: root of the powers' difference."""
        return float(np.sqrt(max(self.tip_um**2 - self.hand_um**2, 0.0)))


def fine_motion(run: SimulatedRun, from_ns: int, to_ns: int) -> FineMotion:
    """Return the motion above 20 Hz of a run that kept ``fine``, between two instants of it."""
    assert run.fine is not None
    t_ns = run.started_ns + STEP_NS * (1.0 + np.arange(len(run.fine)))
    keep = (t_ns >= from_ns) & (t_ns < to_ns)
    path = np.stack([np.interp(t_ns, run.truth["t_ns"], x) for x in np.asarray(run.truth["intended_m"]).T], axis=1)
    found: list[float] = []
    for moved in (run.fine[:, 3:], run.fine[:, :3]):
        error = moved - path
        fast = band_pass(error - error[keep].mean(axis=0), FINE_HZ, (ABOVE_HZ[0], 0.5 * FINE_HZ))[keep]
        found.append(1e6 * vector_rms(fast))
    return FineMotion(*found)


def band_parts(
    truth: Mapping[str, Array], frames: Array, keep: NDArray[np.bool_], body: Array, config: ActuationConfig
) -> dict[tuple[float, float], BandParts]:
    """Return the parts of the tremor band and of the band above it, over the rows ``keep`` of a run's truth.

    ``frames`` (m, Layout.size) of every tick, the last of the truth's rows; ``body`` as for ``known_tremor``.
    """
    moved, tip = ((np.asarray(truth[key]) - np.asarray(truth["intended_m"])) @ body for key in ("tip_rigid_m", "tip_m"))
    wish = np.zeros_like(moved)
    wish[len(moved) - len(frames) :] = -config.gain * frames[:, TREMOR_AHEAD : TREMOR_AHEAD + 3]
    ways = (moved, known_tremor(truth, body, config), moved + wish, tip)
    return {
        hz: BandParts(*(band_rms_um(x - x[keep].mean(axis=0), keep, hz) for x in ways))
        for hz in (TREMOR_BAND_HZ, ABOVE_HZ)
    }


def causal_um(truth: Mapping[str, Array], keep: NDArray[np.bool_]) -> float:
    """um rms left in 8 to 12 Hz by the best causal linear filter, fitted to this very hand; no stroke ends."""
    return band_rms_um(bound_residual(truth, keep), keep)
