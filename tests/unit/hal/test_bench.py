"""A wrong bench file is refused before anything is opened, by file and key."""

from pathlib import Path

import pytest

from drivers.specs import bus_loads, check_devices
from hal.bench import load_bench, open_bench
from hal.errors import BenchError

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
    assert set(bench.description.emulated_buses()) == {"daq0", "i2c0", "can0"}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("format = 1", "format = 2", ["[format]"]),
        ("tick_hz = 1000", "tick_hertz = 1000", ["[clock.tick_hertz]", "unknown key"]),
        ('uri = "sim://daq0"', 'url = "sim://daq0"', ["bus.daq0", "unknown key", "this key is missing"]),
        ('bus = "daq0"', 'bus = "daq7"', ["[device.daq.bus]", "no bus named 'daq7'"]),
        ("address = 0x0C", "address = 0x48", ["0x48", "already taken by 'mag_adc'"]),
        ("address = 0x0C", "address = 0x80", ["device.piezo.address"]),
        ("channels = { y = 2, z = 3 }", "channels = { y = 1, z = 3 }", ["[device.acc2]", "taken by 'acc1'"]),
        ("channels = { y = 2, z = 3 }", "channels = { y = 2, z = 9 }", ["device.acc2", "channels.z"]),
        ("range_V = 5.0", "range_V = 3.0", ["device.daq", "3 is not one of"]),
        ("gain = 20.0", "gian = 20.0", ["device.piezo", "gian", "unknown key"]),
        ('driver = "hmc2003"', 'driver = "hmc2004"', ["no driver 'hmc2004'", "hmc2003"]),
        ("rate_hz = 1000", "rate_hz = 900", ["make them equal"]),
        ("rate_hz = 100\n", "rate_hz = 130\n", ["[device.mag_adc.rate_hz]", "does not divide"]),
        ("speed_hz = 400_000", "speed_hz = 100_000", ["[bus.i2c0]", "% of its time", "1000 Hz x 156 bit"]),
        ('provider = "sim_devices.register:provider"\n', "", ["[emulation.provider] is missing"]),
        ("[clock]", "[clock", ["not valid TOML", "line"]),
    ],
)
def test_refusals_name_file_and_key(tmp_path: Path, old: str, new: str, words: list[str]):
    path = edited(tmp_path, old, new)
    message = problem(path)
    assert str(path) in message
    for word in words:
        assert word in message


def test_missing_file_says_what_to_do(tmp_path: Path):
    with pytest.raises(BenchError, match=r"cannot be read.*--bench"):
        load_bench(tmp_path / "none.toml")


def test_bus_time_by_hand():
    """AD5696R: four times start, address and three bytes, stop = 16 x 9 + 4 x 3 bits, a thousand times a second."""
    bench = load_bench(DEFAULT)
    loads = {load.device: load.share for load in bus_loads(bench.description, check_devices(bench.description, ""))}
    assert loads["piezo"] == pytest.approx(1000 * 156 / 400_000)


def test_virtual_time_refuses_real_buses(tmp_path: Path):
    path = edited(tmp_path, 'uri = "sim://can0"', 'uri = "socketcan://can0"')
    with (
        pytest.raises(BenchError, match="virtual time needs every bus emulated"),
        open_bench(load_bench(path), virtual=True, runtime_dir=tmp_path),
    ):
        pass


def test_unknown_provider_is_named(tmp_path: Path):
    path = edited(tmp_path, "sim_devices.register:provider", "sim_devices.nowhere:provider")
    with (
        pytest.raises(BenchError, match=r"emulation.provider.*nowhere"),
        open_bench(load_bench(path), virtual=True, runtime_dir=tmp_path),
    ):
        pass
