"""What a bench asks of its buses: declared bits by hand, refusals with what to change, rates that the ticks give."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.bus_use import MOST, bus_shares, bus_uses
from drivers.polling import Polling, Polls, polling_of
from drivers.specs import check_devices
from hal.bench import BenchFile, load_bench
from hal.errors import BenchError
from hal.types import I2cRead, I2cWrite
from hal.wire_bits import can_bits, i2c_bits, serial_bits
from tests.conftest import DEFAULT_BENCH

BENCHES = sorted(path for path in DEFAULT_BENCH.parent.glob("*.toml") if not path.stem.startswith("space"))


def changed(tmp_path: Path, *edits: tuple[str, str], bench: Path = DEFAULT_BENCH) -> BenchFile:
    text = bench.read_text()
    for old, new in edits:
        assert old in text
        text = text.replace(old, new, 1)
    path = tmp_path / "bench.toml"
    path.write_text(text)
    return load_bench(path)


def refusal(file: BenchFile) -> str:
    with pytest.raises(BenchError) as caught:
        check_devices(file.description, str(file.path))
    return str(caught.value)


def polling(file: BenchFile) -> Polling:
    return polling_of(file.description, check_devices(file.description, ""))[0]


def mag(rate_hz: float | str) -> tuple[str, str]:
    return "address = 0x48\nrate_hz = 100", f"address = 0x48\nrate_hz = {rate_hz}"


def monitor(rate_hz: float | str) -> tuple[str, str]:
    return 'driver = "amplifier_monitor"', f'driver = "amplifier_monitor"\nrate_hz = {rate_hz}'


def test_bits_by_hand():
    """UM10204: START, nine bits a byte, STOP. 8N1: ten. CAN of eight bytes with all stuff bits: 135 (Davis 2007)."""
    assert i2c_bits([I2cWrite(b"\0\0\0")]) == 1 + 4 * 9 + 1
    assert i2c_bits([I2cWrite(b"\0"), I2cRead(2)]) == (1 + 2 * 9) + (1 + 3 * 9) + 1
    assert serial_bits(37) == 370
    assert [can_bits(n) for n in (0, 1, 8)] == [55, 65, 135]


@pytest.mark.parametrize("path", BENCHES, ids=lambda p: p.stem)
def test_no_bus_of_ours_is_overloaded(path: Path):
    file = load_bench(path)
    options = check_devices(file.description, str(path))
    shares = bus_shares(bus_uses(file.description, options, polling_of(file.description, options)[0]))
    assert all(share < MOST for share in shares.values())
    for name, spec in file.description.device.items():
        if spec.driver == "dac_amplifier":
            others = [n for n, other in file.description.device.items() if other.bus == spec.bus and n != name]
            assert others == [], "the outputs have their bus to themselves"


@pytest.mark.parametrize(
    ("edits", "bench", "words"),
    [
        (
            [("speed_hz = 400_000 # the fastest that the AD", "speed_hz = 132_667 # the fastest that the AD")],
            "micron",
            ["[bus.i2c0] is asked for 120 % of its time", "80 %", "piezo command 1000/s x 149 bit = 112.3 %",
             "set speed_hz to 199000 or more (at most 400000)", "lower [clock] tick_hz"],
        ),
        (
            [("speed_hz = 400_000 # the fastest that the AD", "speed_hz = 250_000 # the fastest that the AD")],
            "micron-read-back",
            ["[bus.i2c0] is asked for 97 %", "leave out read_back of 'piezo'", "set speed_hz to 302750"],
        ),
        (
            [("speed_hz = 400_000 # the fastest that the AD", "speed_hz = 1_000_000 # the fastest that the AD")],
            "micron",
            ["[bus.i2c0.speed_hz] 1000000 Hz is more than 'piezo' allows; set at most 400000"],
        ),
        ([("baud = 115_200", "baud = 38_400")], "micron-e727",
         ["[bus.e7270] is asked for 97 %", "piezo command 100/s x 370 bit = 96.4 %", "set baud to 46563",
          "lower rate_hz of 'piezo'"]),
        ([("bitrate = 500_000", "bitrate = 125_000")], "micron-can",
         ["[bus.can0] is asked for 133 %", "piezo command 1000/s x 135 bit = 108.0 %", "set bitrate to 208313",
          "put 'piezo' on a bus of its own"]),
    ],
)  # fmt: skip
def test_an_overloaded_bus_is_refused_with_what_to_change(
    tmp_path: Path, edits: list[tuple[str, str]], bench: str, words: list[str]
):
    message = refusal(changed(tmp_path, *edits, bench=DEFAULT_BENCH.with_stem(bench)))
    assert message.count("\n") == 0
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (mag(130), ["[device.mag_adc.rate_hz] 130 Hz does not divide the tick of 1000 Hz", "work: 125 Hz"]),
        (mag(90), ["90 Hz does not divide", "work: 62.5 Hz and 100 Hz"]),
        (mag(200), ["200 Hz is faster than its conversions", "work: 125 Hz"]),
        (mag(0.5), ["0.5 Hz does not divide", "work: 1 Hz"]),
        (monitor(350), ["[device.monitor.rate_hz] 350 Hz does not divide", "work: 300 Hz and 375 Hz"]),
        (monitor(860), ["860 Hz does not divide", "work: 500 Hz"]),
        (("address = 0x49", "address = 0x49\nrate_hz = 100"),
         ["[device.monitor_adc.rate_hz] this converter is read by 'monitor'", "under [device.monitor]"]),
    ],
)  # fmt: skip
def test_a_rate_that_the_ticks_do_not_give_is_refused_with_the_nearest(
    tmp_path: Path, edit: tuple[str, str], words: list[str]
):
    message = refusal(changed(tmp_path, edit))
    for word in words:
        assert word in message


def test_the_rate_of_a_serial_amplifier_divides_the_tick(tmp_path: Path):
    file = changed(
        tmp_path, ("rate_hz = 100\nneutral", "rate_hz = 130\nneutral"), bench=DEFAULT_BENCH.with_stem("micron-e727")
    )
    assert "[device.piezo.rate_hz] 130 Hz does not divide the tick of 1000 Hz" in refusal(file)
    assert "the nearest that work: 125 Hz and 200 Hz" in refusal(file)


def test_rates_that_are_not_given_are_the_defaults(tmp_path: Path):
    file = changed(tmp_path, ("address = 0x48\nrate_hz = 100", "address = 0x48"))
    assert polling(file) == Polling(Polls(10, 3), Polls(5, 2), Polls(10), Polls(20))


@settings(max_examples=60, deadline=None)
@given(rate_hz=st.floats(1.0, 286.0), of_monitor=st.booleans())
def test_any_rate_is_obeyed_or_refused_with_rates_that_are_obeyed(
    tmp_path_factory: pytest.TempPathFactory, rate_hz: float, of_monitor: bool
):
    edit, each, folder = (monitor, 1, "monitor") if of_monitor else (mag, 3, "magnetometer")
    tmp_path = tmp_path_factory.mktemp("rates")
    file = changed(tmp_path, edit(rate_hz))
    try:
        found = getattr(polling(file), folder)
    except BenchError as error:
        nearest = [float(text) for text in re.findall(r"([\d.e+-]+) Hz", str(error).rpartition("work:")[2])]
        assert nearest
        for other in nearest:
            again = getattr(polling(changed(tmp_path, edit(other))), folder)
            assert again.per_s(1000) == pytest.approx(each * other, rel=1e-9)
    else:
        assert found.per_s(1000) == pytest.approx(each * rate_hz, rel=1e-9)
        ticks = sorted(found.ticks(0))
        gaps = [b - a for a, b in zip(ticks, [*ticks[1:], ticks[0] + found.divider], strict=True)]
        assert len(ticks) == found.count
        assert min(gaps) >= 2, "a conversion takes up to 1.33 ms"
