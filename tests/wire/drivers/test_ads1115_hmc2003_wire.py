"""ADS1115 registers (TI SBAS444) and the HMC-2003 behind it, byte by byte."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.adc.ads1115 import Ads1115
from drivers.hmc2003 import Hmc2003
from hal.clock import VirtualClock
from hal.errors import BenchError, ErrorKind, HalTimeout, I2cNack, WrongDevice
from tests.wire.drivers.scripted_ports import ScriptedI2c

# OS 1, MUX 100 + channel, PGA 000 (6.144 V), MODE 1, DR 111 (860 SPS), comparator off 11
START = [bytes.fromhex(h) for h in ("01c1e3", "01d1e3", "01e1e3", "01f1e3")]


def make(*script: tuple[int, object], **options: object) -> tuple[Ads1115, ScriptedI2c, VirtualClock]:
    clock = VirtualClock()
    bus = ScriptedI2c(script)
    return Ads1115(bus, clock, **options), bus, clock


def start(channel: int) -> tuple[int, object]:
    return (0x48, [("w", START[channel])])


def exchanged(data: str, channel: int) -> tuple[int, object]:
    """The conversion register is read, then input ``channel`` ordered, without a STOP in between."""
    return (0x48, [("w", b"\x00"), ("r", bytes.fromhex(data)), ("w", START[channel])])


def test_probe_reads_back_what_it_wrote():
    adc, bus, _ = make((0x48, [("w", b"\x01\x41\xe3")]), (0x48, [("w", b"\x01"), ("r", b"\xc1\xe3")]))
    assert adc.probe() == "ADS1115 at 0x48, +-6.144 V"
    bus.done()


def test_probe_refuses_another_part():
    adc, _, _ = make((0x48, [("w", b"\x01\x41\xe3")]), (0x48, [("w", b"\x01"), ("r", b"\x85\x83")]))
    with pytest.raises(WrongDevice, match="0x41E3 reads back as 0x8583"):
        adc.probe()


def test_split_phase_never_touches_the_bus_early():
    adc, bus, clock = make(start(2), exchanged("1388", 3), exchanged("0001", 0))
    assert adc.exchange(3) is None
    adc.start_conversion(2)
    clock.burn_ns(1_279_069)  # 1/860 s plus the 10 % of the data sheet
    assert adc.exchange(3) is None
    clock.burn_ns(50_001)  # and waking up
    assert adc.exchange(3) == pytest.approx(5000 * 187.5e-6)
    assert adc.pending == 3
    clock.burn_ns(1_329_069)
    assert adc.exchange(0) is None
    clock.burn_ns(1)
    assert adc.exchange(0) == pytest.approx(187.5e-6)
    bus.done()


@pytest.mark.parametrize(
    ("data", "volts"), [("7fff", 6.144 * 32767 / 32768), ("8000", -6.144), ("ffff", -187.5e-6), ("0000", 0.0)]
)
def test_twos_complement(data: str, volts: float):
    adc, _, clock = make(start(0), exchanged(data, 0))
    adc.start_conversion(0)
    clock.burn_ns(2_000_000)
    assert adc.exchange(0) == pytest.approx(volts)


def test_other_gain_and_rate():
    # PGA 001 (4.096 V), DR 100 (128 SPS)
    adc, bus, _ = make((0x49, [("w", b"\x01\xc3\x83")]), address=0x49, full_scale_V=4.096, rate_sps=128)
    adc.start_conversion(0)
    bus.done()


def test_nack_leaves_nothing_pending():
    adc, bus, clock = make((0x48, I2cNack("no")), start(1), (0x48, I2cNack("no")), start(1), exchanged("0001", 2))
    with pytest.raises(I2cNack) as caught:
        adc.start_conversion(1)
    assert caught.value.kind is ErrorKind.NACK_ADDRESS
    assert adc.exchange(2) is None
    adc.start_conversion(1)
    clock.burn_ns(2_000_000)
    with pytest.raises(I2cNack):
        adc.exchange(2)
    assert adc.exchange(2) is None
    adc.start_conversion(1)
    clock.burn_ns(2_000_000)
    assert adc.exchange(2) == pytest.approx(187.5e-6)
    bus.done()


@pytest.mark.parametrize("options", [{"full_scale_V": 5.0}, {"rate_sps": 100}, {"address": 0x50}])
def test_impossible_settings(options: dict[str, object]):
    with pytest.raises(BenchError):
        make(**options)


class Strap:
    def __init__(self) -> None:
        self.calls: list[int] = []

    def write_digital(self, bits: int) -> None:
        self.calls.append(bits)


def volts_hex(volts: float) -> str:
    return round(volts / 187.5e-6).to_bytes(2, "big").hex()


def triple(*volts: float) -> list[tuple[int, object]]:
    return [exchanged(volts_hex(v), (i + 1) % 3) for i, v in enumerate(volts)]


def test_round_robin_gives_field_in_tesla():
    adc, bus, clock = make(start(0), *triple(2.5, 2.75, 2.25))
    mag = Hmc2003(adc, Strap(), clock)
    assert np.isnan(mag.field_T).all()
    done = []
    for _ in range(8):
        done.append(mag.poll())
        clock.burn_ns(1_000_000)
    # two ticks of 1 ms per conversion: polls 0 starts, 2, 4 and 6 collect
    assert done == [False] * 6 + [True, False]
    assert mag.field_T == pytest.approx([0.0, 25e-6, -25e-6], abs=1e-8)  # 1 V/gauss
    assert (mag.t_ns, mag.triples) == (6_000_000, 1)
    bus.done()


def test_set_and_reset_give_the_offset():
    field = (0.2, -0.1, 0.4)
    offset = (0.01, -0.02, 0.03)
    after_reset = [2.5 + o - f for o, f in zip(offset, field, strict=True)]
    after_set = [2.5 + o + f for o, f in zip(offset, field, strict=True)]
    adc, bus, clock = make(start(0), *triple(*after_reset), start(0), *triple(*after_set))
    strap = Strap()
    mag = Hmc2003(adc, strap, clock)
    for _ in mag.measure_offset(triples=1):
        clock.burn_ns(1_000_000)
    assert strap.calls == [2, 0, 1, 0]  # reset pulse, then set: ends with the normal sign
    assert mag.offset_V == pytest.approx([2.51, 2.48, 2.53], abs=2e-4)
    bus.done()


def test_offset_measurement_is_bounded():
    class Dead(Ads1115):
        def exchange(self, channel: int) -> float | None:
            return None

    clock = VirtualClock()
    mag = Hmc2003(Dead(ScriptedI2c([start(0)]), clock), Strap(), clock)
    steps = mag.measure_offset(timeout_s=0.1)
    for _ in range(101):
        next(steps)
        clock.burn_ns(1_000_000)
    with pytest.raises(HalTimeout, match="strap pulse"):
        next(steps)
