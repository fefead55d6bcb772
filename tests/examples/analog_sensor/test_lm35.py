"""The data sheet's scale; then from the emulated room through the DAQ's bytes to degrees; a bad channel is refused."""

from pathlib import Path

import pytest

from drivers.registry import Site, find_driver
from drivers.specs import check_devices
from hal.bench import DeviceSpec, load_bench
from hal.errors import BenchError
from tools.diagnose.opened import opened_bench
from tools.diagnose.read import read_sensors

HERE = Path(__file__).parent


def test_ten_millivolts_are_a_degree():
    driver = find_driver("lm35")
    site = Site("t", DeviceSpec(driver="lm35"), driver.options(channel=3), None, {3: 0.250}.__getitem__)
    assert driver.open(site).read() == pytest.approx([25.0])


def test_the_room_is_read_through_the_daq():
    with opened_bench(HERE / "bench.toml", pace="virtual") as bench:
        (value,) = read_sensors(bench)
        true_C = bench.world.truth()["temperature_C"][-1]
    assert (value.quantity, value.unit) == ("room.temperature", "degC")
    assert value.value == pytest.approx(true_C, abs=0.5 * 5.0 / 32768 / 0.010)  # half a step of the DAQ


def test_a_channel_that_is_not_scanned_is_refused(tmp_path: Path):
    file = tmp_path / "bench.toml"
    file.write_text((HERE / "bench.toml").read_text().replace("channel = 3", "channel = 4"))
    with pytest.raises(BenchError, match="channel 4 is not scanned by 'daq'"):
        check_devices(load_bench(file).description, str(file))
