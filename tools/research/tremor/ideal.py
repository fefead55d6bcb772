"""The closed loop with ideal sensors and an ideal manipulator, beside the bound of the very hand that it held.

Ideal: every error that the emulation knows is off, the stacks are lines, and the firmware is told the instrument as it
is, so no calibration is needed. What is left is the loop itself: delay, converter steps, the attitude filter, and the
estimator. With ``noise`` the accelerometers keep theirs, which the bound then has too.

``estimator_um`` is what the estimator leaves by itself, fed with the very samples that the bound is fitted to: what the
loop leaves beyond it, the instrument's sensing, steps and strokes have cost; what it leaves beyond the bound, learning.

The bound: the best fixed causal linear filter, fitted to this record, on the tip's own acceleration through the sensor
filter (and noise), at the loop's delay. It knows no instrument: what it leaves is what any instrument must leave.

The loop with noise and seed 2 leaves 1.302 times the bound over 15 s, in squares 1.69: 1.00 are the bound, which is
fitted to the seconds that it is scored on, 0.37 what the estimator's defaults leave beyond it, 0.17 the preset of the
bench in their place (0.13 of it its priors and what axes take from each other), and 0.15 the instrument.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.tremor.adaptive_design import design_adaptive, solve_scaled
from firmware_py.tremor.config import AdaptiveConfig, TremorConfig
from firmware_py.tremor.estimator import Estimator
from hal.arrays import Array
from hal.bench import load_bench
from tools.closed_loop.simulate import simulate
from tools.numbers import vector_rms
from tools.reports.figures import tremor_figures
from tools.research.tremor.bench_variant import merged, write_variant
from tools.research.tremor.bound import bank_features, lift
from tools.research.tremor.cases import RATE_HZ, involuntary_band, rc_filter, sensor_noise

SETTLE_S = 5.0
GOAL = 1.2
EVERY = 5
LOOP_DELAY_S = 0.0011  # sample to command 0.5 ms, half a tick of hold 0.5 ms, amplifier 0.1 ms
QUIET_M_S2_RTHZ = 1e-5
_PERFECT = {
    "instrument": "position_spread_mm",
    "sensors": "rc_spread bias_spread_V scale_spread misalignment_deg cross_quadratic_V_per_g2 cross_linear_V_per_g "
    "scale_variation_per_g cross_fold_V cross_product_V_per_g2 spring_per_g2 bias_temperature_mg_per_K "
    "scale_temperature_per_K supply_spread supply_wander_mV divider_spread temperature_offset_K magnetometer_noise_uG "
    "magnetometer_offset_V magnetometer_scale_spread magnetometer_misalignment_deg hard_iron_mG soft_iron "
    "piezo_coupling_G_per_A daq_noise_uV daq_offset_uV daq_gain_spread",
    "stack": "stroke_spread slip_sum slip_spread slip_bias curvature creep_per_decade resonance_spread "
    "expansion_um_per_K",
    "manipulator": "lever_spread mount_spread_deg tilt_spread_deg length_spread rest_spread_um",
    "environment": "ambient_wander_K warm_up_K",
}
PERFECT_EMULATION = {table: dict.fromkeys(names.split(), 0.0) for table, names in _PERFECT.items()}
LINE = {"play_thresholds_V": [0.0], "play_weights_um_per_V": [0.15]}  # 15 um at 100 V
POSITIONS_M = ((0.0101, -0.0101, 0.0), (-0.0101, 0.0101, 0.0), (0.0042, 0.0042, 0.116))


@dataclass(frozen=True)
class IdealRow:
    """Lifted: residual between 2 and 20 Hz through the filter that lifts 8 to 12 Hz, um rms as a vector."""

    what: str
    reduction_percent: float  # 8 to 12 Hz
    loop_um: float
    estimator_um: float
    bound_um: float

    @property
    def ratio(self) -> float:
        return self.loop_um / self.bound_um

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "ratio": self.ratio}


def ideal_changes(noise: bool) -> dict[str, Any]:
    """Return the changes that make a bench ideal, for ``write_variant``."""
    emulation: dict[str, Any] = dict(PERFECT_EMULATION)
    # the bound pays nothing for what its filter passes above the band, so neither do filter and strokes beside it
    adaptive: dict[str, Any] = {"quiet": 0.0, "above": 1.0, "core_above": 0.0}
    # the bench's figure holds the noise of its converter; the ideal converter has steps alone
    adaptive["reading_noise_m_s2"] = AdaptiveConfig().reading_noise_m_s2
    if not noise:
        emulation = merged(emulation, {"sensors": {"noise_ug_per_rtHz": 0.0}})
        # the estimator takes the sensors' noise out of what it learns, so it must know that there is none
        adaptive["sensor_noise_m_s2_rtHz"] = QUIET_M_S2_RTHZ
    firmware = {
        "calibration": [],
        "sensing": {"positions_m": POSITIONS_M},
        "actuation": {"stacks": [LINE, LINE, LINE], "overdrive": 0.0},
        "tremor": {"loop_delay_s": LOOP_DELAY_S, "adaptive": adaptive},
    }
    return {"emulation": emulation, "firmware": firmware}


def ideal_run(bench: Path, seconds: float, noise: bool, seed: int | None = None) -> IdealRow:
    """Run the ideal instrument in virtual time, with its bound. Raises ValueError when nothing is left to score."""
    with tempfile.TemporaryDirectory(prefix="micron-ideal-") as folder:
        file = write_variant(bench, ideal_changes(noise), Path(folder), "ideal")
        run = simulate(load_bench(file), seconds, seed=seed)
    truth = run.truth
    from_ns, to_ns = run.armed_ns + round(SETTLE_S * 1e9), run.safe_ns
    figures = tremor_figures(truth, from_ns=from_ns, to_ns=to_ns)
    if figures is None:
        raise ValueError(f"{seconds:g} s is too short: {SETTLE_S:g} s of adaptation are not scored")
    t_ns = np.asarray(truth["t_ns"])
    # zero-phase bands are not trusted at the end
    keep = (t_ns >= from_ns) & (t_ns < to_ns - 500_000_000)
    left = residuals(truth, keep, noise)
    what = "accelerometer noise on" if noise else "no noise"
    return IdealRow(what, figures.vector.reduction_percent, *(1e6 * um for um in left))


def residuals(truth: Mapping[str, Array], keep: NDArray[np.bool_], noise: bool) -> tuple[float, float, float]:
    """Lifted residual (m rms) of the run, of the estimator alone and of the bound over the rows ``keep``."""
    design = design_adaptive(TremorConfig(loop_delay_s=LOOP_DELAY_S))
    samples, wanted = ideal_samples(truth, noise), wanted_motion(truth)
    left = (
        involuntary(np.asarray(truth["tip_m"]) - np.asarray(truth["intended_m"])),
        _alone(samples, wanted, noise),
        _bound(samples, wanted, keep),
    )
    loop, alone, bound = (vector_rms(lift(x, design)[keep]) for x in left)
    return loop, alone, bound


def bound_residual(truth: Mapping[str, Array], keep: NDArray[np.bool_]) -> Array:
    """(n, 3) m: what the best fixed causal linear filter of this very record leaves of the involuntary motion.

    Fitted over the rows ``keep``, lifted, at ``LOOP_DELAY_S``, to the tip's acceleration behind the sensor's filter,
    with the sensors' noise.
    """
    return _bound(ideal_samples(truth, noise=True), wanted_motion(truth), keep)


def wanted_motion(truth: Mapping[str, Array]) -> Array:
    """(n, 3) m: the involuntary motion of the tip with the manipulator at rest."""
    return involuntary(np.asarray(truth["tip_rigid_m"]) - np.asarray(truth["intended_m"]))


def ideal_samples(truth: Mapping[str, Array], noise: bool) -> Array:
    """(n, 3) m/s^2: the tip's own acceleration as an ideal instrument would see it."""
    rigid = np.asarray(truth["tip_rigid_m"])
    samples = np.zeros_like(rigid)
    samples[1:-1] = np.diff(rigid, 2, axis=0) * RATE_HZ**2
    samples = rc_filter(samples)
    return samples + sensor_noise(samples.shape, 99) if noise else samples


def _alone(samples: Array, wanted: Array, noise: bool) -> Array:
    """Return the rest of the estimator as the ideal bench configures it, at the bound's horizon in whole ticks."""
    ticks = ceil(LOOP_DELAY_S * RATE_HZ)
    table = {**ideal_changes(noise)["firmware"]["tremor"], "loop_delay_s": ticks / RATE_HZ}
    ahead = Estimator(TremorConfig.model_validate(table)).run(samples).ahead_m
    left = wanted.copy()
    left[ticks:] -= ahead[:-ticks]
    return left


def _bound(samples: Array, wanted: Array, keep: NDArray[np.bool_]) -> Array:
    design = design_adaptive(TremorConfig(loop_delay_s=LOOP_DELAY_S))
    ticks = ceil(LOOP_DELAY_S * RATE_HZ)
    rows = np.flatnonzero(keep)[::EVERY]
    left = wanted.copy()
    for i in range(3):
        plain = bank_features(samples[:, i], design)
        features = lift(plain, design)[rows - ticks]
        goal = lift(wanted[:, i], design)[rows]
        best = solve_scaled(features.T @ features, (features.T @ goal)[None, :])[0]
        left[ticks:, i] -= (plain @ best)[:-ticks]
    return left


def involuntary(x: Array) -> Array:
    """(n, 3) between the edges of ``INVOLUNTARY_HZ``, without phase."""
    hz = np.asarray(np.fft.rfftfreq(len(x), 1.0 / RATE_HZ), dtype=np.float64)
    band = involuntary_band(hz)
    return np.asarray(np.fft.irfft(np.fft.rfft(x, axis=0) * band[:, None], len(x), axis=0))
