"""The world in virtual time: ports on the hal contracts, bus time, order of events, faults, determinism."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hal.bench import load_bench
from hal.clock import VirtualClock
from hal.errors import BenchError, BusError, Closed, Disconnected, ErrorKind, I2cNack
from hal.types import CanFrame, I2cRead, I2cWrite
from sim_devices.lockstep_world import LockstepWorld
from sim_devices.register import provider
from tests.wire.emulators.fake_plant import FakePlant

MS = 1_000_000
BENCH = Path(__file__).parents[3] / "benches" / "micron.toml"
FAKE = "tests.wire.emulators.fake_plant:make_fake"


def describe(**changes: Any) -> dict[str, Any]:
    table = load_bench(BENCH).description.model_dump()
    for path, value in changes.items():
        at = table
        *parents, leaf = path.split("__")
        for key in parents:
            at = at[key]
        at[leaf] = value
    return table


class Bench:
    def __init__(self, plant: str = FAKE, start_ns: int = 0, **changes: Any) -> None:
        self.clock = VirtualClock(start_ns)
        self.world = LockstepWorld(describe(**changes), self.clock, None, None, plant)
        self.daq: Any = self.world.endpoint("daq0")
        self.i2c: Any = self.world.endpoint("i2c0")
        self.slow_i2c: Any = self.world.endpoint("i2c1")
        self.can: Any = self.world.endpoint("can0")
        self.buffer = memoryview(bytearray(65536))

    @property
    def plant(self) -> FakePlant:
        return self.world.world.plant  # type: ignore[return-value]

    def read(self, timeout_s: float) -> bytes:
        return bytes(self.buffer[: self.daq.read_into(self.buffer, timeout_s)])

    def command(self, text: bytes) -> bytes:
        self.daq.write(text + b"\r", 0.1)
        return self.read(0.1)

    def scan(self) -> None:
        for text in (b"srate 60000", b"dec 1", *(b"slist %d %d" % (i, 256 + i) for i in range(8))):
            assert self.command(text) == text + b"\r"
        self.daq.write(b"start 0\r", 0.1)


def test_scan_arrives_one_usb_frame_after_its_instant_and_was_sampled_at_it() -> None:
    bench = Bench()
    bench.clock.burn_ns(300_000)
    bench.scan()
    start_ns = bench.clock.now_ns()
    for k in range(1, 20):
        data = bench.read(1.0)
        assert len(data) == 16
        assert bench.clock.now_ns() == start_ns + k * MS + 125_000
        counts = np.frombuffer(data, "<i2")[0]
        assert counts == round((start_ns + k * MS) * 1e-9 * 32768 / 5.0)


def test_read_times_out_in_virtual_time() -> None:
    bench = Bench()
    assert bench.read(0.25) == b""
    assert bench.clock.now_ns() == 250 * MS
    assert bench.read(0.0) == b""
    assert bench.clock.now_ns() == 250 * MS


def test_host_that_does_not_read_for_129_scans_gets_stop_01() -> None:
    bench = Bench()
    bench.scan()
    bench.clock.burn_ns(200 * MS)
    data = bench.read(0.0)
    assert len(data) == 2055
    assert data.endswith(b"stop 01")


def test_dac_transfer_takes_its_bus_time_and_each_word_acts_when_it_has_arrived() -> None:
    bench = Bench()
    bench.plant.demands.clear()
    before_ns = bench.clock.now_ns()
    words = (b"\x31\x40\x00", b"\x32\x80\x00", b"\x34\xc0\x00")
    bench.i2c.transfer(0x0C, [I2cWrite(w) for w in words])
    # per word START 1 + (address + 3) x 9 bits, STOP 1, 2.5 us each at 400 kHz
    assert bench.clock.now_ns() - before_ns == (3 * 37 + 1) * 2500
    assert bench.plant.demands == [(0, 25.0, before_ns + 37 * 2500), (2, 75.0, before_ns + 3 * 37 * 2500)]


def test_scan_during_a_transfer_sees_the_world_at_its_own_instant() -> None:
    bench = Bench()
    bench.scan()
    bench.read(1.0)
    bench.clock.advance_to(bench.clock.now_ns() // MS * MS + MS - 100_000)
    bench.i2c.transfer(0x0C, [I2cWrite(b"\x31\x40\x00"), I2cWrite(b"\x32\x40\x00"), I2cWrite(b"\x34\x40\x00")])
    times = [t for _, _, t in bench.plant.demands[-3:]]
    assert times == sorted(times)
    assert np.frombuffer(bench.read(0.0), "<i2")[0] == round(2e-3 * 32768 / 5.0)


def test_magnetometer_is_wired_to_the_adc_as_the_bench_says() -> None:
    bench = Bench(device__mag__channels=[2, 0, 1])
    volts: list[float] = []
    for mux in (4, 5, 6):
        config = 0x8000 | mux << 12 | 0x0100 | 7 << 5 | 3  # +-6.144 V, single shot
        bench.slow_i2c.transfer(0x48, [I2cWrite(bytes((1, config >> 8, config & 0xFF)))])
        bench.clock.burn_ns(2 * MS)
        answer = bench.slow_i2c.transfer(0x48, [I2cWrite(b"\0"), I2cRead(2)])
        volts.append(int.from_bytes(answer, "big", signed=True) * 6.144 / 32768)
    assert volts == pytest.approx([2.5, 3.0, 2.0], abs=2e-4)


def test_general_call_resets_the_adc_and_leaves_the_dac() -> None:
    bench = Bench()
    bench.slow_i2c.transfer(0x48, [I2cWrite(b"\x01\x84\x83")])
    bench.i2c.transfer(0x0C, [I2cWrite(b"\x31\x40\x00")])
    bench.slow_i2c.transfer(0x00, [I2cWrite(b"\x06")])
    with pytest.raises(I2cNack):  # the DAC knows no general call
        bench.i2c.transfer(0x00, [I2cWrite(b"\x06")])
    assert bench.slow_i2c.transfer(0x48, [I2cWrite(b"\x01"), I2cRead(2)]) == b"\x85\x83"
    assert bench.i2c.transfer(0x0C, [I2cWrite(b"\x01"), I2cRead(2)]) == b"\x40\x00"


def test_i2c_refusals() -> None:
    bench = Bench()
    with pytest.raises(I2cNack) as nobody:
        bench.i2c.transfer(0x50, [I2cRead(1)])
    assert nobody.value.kind is ErrorKind.NACK_ADDRESS
    bench.world.inject("nack", "piezo")
    with pytest.raises(I2cNack):
        bench.i2c.transfer(0x0C, [I2cWrite(b"\x31\x40\x00")])
    bench.world.inject("ack", "piezo")
    bench.world.inject("nack_data", "piezo")
    with pytest.raises(I2cNack) as data:
        bench.i2c.transfer(0x0C, [I2cWrite(b"\x31\x40\x00")])
    assert data.value.kind is ErrorKind.NACK_DATA
    bench.world.inject("stuck", "i2c0")
    with pytest.raises(BusError):
        bench.i2c.transfer(0x0C, [I2cRead(2)])


def test_strap_pulses_reach_the_magnetometer() -> None:
    bench = Bench()
    for text in (b"endo 3", b"dout 1", b"dout 0", b"dout 2", b"dout 0"):
        bench.command(text)
    assert bench.plant.straps == ["set", "reset"]


def test_stop_button_is_heard_and_telemetry_arrives() -> None:
    bench = Bench()
    first = bench.can.recv(1.0)
    assert (first.can_id, first.data) == (0x080, b"\x00\x00")
    bench.world.inject("press")
    pressed_ns = bench.clock.now_ns()
    frame = bench.can.recv(1.0)
    assert frame.data == b"\x01\x01"
    assert 0 < frame.t_ns - pressed_ns < MS
    assert bench.can.recv(1.0).t_ns - frame.t_ns == 100 * MS
    bench.can.send(CanFrame(0x201, bytes.fromhex("0105030004001000")), 0.1)
    assert bench.can.recv(0.01) is None  # a controller does not hear its own frames
    assert bench.world.world.devices["telemetry"].lost_samples == 3
    stats = bench.can.stats()
    assert (stats.tx, stats.rx) == (1, 3)


def test_silent_can_bus() -> None:
    bench = Bench()
    bench.world.inject("silence", "can0")
    assert bench.can.recv(3.0) is None
    bench.world.inject("speak", "can0")
    assert bench.can.recv(1.0) is not None


def test_unplugged_and_closed_ports() -> None:
    bench = Bench()
    bench.scan()
    bench.read(1.0)
    bench.clock.at(bench.clock.now_ns() + 3 * MS, lambda t_ns: bench.world.inject("unplug", "daq"))
    for _ in range(3):
        bench.read(1.0)
    with pytest.raises(Disconnected):
        bench.read(1.0)
    bench.i2c.close()
    bench.i2c.close()
    with pytest.raises(Closed):
        bench.i2c.transfer(0x0C, [I2cRead(1)])


def test_frozen_daq_times_out() -> None:
    bench = Bench()
    bench.scan()
    bench.read(1.0)
    bench.world.inject("freeze", "daq")
    assert bench.read(0.5) == b""
    bench.world.inject("thaw", "daq")
    assert len(bench.read(0.5)) == 16


@pytest.mark.parametrize(
    ("fault", "target"), [("melt", "daq"), ("nack", "daq"), ("freeze", "nobody"), ("unplug", "mag")]
)
def test_impossible_faults_say_what_is_possible(fault: str, target: str) -> None:
    with pytest.raises(ValueError, match=r"faults are|named|ports are"):
        Bench().world.inject(fault, target)


def test_truth_is_on_the_bench_clock_and_stays_after_stop() -> None:
    bench = Bench(start_ns=7 * 10**9)
    bench.clock.burn_ns(50 * MS)
    bench.world.stop()
    bench.clock.burn_ns(50 * MS)
    bench.world.stop()
    assert bench.world.truth()["t_ns"].tolist() == [7 * 10**9, 7 * 10**9 + 50 * MS]
    assert not bench.world.alive()


def test_wrong_descriptions_name_their_key() -> None:
    for wrong, key in (
        ({"emulation__seed": -1}, "seed"),
        ({"device__piezo__driver": "hydraulic"}, "device.piezo.driver"),
    ):
        with pytest.raises(BenchError, match=re.escape(key)):
            provider(describe(**wrong), clock=VirtualClock(), runtime_dir=Path("x"), hand_file=None, hand_scale=None)


def test_alternative_outputs_move_the_plant() -> None:
    bench = Bench(
        bus__e7270={"kind": "serial", "uri": "sim://e7270", "baud": 115200},
        device__piezo={"driver": "e727", "bus": "e7270"},
    )
    port: Any = bench.world.endpoint("e7270")
    port.write(b"SVA 1 10 2 20 3 30\n", 0.1)
    port.write(b"ERR?\n", 0.1)
    assert port.read_into(bench.buffer, 0.1) == 1
    assert bench.plant.demands[-3:] == [
        (c, v, bench.plant.demands[-1][2]) for c, v in ((0, 10.0), (1, 20.0), (2, 30.0))
    ]
    bench = Bench(device__piezo={"driver": "can_amplifier", "bus": "can0"})
    bench.can.send(CanFrame(0x122, b"\x01\xfe"), 0.1)
    bench.can.send(CanFrame(0x120, bytes.fromhex("0000ffff00800197")), 0.1)
    bench.clock.burn_ns(2 * MS)
    assert [d[:2] for d in bench.plant.demands[-2:]] == [(0, 0.0), (1, 100.0)]  # channel 2 stays at 0x8000


def run_real_plant(seed: int) -> tuple[bytes, dict[str, Any]]:
    bench = Bench(plant="sim_devices.plant_factory:make_plant", emulation__seed=seed)
    bench.scan()
    stream = b""
    for k in range(40):
        stream += bench.read(1.0)
        bench.i2c.transfer(0x0C, [I2cWrite(bytes((0x31, 0x60 + k, 0)))])
    bench.world.stop()
    return stream, bench.world.truth()


def test_same_seed_same_bits_other_seed_other_hand() -> None:
    stream, truth = run_real_plant(3)
    again, truth_again = run_real_plant(3)
    other, _ = run_real_plant(4)
    assert stream == again != other
    assert all(np.array_equal(truth[k], truth_again[k]) for k in truth)
    assert len(truth["t_ns"]) == len(truth["tip_m"]) == len(truth["amplifier_V"])
    assert np.all(np.diff(truth["t_ns"]) == MS)
