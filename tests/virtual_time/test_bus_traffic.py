"""What drivers declare of their transactions is what the emulated wires carry, bit for bit, for a second exactly.

The spies sit between the firmware and the ports; an I2C line counts its own bits by UM10204 and knows no driver.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import pytest

from drivers.bus_use import BusUse, bus_uses
from drivers.piezo.e727 import COMMAND_BYTES
from drivers.polling import polling_of
from drivers.specs import check_devices
from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from hal.bench import OpenBench, load_bench
from hal.clock import VirtualClock
from hal.types import CanFrame, I2cOp
from hal.wire_bits import can_bits, i2c_bits
from sim_devices.transports.can_hub import frame_ns
from tests.conftest import DEFAULT_BENCH

SETTLED_NS = 100_000_000  # after arming: every task has run
SECOND_NS = 1_000_000_000
MAG_ADC, MONITOR_ADC, DAC = 0x48, 0x49, 0x0C


@dataclass
class Wire:
    """Begin of each transaction (bench ns), who, its bits as declared and as carried (I2C), or its bytes."""

    starts_ns: list[int] = field(default_factory=list[int])
    who: list[int] = field(default_factory=list[int])
    declared: list[int] = field(default_factory=list[int])
    carried: list[int] = field(default_factory=list[int])
    data: list[bytes] = field(default_factory=list[bytes])


class Spy:
    """A port that notes what passes. ``line``: the emulated wire of an I2C bus, which counts its own busy time."""

    def __init__(self, port: Any, clock: VirtualClock, wire: Wire) -> None:
        self._port, self._clock, self._wire = port, clock, wire
        self.line: Any = None
        self.bit_ns = 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._port, name)

    def transfer(self, address: int, ops: Sequence[I2cOp]) -> bytes:
        start_ns, busy_ns = self._clock.now_ns(), self.line.busy_ns if self.line is not None else 0
        answer = self._port.transfer(address, ops)
        carried = 0 if self.line is None else round((self.line.busy_ns - busy_ns) / self.bit_ns)
        self._note(start_ns, address, i2c_bits(ops), carried)
        return answer

    def send(self, frame: CanFrame, timeout_s: float) -> None:
        self._note(self._clock.now_ns(), frame.can_id, can_bits(len(frame.data)), 0, frame.data)
        self._port.send(frame, timeout_s)

    def recv(self, timeout_s: float) -> CanFrame | None:
        frame = self._port.recv(timeout_s)
        if frame is not None:
            self._note(frame.t_ns, frame.can_id, can_bits(len(frame.data)), 0, frame.data)
        return frame

    def write(self, data: bytes, timeout_s: float) -> None:
        self._note(self._clock.now_ns(), 0, 10 * len(data), 0, data)
        self._port.write(data, timeout_s)

    def _note(self, start_ns: int, who: int, declared: int, carried: int, data: bytes = b"") -> None:
        wire = self._wire
        wire.starts_ns.append(start_ns)
        wire.who.append(who)
        wire.declared.append(declared)
        wire.carried.append(carried)
        wire.data.append(data)


@dataclass
class Traffic:
    """One run: what each bus carried, what the bench's drivers declare, and the outcome."""

    wires: dict[str, Wire]
    uses: list[BusUse]
    outcome: dict[str, Any]
    from_ns: int

    def of(self, bus: str, who: int | None = None, seconds: float = 1.0) -> list[int]:
        """Indices of the transactions of a settled part of the run."""
        wire, to_ns = self.wires[bus], self.from_ns + round(seconds * SECOND_NS)
        return [
            i
            for i, t_ns in enumerate(wire.starts_ns)
            if self.from_ns <= t_ns < to_ns and (who is None or wire.who[i] == who)
        ]


def run(bench: Path, seconds: float = 1.3) -> Traffic:
    wires: dict[str, Wire] = {}
    spies: dict[str, Spy] = {}

    def spy(bus: str, port: Any, clock: Any) -> Any:
        wires[bus] = Wire()
        spies[bus] = Spy(port, clock, wires[bus])
        return spies[bus]

    def look_at_lines(opened: OpenBench) -> None:
        world: Any = opened.world
        for name, line in world.world.buses.i2c.items():
            spies[name].line = line
            spies[name].bit_ns = 1e9 / opened.file.description.bus[name].speed_hz  # type: ignore[union-attr]

    outcome, _ = run_in_process(RunRequest(bench, seconds, pace="virtual"), wrap=spy, on_open=look_at_lines)
    assert outcome["safe_state"]["reason"] == "run finished"
    description = load_bench(bench).description
    options = check_devices(description, "")
    uses = bus_uses(description, options, polling_of(description, options)[0])
    return Traffic(wires, uses, outcome, outcome["armed_ns"] + SETTLED_NS)


@pytest.fixture(scope="module", params=["micron", "micron-read-back"])
def traffic(request: pytest.FixtureRequest) -> Traffic:
    return run(DEFAULT_BENCH.with_stem(request.param))


def test_each_transfer_takes_the_bits_that_its_shape_says(traffic: Traffic):
    for bus in ("i2c0", "i2c1"):
        wire = traffic.wires[bus]
        assert len(wire.declared) > 300
        assert wire.declared == wire.carried


def test_a_second_of_each_i2c_bus_carries_what_is_declared(traffic: Traffic):
    for bus in ("i2c0", "i2c1"):
        declared = Counter({int(use.bits): 0 for use in traffic.uses if use.bus == bus})
        for use in traffic.uses:
            if use.bus == bus:
                declared[int(use.bits)] += round(use.per_s)
        carried = Counter(traffic.wires[bus].carried[i] for i in traffic.of(bus))
        assert carried == declared
        share = sum(use.share for use in traffic.uses if use.bus == bus)
        assert sum(bits * n for bits, n in carried.items()) / 400_000 == pytest.approx(share, rel=1e-12)


def test_every_tick_has_its_command_and_every_task_keeps_its_budget(traffic: Traffic):
    outcome = traffic.outcome
    assert (outcome["ticks"]["caught_up"], outcome["ticks"]["skipped"]) == (0, 0)
    assert (outcome["commands"]["superseded"], outcome["samples"]["lost"]) == (0, 0)
    assert sum(task["put_off"] + task["skipped"] + task["slips"] for task in outcome["tasks"].values()) == 0
    over = {name: task["overruns"] for name, task in outcome["tasks"].items() if task["overruns"]}
    # the last step of the ramp reads the neutral position back as well, after the run proper: 233 bits
    assert over == ({"actuate": 1} if outcome["tasks"]["actuate"]["budget_us"] < 233 * 2.5 else {})
    commands = [t for t, bits in zip(traffic.wires["i2c0"].starts_ns, traffic.wires["i2c0"].carried, strict=True)
                if bits in (149, 232) and t >= traffic.from_ns - SETTLED_NS]  # fmt: skip
    ticks = [round((t - commands[0]) / 1e6) for t in commands]
    assert ticks == list(range(len(ticks)))


def test_budgets_are_the_wires_and_a_stated_allowance():
    tasks = run(DEFAULT_BENCH, 0.05).outcome["tasks"]
    budgets = {name.partition("_")[0]: task["budget_us"] for name, task in tasks.items()}
    assert budgets == {
        "sense": 60.0, "estimate": 50.0, "publish": 30.0, "supervise": 300.0, "telemetry": 300.0,
        "actuate": 149 * 2.5 + 100.0, "magnetometer": 85 * 2.5 + 100.0, "monitor": 85 * 2.5 + 100.0,
        "verify": 102 * 2.5 + 100.0,
    }  # fmt: skip


def test_can_frames_are_those_declared():
    """Frames and their bytes exactly; bits at most the declared ones, because those have every stuff bit."""
    traffic = run(DEFAULT_BENCH.with_stem("micron-can"))
    wire = traffic.wires["can0"]
    # STOP_BUTTON: pressed it comes ten times a second, released twice; heartbeat: by a timer, not by a tick
    found = Counter((wire.who[i], len(wire.data[i])) for i in traffic.of("can0"))
    assert found.pop((0x080, 2)) == 2
    assert found == {(288, 8): 1000, (289, 8): 100, (1793, 1): 10, (1792, 1): 50, (512, 8): 50, (513, 8): 50}
    declared = {use.what: (use.per_s, use.bits) for use in traffic.uses if use.bus == "can0"}
    assert declared == {
        "command": (1000, 135), "STATUS": (100, 135), "AMPLIFIER_HEARTBEAT": (10, 65), "HOST_HEARTBEAT": (50, 65),
        "TELEMETRY_TREMOR": (50, 135), "TELEMETRY_STATE": (50, 135), "STOP_BUTTON": (10, 75),
    }  # fmt: skip
    for n in (1, 2, 8):
        assert frame_ns(n, 1_000_000) <= can_bits(n) * 1000


@pytest.mark.parametrize("rate_hz", [50, 100])
def test_commands_of_a_serial_amplifier_come_at_its_rate(tmp_path: Path, rate_hz: int):
    text = DEFAULT_BENCH.with_stem("micron-e727").read_text()
    text = text.replace("rate_hz = 100\nneutral", f"rate_hz = {rate_hz}\nneutral")
    traffic = run(_beside(tmp_path, text))
    wire, here = traffic.wires["e7270"], traffic.of("e7270")
    commands = [wire.data[i] for i in here if wire.data[i].startswith(b"SVA ")]
    errors = [wire.data[i] for i in here if wire.data[i] == b"ERR?\n"]
    assert len(commands) == rate_hz
    assert abs(len(errors) - rate_hz / 20) < 1  # one after every 20 commands
    assert len(commands) + len(errors) == len(here)
    assert max(map(len, commands)) <= COMMAND_BYTES
    assert {use.what: use.per_s for use in traffic.uses if use.bus == "e7270"} == {
        "command": rate_hz,
        "ERR?": rate_hz / 20,
    }


def _beside(folder: Path, text: str) -> Path:
    """A bench file in ``folder`` that names the calibrations of ours."""
    path = folder / "bench.toml"
    path.write_text(text.replace('"calibration/', f'"{DEFAULT_BENCH.parent}/calibration/'))
    return path


RATES = Random(18).sample([1, 2, 4, 5, 8, 10, 12.5, 20, 25, 31.25, 40, 50, 62.5, 100, 125], 2)
LOOKS = Random(81).sample([20, 40, 62.5, 80, 100, 125, 200, 250, 300, 375, 400, 500], 2)


@pytest.mark.parametrize(("rate_hz", "looks_hz"), list(zip(RATES, LOOKS, strict=True)))
def test_drawn_rates_are_those_on_the_wire(tmp_path: Path, rate_hz: float, looks_hz: float):
    text = DEFAULT_BENCH.read_text()
    text = text.replace("address = 0x48\nrate_hz = 100", f"address = 0x48\nrate_hz = {rate_hz}")
    text = text.replace('driver = "amplifier_monitor"', f'driver = "amplifier_monitor"\nrate_hz = {looks_hz}')
    seconds = 2.0  # a whole number of frames of each
    traffic = run(_beside(tmp_path, text), 0.2 + seconds)
    assert len(traffic.of("i2c1", MAG_ADC, seconds)) == 3 * rate_hz * seconds
    assert len(traffic.of("i2c1", MONITOR_ADC, seconds)) == looks_hz * seconds
    assert len(traffic.of("i2c0", DAC, seconds)) == (1000 + 100) * seconds
    assert all(traffic.wires["i2c1"].carried[i] == 85 for i in traffic.of("i2c1", None, seconds))
    assert traffic.outcome["ticks"]["caught_up"] == traffic.outcome["commands"]["superseded"] == 0
