"""Driver and emulator against the data sheet's bytes, each alone; then the emulated room over the bus to degrees."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from drivers.registry import Site, find_driver
from hal.bench import DeviceSpec
from hal.errors import WrongDevice
from hal.types import I2cRead
from sim_devices.registry import Surroundings, find_device
from tools.diagnose.opened import opened_bench
from tools.diagnose.read import read_sensors


def driver(words: dict[str, str]):
    def transfer(address, ops):
        assert (address, ops[1:]) == (0x49, [I2cRead(2)])
        return bytes.fromhex(words[ops[0].data.hex()])

    bench = SimpleNamespace(i2c=lambda bus: SimpleNamespace(transfer=transfer), clock=None)
    return find_driver("tmp117").open(Site("t", DeviceSpec(driver="tmp117", address=0x49), None, bench, None))


@pytest.mark.parametrize(("word", "degC"), [("8000", -256), ("F380", -25), ("FFFF", -1 / 128), ("0C80", 25)])
def test_the_driver_reads_table_7_1_of_the_data_sheet(word, degC):
    chip = driver({"01": "2220", "00": word, "0f": "1117"})
    assert (chip.probe(), chip.read()) == ("TMP117 revision 1 at 0x49", [degC])
    with pytest.raises(WrongDevice, match="0x0075"):
        driver({"0f": "0075"}).probe()


def test_the_emulator_answers_as_the_data_sheet_says():
    cold = SimpleNamespace(temperature_C=-25.0)
    chip = find_device("tmp117").make(Surroundings("t", {}, 1, 0, lambda t_ns: cold, None))
    asked = ((0, 0), (1, 0), (15, 0), (0, 125_499_999), (1, 125_500_000), (1, 125_500_000), (0, 125_500_000))
    words = [(chip.write(bytes((register,)), t_ns), chip.read(2, t_ns).hex())[1] for register, t_ns in asked]
    assert words == ["8000", "0220", "0117", "8000", "2220", "0220", "f380"]


def test_the_room_is_read_over_the_bus():
    with opened_bench(Path(__file__).with_name("bench.toml"), pace="virtual") as bench:
        (value,) = read_sensors(bench)
        true_C = bench.world.truth()["temperature_C"][-1]
    assert value.value == pytest.approx(true_C, abs=1 / 128)
