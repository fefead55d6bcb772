"""Heal names what the firmware cannot compensate, and finds none of it on a healthy bench."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from firmware_py.control.plan import load_plan
from hal.bench import load_bench
from tests.unit.mismatch_heal.test_heal import MICRON, concealed, lab_of
from tools.heal.heal import with_remedy
from tools.heal.parts import identify_timing
from tools.heal.without_remedy import find_play, name_output, name_play, name_temperature


def test_a_healthy_bench_has_neither(tmp_path: Path):
    lab = lab_of(MICRON, tmp_path)
    assert name_output(lab) == ()
    assert name_temperature(lab) == ()
    assert name_play(lab) == ()


@pytest.mark.parametrize(("ambient_C", "outputs"), [(26.0, 0), (35.0, 3)])
def test_an_output_that_the_monitor_stops_is_named(tmp_path: Path, ambient_C: float, outputs: int):
    """At 26 degC and 0.2 V a kelvin the output is below the monitor's 0.3 V from what was told, at 35 degC beyond."""
    warm = (
        f"[emulation.amplifier]\ngain_per_K = 0.004\n[emulation.environment]\nambient_C = {ambient_C}\nwarm_up_K = 0.0"
    )
    named = name_output(lab_of(concealed(tmp_path, warm), tmp_path))
    assert len(named) == outputs
    assert all("52.00 V where 50.00 V" in text for text in named)


def test_a_gain_that_follows_temperature_is_named(tmp_path: Path):
    lab = lab_of(concealed(tmp_path, "[emulation.amplifier]\ngain_per_K = 0.002"), tmp_path)
    (named,) = name_temperature(lab)
    assert named.startswith("gain that follows temperature (stack 1 +0.")
    assert name_play(lab) == ()


@pytest.mark.parametrize("play_um", [1.0, 6.0])
def test_a_loose_mount_is_named(tmp_path: Path, play_um: float):
    lab = lab_of(concealed(tmp_path, f"[emulation.manipulator]\nmount_play_um = {play_um}"), tmp_path)
    # the modelled tip has 0.8 um rms of the interferometers' noise; plays are tried in steps of 9 %
    assert find_play(lab) == pytest.approx((play_um, play_um), rel=0.1, abs=0.3)
    (named,) = name_play(lab)
    assert named.startswith("play between manipulator and tip (x ")
    assert name_temperature(lab) == ()


def test_benches_without_play_have_none(tmp_path: Path):
    """Unit 1 with other noise, and with a geometry of its own that the firmware does not know."""
    lab = lab_of(concealed(tmp_path, "[emulation.manipulator]\nmount_spread_deg = 4.0"), tmp_path)
    for seed in range(2610, 2614):
        assert find_play(replace(lab, config=lab.config.model_copy(update={"seed": seed}))) == (0.0, 0.0)


def test_a_delay_of_the_converter_has_a_remedy(tmp_path: Path):
    path = concealed(tmp_path, "[emulation.daq]\ndelay_ms = 3.0\n[emulation.sensors]\nrc_spread = 0.0")
    file = identify_timing(lab_of(path, tmp_path))
    healed = load_plan(with_remedy(load_bench(path), file, tmp_path / "healed.toml")).stages
    assert healed.tremor.loop_delay_s == pytest.approx(0.0047, abs=5e-5)
    assert healed.sensing.filter_ohm * healed.sensing.filter_farad == pytest.approx(32e3 * 0.33e-6, rel=0.01)
