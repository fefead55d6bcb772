"""A twin beside the emulated bench: false alarms in 100 hours, and detection delays against the shortest possible.

``python -m tools.research.prove.watch_measure`` computes some minutes of the residual of the six accelerometers (the
bench with its noise and the converter's steps, less the noiseless bench, relative to the supply). The figures of its
blocks behind the reference, drawn again and again in stretches of 10 s, make the hours. What is slower than those
minutes is not in them.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np

from hal.bench import load_bench
from sim_devices.config import emulation_config
from sim_devices.plant.instrument import Instrument
from sim_devices.plant.recorded_hand import make_hand
from tools.emulate.shipped import bench_file
from tools.mismatch.recording import Array
from tools.mismatch.watch.detector import MEMBERS, SIDES
from tools.mismatch.watch.reference import CLIP, TILTS, Reference, learn

DT = 1e-3
SENSORS, SUPPLY = 6, 6
LSB_V = 10.0 / 65536.0
STRETCH = 100
"""Number of blocks that are drawn together."""
RUNS = 100
SHIFTS = (0.5, 1.0, 2.0)
"""Shifts of the level in standard deviations of a block."""


def residual(bench: Path, seed: int, seconds: float) -> Array:
    """Return the residual (n, 6) in V of the accelerometers, relative to the supply."""
    config = emulation_config(load_bench(bench).description.model_dump()).model_copy(update={"truth_s": 1.0})
    real, twin = (
        Instrument(config, seed, make_hand(config.hand, seed, None, None), unit=config.unit, quiet=quiet)
        for quiet in (False, True)
    )
    measured, modelled = np.empty((round(seconds / DT), 8)), np.empty((round(seconds / DT), 8))
    for k in range(len(measured)):
        for instrument, volts in ((real, measured), (twin, modelled)):
            instrument.advance_to(round((k + 1) * DT * 1e9))
            volts[k] = instrument.analog_V
    measured = np.round(measured / LSB_V) * LSB_V
    ratio = measured[:, SUPPLY] / modelled[:, SUPPLY]
    return np.asarray(measured[:, :SENSORS] - modelled[:, :SENSORS] * ratio[:, None], np.float64)


def alarms(reference: Reference, figures: Array, blocks: int, shift: float, seed: int) -> tuple[int, Array]:
    """Return the number of alarms in ``RUNS`` runs of ``blocks``, and the block (RUNS,) of the first alarm of the first
    channel (NaN: none). ``shift`` is added to its level; with one the runs end when each has an alarm.
    """
    rng = np.random.default_rng(seed)
    bounds = np.stack([c.bounds.reshape(-1) for c in reference.channels])
    steps, limit = np.outer(SIDES, TILTS), math.log(reference.run_length * MEMBERS)
    log_m = np.full((RUNS, len(reference.channels), MEMBERS), -np.inf)
    count, first, at = 0, np.full(RUNS, np.nan), np.zeros(RUNS, np.int64)
    for k in range(blocks):
        if k % STRETCH == 0:
            at = rng.integers(0, len(figures) - STRETCH, RUNS)
        z = figures[at + k % STRETCH].copy()
        z[:, 0, 0] += shift
        log_m = np.logaddexp(0.0, log_m)
        log_m += (np.clip(z, -CLIP, CLIP)[..., None, None] * steps).reshape(log_m.shape) - bounds
        reached = np.logaddexp.reduce(log_m, axis=-1) >= limit
        count += int(np.count_nonzero(reached))
        first = np.where(reached[:, 0] & np.isnan(first), k + 1.0, first)
        log_m[reached] = -np.inf
        if shift and not np.isnan(first).any():
            break
    return count, first


def main() -> None:
    """Print the false alarms and the delays."""
    parser = argparse.ArgumentParser(description="Measure false alarms and delays of a twin beside the emulated bench.")
    parser.add_argument("--seed", type=int, default=103)
    parser.add_argument("--seconds", type=float, default=660.0)
    parser.add_argument("--reference", type=float, default=300.0)
    parser.add_argument("--per-hour", type=float, default=0.01, help="stated rate of false alarms")
    options = parser.parse_args()
    x = residual(bench_file("micron"), options.seed, options.seconds)
    n = round(options.reference / DT)
    reference = learn({f"volts_{i}": x[:n, i] for i in range(SENSORS)}, DT, options.per_hour)
    figures, block_s = reference.figures(x[n:]), reference.block * DT
    count, _ = alarms(reference, figures, round(3600.0 / block_s), 0.0, options.seed)
    print(f"false alarms in {RUNS} runs of an hour: {count}")
    for shift in SHIFTS:
        _, first = alarms(reference, figures, round(600.0 / block_s), shift, options.seed)
        shortest = math.log(reference.run_length) / (shift * shift / 2.0)
        print(
            f"level shift of {shift:g} sd of a block: mean delay {block_s * float(np.nanmean(first)):.2f} s, "
            f"{float(np.nanmean(first)) / shortest:.2f} times the shortest (Lorden 1971); "
            f"{np.count_nonzero(np.isnan(first))} missed"
        )


if __name__ == "__main__":
    main()
