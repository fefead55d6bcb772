"""A corrected twin on the emulated bench: the tip follows the twin, everything else stays as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hal.bench import load_bench
from hal.errors import BenchError
from sim_devices.config import EmulationConfig
from sim_devices.plant.instrument import Instrument
from sim_devices.plant.lab import in_place
from sim_devices.plant.recorded_hand import make_hand
from sim_devices.plant.stack_twin import move_tips
from sim_devices.plant_factory import make_plant, stack_twins
from tools.bench.bench_copy import with_twin

BENCH = Path(__file__).parents[3] / "benches" / "micron.toml"
LINE = """
[twin]
kind = "piezo_stack"
[twin.parameters]
gain_um_per_V = 0.15
offset_um = 0.4
"""


def driven(twin: str | None, folder: Path) -> dict[str, np.ndarray]:
    plant = make_plant({"emulation": {} if twin is None else {"twin": twin}, "folder": str(folder)}, None, None)
    for ms in range(60):
        for channel in range(3):
            plant.set_demand_V(channel, 50.0 + 0.5 * ms * (channel + 1), ms * 1_000_000)
    plant.advance_to(60_000_000)
    return dict(plant.truth())


def test_stroke_is_the_twins_and_the_hand_stays(tmp_path: Path) -> None:
    (tmp_path / "line.toml").write_text(LINE)
    own, other = driven(None, tmp_path), driven("line.toml", tmp_path)
    stroke = other["stroke_m"] - other["stroke_m"][0]
    ms = np.minimum(np.arange(61), 59)
    assert stroke[1:] == pytest.approx(0.15e-6 * 0.5 * ms[1:, None] * np.array([1, 2, 3]), abs=1e-15)
    for name in ("tip_rigid_m", "quaternion", "temperature_C", "amplifier_V"):
        assert np.array_equal(own[name], other[name])
    assert np.abs(own["tip_m"] - other["tip_m"])[30:].max() > 1e-7


def test_tip_of_given_strokes_is_that_of_the_kernel(tmp_path: Path) -> None:
    config = EmulationConfig()
    plant = Instrument(config, 1, make_hand(config.hand, 1, None, None), unit=1)
    for ms in range(40):
        plant.set_demand_V(ms % 3, 50.0 + ms, ms * 1_000_000)
    truth = plant.truth()
    beyond = truth["stroke_m"] - plant._plant[0]["channel"]["reference_m"]
    tips = np.empty((len(beyond), 3))
    move_tips(plant._plant, beyond, truth["quaternion"].copy(), truth["tip_rigid_m"].copy(), tips)
    assert tips == pytest.approx(truth["tip_m"], abs=1e-15)


def test_a_bench_that_cannot_run_it_says_why(tmp_path: Path) -> None:
    (tmp_path / "line.toml").write_text(LINE)
    (tmp_path / "sensor.toml").write_text(LINE.replace("piezo_stack", "accelerometer").replace("um", "V"))
    config = EmulationConfig(twin="line.toml")
    with pytest.raises(BenchError, match=r"'amp' \(e727\) measures"):
        stack_twins(config, {"device": {"amp": {"driver": "e727"}}, "folder": str(tmp_path)})
    with pytest.raises(BenchError, match="nowhere"):
        stack_twins(EmulationConfig(twin="nowhere.toml"), {"folder": str(tmp_path)})
    with pytest.raises(BenchError, match="bias_V"):
        stack_twins(EmulationConfig(twin="sensor.toml"), {"folder": str(tmp_path)})


def test_one_twin_for_each_stack(tmp_path: Path) -> None:
    for i, gain in enumerate((0.1, 0.15, 0.2)):
        (tmp_path / f"{i}.toml").write_text(LINE.replace("0.15", str(gain)))
    config = EmulationConfig(twin=("0.toml", "1.toml", "2.toml"))
    twin = in_place(config, tmp_path / "bench.toml", 2, None)
    assert twin is not None
    assert twin.base["displacement"] == (0.4, 0.2)


def test_a_copy_of_the_bench_names_the_twin_and_still_finds_its_calibration(tmp_path: Path) -> None:
    (tmp_path / "line.toml").write_text(LINE)
    bench = load_bench(BENCH)
    copy = with_twin(bench, tmp_path / "line.toml", tmp_path / "bench.toml")
    again = with_twin(load_bench(copy), tmp_path / "line.toml", tmp_path / "again.toml")
    for path in (copy, again):
        found = load_bench(path)
        assert found.description.emulation == {
            **bench.description.emulation,
            "twin": str(tmp_path / "line.toml"),
        }
        assert all(Path(name).is_file() for name in found.description.firmware["calibration"])
        assert found.description.device == bench.description.device
    (tmp_path / "bad.toml").write_text("[twin]\nkind = 'fmu'\n")
    with pytest.raises(BenchError, match=r"bad\.toml"):
        with_twin(bench, tmp_path / "bad.toml", tmp_path / "other.toml")
    assert not (tmp_path / "other.toml").exists()
