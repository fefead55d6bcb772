"""A wrong bench file is refused before anything is opened, by file and key."""

from pathlib import Path

import pytest

from drivers.bus_use import bus_uses
from drivers.polling import polling_of
from drivers.specs import check_devices
from hal.bench import OpenBench, load_bench, open_bench
from hal.clock import VirtualClock
from hal.errors import BenchError, BusError, OpenFailed

DEFAULT = Path(__file__).parents[3] / "benches" / "micron.toml"


def edited(tmp_path: Path, old: str, new: str) -> Path:
    text = DEFAULT.read_text()
    assert old in text
    path = tmp_path / "bench.toml"
    path.write_text(text.replace(old, new, 1))
    return path


def problem(path: Path) -> str:
    with pytest.raises(BenchError) as caught:
        check_devices(load_bench(path).description, str(path))
    return str(caught.value)


def test_default_bench_is_valid():
    bench = load_bench(DEFAULT)
    options = check_devices(bench.description, "micron.toml")
    assert options["daq"].rate_hz == 1000
    assert set(bench.description.emulated_buses()) == {"daq0", "i2c0", "i2c1", "can0"}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("format = 1", "format = 2", ["[format]"]),
        ("tick_hz = 1000", "tick_hertz = 1000", ["[clock.tick_hertz]", "unknown key"]),
        ('uri = "sim://daq0"', 'url = "sim://daq0"', ["bus.daq0", "unknown key", "this key is missing"]),
        ('bus = "daq0"', 'bus = "daq7"', ["[device.daq.bus]", "no bus named 'daq7'"]),
        ("address = 0x49", "address = 0x48", ["0x48", "already taken by 'mag_adc'"]),
        ("address = 0x0C", "address = 0x80", ["device.piezo.address"]),
        ("channels = { y = 2, z = 3 }", "channels = { y = 1, z = 3 }", ["[device.acc2]", "taken by 'acc1'"]),
        ("channels = { y = 2, z = 3 }", "channels = { y = 2, z = 9 }", ["device.acc2", "channels.z"]),
        ("range_V = 5.0", "range_V = 3.0", ["device.daq", "3 is not one of"]),
        ("gain = 20.0", "gian = 20.0", ["device.piezo", "gian", "unknown key"]),
        ('driver = "hmc2003"', 'driver = "hmc2004"', ["no driver 'hmc2004'", "hmc2003"]),
        ("rate_hz = 1000", "rate_hz = 900", ["make them equal"]),
        ("rate_hz = 100\n", "rate_hz = 130\n", ["[device.mag_adc.rate_hz]", "does not divide"]),
        ("speed_hz = 400_000", "speed_hz = 100_000", ["[bus.i2c0]", "% of its time", "1000/s x 149 bit"]),
        ('provider = "sim_devices.register:provider"\n', "", ["[emulation.provider] is missing"]),
        ("[clock]", "[clock", ["not valid TOML", "line"]),
        ('daq = "daq"', 'daq = "dak"', ["daq] no device named 'dak'", "devices are"]),
        ('bus = "i2c0"\naddress = 0x0C', "address = 0x0C", ["[device.piezo.address]", "an address needs a bus"]),
    ],
)
def test_refusals_name_file_and_key(tmp_path: Path, old: str, new: str, words: list[str]):
    path = edited(tmp_path, old, new)
    message = problem(path)
    assert str(path) in message
    for word in words:
        assert word in message


def test_missing_file_says_what_to_do(tmp_path: Path):
    with pytest.raises(BenchError, match=r"cannot be read.*name an existing bench file"):
        load_bench(tmp_path / "none.toml")


def test_bus_time_by_hand():
    """AD5696R: four times START, address and three bytes, one STOP = 4 x (1 + 36) + 1 bits, a thousand times a second;
    pointer, repeated START and eight bytes a hundred times. ADS1115: pointer, two bytes, three, 300 and 400 times."""
    description = load_bench(DEFAULT).description
    options = check_devices(description, "")
    uses = bus_uses(description, options, polling_of(description, options)[0])
    i2c = [(use.bus, use.device, use.bits, use.per_s) for use in uses if use.bus.startswith("i2c")]
    assert i2c == [
        ("i2c1", "mag_adc", 85, 300.0),
        ("i2c1", "monitor_adc", 85, 400.0),
        ("i2c0", "piezo", 149, 1000.0),
        ("i2c0", "piezo", 102, 100.0),
    ]


def test_virtual_time_refuses_real_buses(tmp_path: Path):
    path = edited(tmp_path, 'uri = "sim://can0"', 'uri = "socketcan://can0"')
    with (
        pytest.raises(BenchError, match="virtual time needs every bus emulated"),
        open_bench(load_bench(path), pace="virtual", runtime_dir=tmp_path),
    ):
        pass


def test_unknown_provider_is_named(tmp_path: Path):
    path = edited(tmp_path, "sim_devices.register:provider", "sim_devices.nowhere:provider")
    with (
        pytest.raises(BenchError, match=r"emulation.provider.*nowhere"),
        open_bench(load_bench(path), pace="virtual", runtime_dir=tmp_path),
    ):
        pass


class Closes:
    """Something of a bench that is closed once; ``error`` is what that raises."""

    def __init__(self, order: list[str], name: str, error: Exception | None = None) -> None:
        self.order, self.name, self.error = order, name, error

    def close(self) -> None:
        self.order.append(self.name)
        if self.error is not None:
            raise self.error


def test_closing_a_bench_closes_all_of_it_last_first_and_tells_the_first_error(tmp_path: Path):
    order: list[str] = []
    parts = [Closes(order, "world"), Closes(order, "a", BusError("a stuck")), Closes(order, "b", BusError("b stuck"))]
    bench = OpenBench(load_bench(DEFAULT), VirtualClock(), {}, None, tmp_path, [part.close for part in parts])
    with pytest.raises(BusError, match="b stuck"):
        bench.close()
    assert order == ["b", "a", "world"]
    bench.close()
    assert order == ["b", "a", "world"]


def test_all_ports_that_cannot_be_opened_are_told_at_once(tmp_path: Path):
    text = DEFAULT.read_text()
    for emulated, real in (
        ("sim://daq0", "serial:///dev/no-daq"),
        ("sim://i2c0", "linux-i2c://97"),
        ("sim://i2c1", "linux-i2c://98"),
    ):
        text = text.replace(emulated, real)
    path = tmp_path / "bench.toml"
    path.write_text(text.replace("sim://can0", "socketcan://nocan9"))
    with (
        pytest.raises(OpenFailed) as caught,
        open_bench(load_bench(path), pace="realtime", runtime_dir=tmp_path),
    ):
        pass
    for word in ("/dev/no-daq", "97", "nocan9"):
        assert word in str(caught.value)


def test_a_recorded_hand_moves_no_real_instrument(tmp_path: Path):
    text = DEFAULT.read_text()
    for emulated, real in (
        ("sim://daq0", "serial:///dev/no"),
        ("sim://i2c0", "linux-i2c://97"),
        ("sim://i2c1", "linux-i2c://98"),
        ("sim://can0", "socketcan://no"),
    ):
        text = text.replace(emulated, real)
    path = tmp_path / "bench.toml"
    path.write_text(text)
    with (
        pytest.raises(BenchError, match="--hand moves an emulated instrument, but this bench is all real"),
        open_bench(load_bench(path), pace="realtime", runtime_dir=tmp_path, hand_file=Path("hand.csv")),
    ):
        pass
