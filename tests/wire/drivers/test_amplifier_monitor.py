"""The amplifier's monitor against an emulated ADC whose inputs the test sets: what must be said, and what not."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.adc.ads1115 import Ads1115
from drivers.amplifier_monitor import AmplifierMonitor
from hal.clock import VirtualClock
from hal.output_guard import OutputGuard
from hal.types import OutputLimit
from sim_devices.devices.ads1115 import Ads1115 as EmulatedAds1115
from sim_devices.transports.i2c_line import I2cLine
from sim_devices.transports.lockstep import LockstepI2cBus

MS = 1_000_000
LIMIT = OutputLimit(0.0, 100.0, 20_000.0, 50.0)


class Rig:
    """Outputs follow the commands at once, plus ``error_V``."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.guard = OutputGuard("piezo", (LIMIT,) * 3, self.clock)
        self.guard.armed = True
        self.error_V = np.zeros(3)
        self.gain = np.ones(3)
        line = I2cLine(400_000)
        line.attach(0x49, EmulatedAds1115(lambda _: np.append(self.outputs_V() / 20.0, 0.0)))
        bus = LockstepI2cBus("i2c0", line, self.clock, lambda: None)
        self.monitor = AmplifierMonitor(Ads1115(bus, self.clock, 0x49), self.guard, self.clock)
        self.time_ms = 0

    def outputs_V(self) -> np.ndarray:
        return 50.0 + self.gain * (np.array(self.guard.last_V) - 50.0) + self.error_V

    def run(self, ticks: int) -> list[tuple[int, str]]:
        """10 Hz tremor commands every tick, a look in every other; what was said and when (ms)."""
        said = []
        for _ in range(ticks):
            t = self.time_ms * 1e-3
            self.guard.admit(50.0 + 20.0 * np.sin(2 * np.pi * 10.0 * t + np.arange(3)))
            self.guard.sent()
            if self.time_ms % 2 and (text := self.monitor.poll()):
                said.append((self.time_ms, text))
            self.time_ms += 1
            self.clock.advance_to(self.time_ms * MS)
        return said


def test_a_healthy_amplifier_is_never_suspected():
    rig = Rig()
    assert rig.run(2000) == []
    assert rig.monitor.suspicions == 0
    assert rig.monitor.readings > 900


@pytest.mark.parametrize("output", [0, 1, 2])
def test_a_dead_output_is_named_within_nine_ms(output: int):
    rig = Rig()
    rig.run(100)
    rig.gain[output], rig.error_V[output] = 0.0, -50.0
    when, text = rig.run(40)[0]
    assert when - 100 <= 9
    assert text.startswith(f"output {output + 1} is at ")
    assert "V and was told" in text


def test_a_small_error_is_believed_at_the_second_look_only():
    rig = Rig()
    rig.run(100)
    rig.error_V[1] = 1.2
    said = rig.run(40)
    assert said
    assert said[0][0] - 100 <= 12
    assert rig.monitor.suspicions >= 2


def test_one_wrong_reading_is_not_believed(monkeypatch: pytest.MonkeyPatch):
    rig = Rig()
    rig.run(100)
    collect, wrong = Ads1115.collect, [0.06]  # 1.2 V at the output, once

    def disturbed(adc: Ads1115) -> float | None:
        value_V = collect(adc)
        return value_V if value_V is None or not wrong else value_V + wrong.pop()

    monkeypatch.setattr(Ads1115, "collect", disturbed)
    assert rig.run(200) == []
    assert rig.monitor.suspicions == 1


def test_a_command_under_way_may_have_arrived_already():
    """A host that was put to sleep between the acknowledge and its own note of it."""
    rig = Rig()
    rig.run(10)
    begun_ns = rig.clock.now_ns()
    rig.guard.admit(np.array([60.0, 50.0, 50.0]))
    rig.clock.burn_ns(3 * MS)
    rig.guard.sent()
    last_V = rig.guard.told[-2].volts[0]
    assert rig.monitor.expected_V(0, begun_ns, begun_ns + 2 * MS) == (min(last_V, 60.0), max(last_V, 60.0))


def test_what_is_within_the_tolerance_is_nothing():
    rig = Rig()
    rig.error_V[:] = 0.45
    assert rig.run(500) == []


def test_a_command_that_nobody_remembers_judges_nothing():
    rig = Rig()
    assert rig.monitor.expected_V(0, 0, 10) is None
    rig.run(100)
    now_ns = rig.clock.now_ns()
    assert rig.monitor.expected_V(0, now_ns - 50 * MS, now_ns) is None
    low, high = rig.monitor.expected_V(0, now_ns - 3 * MS, now_ns) or (0.0, 0.0)
    # sent in no time at 97, 98 and 99 ms; the one before is in force up to 97 ms and not a nanosecond longer
    told = [50.0 + 20.0 * np.sin(2 * np.pi * 10.0 * k * 1e-3) for k in (97, 98, 99)]
    assert (low, high) == pytest.approx((min(told), max(told)))
