"""A twin beside the emulated bench: false alarms in 100 hours, and detection delays against the shortest possible.

``python -m tools.research.prove.watch_measure --out docs/results/watch.json`` computes some minutes of the residual of
the six accelerometers (the bench with its noise and the converter's steps, less the noiseless bench, relative to the
supply). The figures of its blocks behind the reference, drawn again in stretches of 10 s, make the hours. What
is slower than those minutes is not in them. Some time without a break is watched by the code that runs beside an
instrument.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from firmware_py.frame import LAYOUT, TIME
from hal.bench import BenchFile, load_bench
from sim_devices.config import emulation_config
from sim_devices.plant.instrument import Instrument
from sim_devices.plant.recorded_hand import make_hand
from tools.emulate.shipped import bench_file
from tools.mismatch.recording import Array
from tools.mismatch.watch.detector import MEMBERS, SIDES
from tools.mismatch.watch.frame import World, open_twin
from tools.mismatch.watch.live import LiveWatch, Settings, Watching
from tools.mismatch.watch.reference import CLIP, TILTS, Reference, learn
from tools.research.results.artefact import write_result
from tools.research.stamp import revision_and_day

DT = 1e-3
SENSORS, SUPPLY = 6, 6
LSB_V = 10.0 / 65536.0
STRETCH = 100
"""Number of blocks that are drawn together."""
RUNS = 100
PIECE = 1000
"""Number of rows of the frame that are given to the watch at once."""
BENCH_TWIN = 'format = 1\n[twin]\nkind = "instrument"\n[twin.parameters]\nbench = "bench.toml"\nhand = "bench"\n'
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


def run_beside(bench: BenchFile, seed: int, options: argparse.Namespace) -> Watching:
    """Watch ``options.hours`` of emulated time without a break by the code of ``micron run --watch``.

    The emulated instrument with its noise gives the rows of the frame; the twin is the same bench without noise.
    """
    config = emulation_config(bench.description.model_dump())
    config = config.model_copy(update={"truth_s": 1.0, "seed": seed})
    instrument = Instrument(config, seed, make_hand(config.hand, seed, None, None), unit=config.unit)
    with tempfile.TemporaryDirectory(prefix="micron-watch-") as folder:
        Path(folder, "bench.toml").write_text(bench.text)
        file = Path(folder, "twin.toml")
        file.write_text(BENCH_TWIN)
        twin = open_twin(file, bench, LAYOUT.scalar_names(), World(seed=seed))
        settings = Settings(file, options.reference, options.per_hour)
        beside = LiveWatch(twin, settings, is_patient=True)
        beside.begin_at(0.0)
        volts = LAYOUT["volts"]
        for first in range(0, round(options.hours * 3600.0 / DT), PIECE):
            rows = np.zeros((PIECE, LAYOUT.size))
            rows[:, TIME] = DT * (first + np.arange(1, PIECE + 1))
            for row in rows:
                instrument.advance_to(round(float(row[TIME]) * 1e9))
                row[volts] = instrument.analog_V
            rows[:, volts] = np.round(rows[:, volts] / LSB_V) * LSB_V
            beside.push(rows)
        return beside.close()


def page(options: argparse.Namespace, lines: Sequence[str], watched: Watching | None) -> str:
    """Return the result's page; ``lines`` are rows of its table."""
    table = list(lines)
    notes = ""
    if watched is not None:
        tested_h = options.hours - options.reference / 3600.0
        table += [
            f"| alarms in {tested_h:.2f} hours of emulated time without a break | 0 | {sum(watched.counts.values())} |",
            f"| processor time of the thread over the time of the run | 5 % | {100 * watched.cpu_share:.1f} % |",
        ]
        notes = f" Without a break: {len(watched.reference_rms)} channels, {watched.gaps} gaps, phase {watched.phase}."
    return f"""# A twin that watches

Made by `python -m tools.research.prove.watch_measure --seed {options.seed} --seconds {options.seconds:g} --reference
{options.reference:g} --per-hour {options.per_hour:g} --hours {options.hours:g} --out docs/results/watch.json`, revision
{revision_and_day()}; do not edit.

| figure | goal | measured |
|---|---|---|
{chr(10).join(table)}

- The twin is the emulated bench without noise, beside the same bench with noise and the converter's steps. Its six
accelerometers are watched, at a stated {options.per_hour:g} false alarms per hour of all channels together.
- The 100 hours are drawn from the blocks of {(options.seconds - options.reference) / 60:.0f} minutes of emulated
residual behind {options.reference:g} s of reference, in stretches of 10 s: what is slower than those minutes is not in
them.{notes}
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the false alarms, the delays and the share of a processor."""
    parser = argparse.ArgumentParser(description="Measure false alarms and delays of a twin beside the emulated bench.")
    parser.add_argument("--seed", type=int, default=103)
    parser.add_argument("--seconds", type=float, default=660.0)
    parser.add_argument("--reference", type=float, default=300.0)
    parser.add_argument("--per-hour", type=float, default=0.01, help="stated rate of false alarms")
    parser.add_argument("--hours", type=float, default=0.5, help="emulated time without a break; 0: none")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the result there (.json or .md)")
    options = parser.parse_args(arguments)
    bench = load_bench(bench_file("micron"))
    x = residual(bench.path, options.seed, options.seconds)
    n = round(options.reference / DT)
    reference = learn({f"volts_{i}": x[:n, i] for i in range(SENSORS)}, DT, options.per_hour)
    figures, block_s = reference.figures(x[n:]), reference.block * DT
    count, _ = alarms(reference, figures, round(3600.0 / block_s), 0.0, options.seed)
    lines = [f"| alarms in {RUNS} runs of an hour | 1 | {count} |"]
    for shift in SHIFTS:
        _, first = alarms(reference, figures, round(600.0 / block_s), shift, options.seed)
        shortest = math.log(reference.run_length) / (shift * shift / 2.0)
        lines.append(
            f"| delay of a level shift of {shift:g} sd of a block ({block_s:g} s), over the shortest that any test can "
            f"have (Lorden 1971) | - | {float(np.nanmean(first)) / shortest:.2f} "
            f"({block_s * float(np.nanmean(first)):.2f} s; {np.count_nonzero(np.isnan(first))} of {RUNS} missed) |"
        )
    watched = run_beside(bench, options.seed, options) if options.hours > 0.0 else None
    text = page(options, lines, watched)
    print(text)
    if options.out is not None:
        write_result(options.out, text)


if __name__ == "__main__":
    main()
