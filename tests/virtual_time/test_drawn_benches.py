"""Every drawn bench either runs with each part at the drawn value, or is refused with one message.

The values are read from the state of the parts that run: parameters of the compiled stages, limits of the driver's
guard, the emulated devices behind the wires. ``MICRON_DRAWS`` sets the number of draws.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_py.control.app import MicronPlan
from firmware_py.control.instrument import Micron
from firmware_py.control.plan import load_plan
from firmware_py.run.context import Run
from firmware_py.run.loop import Loop
from hal.bench import OpenBench, load_bench, open_bench
from hal.errors import BenchError
from sim_devices.lockstep_world import LockstepWorld
from tests.conftest import DEFAULT_BENCH, with_keys

DRAWS = int(os.environ.get("MICRON_DRAWS", "10"))
RUN_S = 0.1


@dataclass(frozen=True)
class Draw:
    """One bench file as a stranger might write it. ``None`` leaves a key out."""

    tick_hz: int
    filter_ohm: float | None
    cutoff_rad_s: float | None
    lo_V: float
    hi_V: float
    neutral_V: float
    slew_V_per_s: float
    actuation: dict[str, float]
    gain: float
    ratio: float
    address: int
    output_hz: int
    converter_hz: int
    magnetometer_hz: float
    range_V: float

    def write(self, folder: Path) -> Path:
        """Write the bench file, with calibrations that hold for any tick rate, and return its path."""
        piezo = (DEFAULT_BENCH.parent / "calibration" / "piezo.toml").read_text()
        piezo = re.sub(r"^preview_s.*?^\]\n", "", piezo, flags=re.M | re.S)
        (folder / "piezo.toml").write_text(piezo)
        text = DEFAULT_BENCH.read_text()
        for old, new in (
            ("tick_hz = 1000", f"tick_hz = {self.tick_hz}"),
            ("rate_hz = 1000", f"rate_hz = {self.tick_hz}"),
            ("range_V = 5.0", f"range_V = {self.range_V}"),
            ("rate_hz = 100\n", f"rate_hz = {self.magnetometer_hz}\n"),
            ("ratio = 20.0", f"ratio = {self.ratio}"),
            ("address = 0x0C", f"address = {self.address}"),
            ("gain = 20.0", f"gain = {self.gain}\nlo_V = {self.lo_V}\nhi_V = {self.hi_V}"),
            ("neutral_V = 50.0", f"neutral_V = {self.neutral_V}\nslew_V_per_s = {self.slew_V_per_s}"),
            ('uri = "sim://i2c0"\nspeed_hz = 400_000', f'uri = "sim://i2c0"\nspeed_hz = {self.output_hz}'),
            ('uri = "sim://i2c1"\nspeed_hz = 400_000', f'uri = "sim://i2c1"\nspeed_hz = {self.converter_hz}'),
        ):
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        text = re.sub(r"^calibration = .*\n", 'calibration = ["piezo.toml"]\n', text, flags=re.M)
        if self.filter_ohm is not None:
            text = text.replace("[firmware.sensing]", f"[firmware.sensing]\nfilter_ohm = {self.filter_ohm}")
        if self.cutoff_rad_s is not None:
            text = text.replace("[firmware.tremor]", f"[firmware.tremor]\nfilter_cutoff_rad_s = {self.cutoff_rad_s!r}")
        text += "\n[firmware.self_test]\nwatch_ms = 50.0\n"
        keys = "".join(f"{key} = {value}\n" for key, value in self.actuation.items())
        text = with_keys(text, "firmware.actuation", keys)
        path = folder / "bench.toml"
        path.write_text(text)
        return path


def drawn(seed: int, *, coherent: bool = False) -> Draw:
    """Draw a bench. ``coherent``: no value contradicts another one, and every rate fits its bus."""
    random = np.random.default_rng(seed)

    def one(usual: Any, *rare: Any, share: float = 0.15) -> Any:
        return rare[random.integers(len(rare))] if random.random() < share and not coherent else usual

    def any_of(*values: Any) -> Any:
        return values[random.integers(len(values))]

    lo_V, hi_V = any_of(0.0, 5.0, 10.0), any_of(80.0, 90.0, 100.0)
    neutral_V, slew = any_of(40.0, 50.0, 45.5, 60.0), any_of(5_000.0, 10_000.0, 20_000.0)
    ohm = any_of(None, 24_000.0, 32_000.0, 40_000.0)
    actuation: dict[str, float] = {}
    if random.random() < 0.3:
        actuation["neutral_V"] = one(neutral_V, 50.0, 55.0, share=0.5)
    if random.random() < 0.3:
        actuation["slew_V_per_s"] = one(slew, 4_000.0, 30_000.0, share=0.5)
    if random.random() < 0.3:
        actuation["high_V"] = one(hi_V, 75.0, 120.0, share=0.5)
    cutoff = 1.0 / ((ohm or 32_000.0) * 0.33e-6)
    tick_hz = any_of(250, 500, 1000) if coherent else any_of(250, 500, 1000, 1000, 2000)
    return Draw(
        tick_hz=tick_hz,
        filter_ohm=ohm,
        cutoff_rad_s=one(None, cutoff, 100.0, share=0.4),
        lo_V=lo_V,
        hi_V=hi_V,
        neutral_V=one(neutral_V, 3.0, 110.0, share=0.1),
        slew_V_per_s=slew,
        actuation=actuation,
        gain=any_of(20.0, 20.0, 22.0, 25.0),
        ratio=any_of(20.0, 20.0, 25.0, 40.0),
        address=one(any_of(0x0C, 0x0D, 0x0E, 0x0F), 0x10, 0x48, share=0.1),
        output_hz=one(400_000, 100_000, 300_000, 1_000_000, share=0.3),
        converter_hz=one(400_000, 100_000, 200_000, 1_000_000, share=0.3),
        magnetometer_hz=62.5 if tick_hz == 250 else one(100, 50, 125, share=0.5),
        range_V=one(5.0, 10.0, 3.0),
    )


def check_parts(draw: Draw, bench: OpenBench, micron: Micron) -> None:
    """Compare the state of each part that runs with the draw."""
    tick_hz, tick_s = draw.tick_hz, 1.0 / draw.tick_hz
    stages, devices = micron.stages, micron.devices
    lag_s = (draw.filter_ohm or 32_000.0) * 0.33e-6
    sense, estimate, act = (stage.params[0] for stage in (stages.sensing, stages.tremor, stages.actuation))
    assert sense["attitude"]["dt_s"] == pytest.approx(tick_s)
    assert sense["calibration"]["supply_smoothing"] == pytest.approx(1.0 - np.exp(-tick_s / lag_s))
    assert sense["calibration"]["lsb_V"] == pytest.approx(draw.range_V / 32768)
    assert estimate["combiner"]["sensor"]["tick_hz"] == tick_hz
    assert estimate["combiner"]["sensor"]["lag_s"] == pytest.approx(lag_s)
    assert act["tick_hz"] == tick_hz
    wanted_slew = draw.actuation.get("slew_V_per_s", draw.slew_V_per_s)
    assert act["slew_step_V"] == pytest.approx(wanted_slew * tick_s)
    assert (act["low_V"], act["neutral_V"]) == (draw.lo_V, draw.neutral_V)
    assert act["high_V"] == draw.actuation.get("high_V", draw.hi_V) <= draw.hi_V

    limit = devices.amplifier.limits[0]
    assert (limit.lo_V, limit.safe_V, limit.slew_V_per_s) == (draw.lo_V, draw.neutral_V, draw.slew_V_per_s)
    assert limit.hi_V == pytest.approx(draw.hi_V, abs=0.01)
    assert devices.scan.rate_hz == tick_hz

    world = bench.world
    assert isinstance(world, LockstepWorld)
    output, converters = (world.world.buses.i2c[name] for name in ("i2c0", "i2c1"))
    assert set(output.faces) == {draw.address}
    ten_bytes = output.duration_ns([]), converters.duration_ns([])
    assert ten_bytes == (int(1e9 / draw.output_hz), int(1e9 / draw.converter_hz))
    # the physical outputs, which no part of the firmware sees: neutral is where the bench file says
    assert micron.run.armed_ns is not None
    assert micron.run.counts.lost == 0
    lsb_V = 5.0 * draw.gain / 65536
    assert np.asarray(world.world.plant.stack_V) == pytest.approx([draw.neutral_V] * 3, abs=lsb_V)
    assert devices.monitor is not None
    read_V = devices.monitor.volts
    assert read_V[np.isfinite(read_V)] == pytest.approx(draw.neutral_V, abs=0.6)


def run_as_drawn(draw: Draw, path: Path) -> None:
    """Run the bench as ``firmware_py.app`` does and compare every part. Raises ``BenchError`` for a refusal, which is
    exit status 2."""
    bench = load_bench(path)
    plan = load_plan(bench)
    with open_bench(bench, pace="virtual", runtime_dir=path.parent) as opened:
        parts = MicronPlan(plan).open(opened)
        run = Run(opened.clock, 1_000_000_000 // plan.tick_hz, parts.output, plan.firmware.safety)
        micron = parts.assemble(run)
        micron.stages.warm_up()
        Loop(run, micron).run(RUN_S)
        check_parts(draw, opened, micron)


@pytest.mark.parametrize("seed", range(DRAWS))
def test_a_drawn_bench_runs_as_drawn_or_is_refused(tmp_path: Path, seed: int) -> None:
    draw = drawn(seed)
    path = draw.write(tmp_path)
    try:
        run_as_drawn(draw, path)
    except BenchError as error:
        refusal = str(error)
    else:
        refusal = ""
    assert not refusal or all(line.startswith(f"{path}: ") for line in refusal.splitlines()), refusal


@pytest.mark.parametrize("seed", range(max(2, DRAWS // 4)))
def test_a_coherent_bench_is_never_refused(tmp_path: Path, seed: int) -> None:
    draw = drawn(seed, coherent=True)
    run_as_drawn(draw, draw.write(tmp_path))
