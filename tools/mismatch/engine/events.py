"""Estimates the uncertainty of values that were read off the data and not fitted: instants of steps, grid steps."""

from __future__ import annotations

import numpy as np

from sim_devices.physics.statistics import long_run_rms
from tools.mismatch.engine.fit import Fit
from tools.mismatch.engine.problem import Problem

YAO = 11.0  # 95 % half width of an instant, in samples, per noise variance over the squared height
PRINTED = 1e-8  # rounding of figures in a text file, relative to a grid's step


def half_widths(problem: Problem, fitted: Fit, k: int) -> dict[str, float]:
    """Return 95 % half widths of the human parameters that effect ``k`` read off the data, by their names.

    That of an instant follows Y.-C. Yao, Annals of Statistics 15 (1987) 1321 (argmax of a Brownian motion with drift),
    with the long-run noise, plus two samples and half the rise; that of a grid's step follows from the deviations of
    readings over its range.
    """
    placed = fitted.model.placed[k]
    settings, o = placed.settings, placed.outputs[0]
    if placed.effect.name == "step_shift":
        dt = problem.recording.dt
        nonlinear, weights = fitted.model.slices(k)
        rise = float(fitted.theta[nonlinear.start])
        noise = long_run_rms(fitted.residual[o][problem.fit_rows])
        heights = np.abs(fitted.theta[weights])
        out: dict[str, float] = {}
        for i, h in enumerate(heights):
            samples = 2.0 + YAO * (noise / max(float(h), 1e-300)) ** 2
            out[f"time{i + 1}_s"] = min(samples * dt, problem.recording.n * dt) + 0.5 * rise
        return out
    if placed.effect.name == "quantization":
        step, origin = settings.get("step", (0.0,))[0], settings.get("origin", (0.0,))[0]
        if step <= 0:
            return {}
        cells = (problem.measured[o] - origin) / step
        off = float(np.max(np.abs(cells - np.round(cells))))
        return {"step": step * max(PRINTED, off / max(float(np.ptp(cells)), 1.0))}
    return {}
