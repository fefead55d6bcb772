"""The amplifier's monitor against an emulated ADC whose inputs the test sets: what must be said, and what not."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.adc.ads1115 import Ads1115
from drivers.amplifier_monitor import AmplifierMonitor, Usual, Window
from drivers.output_guard import OutputGuard
from drivers.output_guard_steps import admit, note_sent
from hal.clock import VirtualClock
from hal.types import OutputLimit
from sim_devices.devices.ads1115 import Ads1115 as EmulatedAds1115
from sim_devices.transports.i2c_line import I2cLine
from sim_devices.transports.lockstep import LockstepI2cBus

MS = 1_000_000
LIMIT = OutputLimit(0.0, 100.0, 20_000.0, 50.0)


class Stand:
    """Outputs follow the commands at once, plus ``error_V``."""

    def __init__(self, settle_s: float = 0.0003) -> None:
        self.clock = VirtualClock()
        self.guard = OutputGuard("piezo", (LIMIT,) * 3, self.clock)
        self.guard.armed = True
        self.error_V = np.zeros(3)
        self.gain = np.ones(3)
        line = I2cLine(400_000)
        self.adc = EmulatedAds1115(lambda _: np.append(self.outputs_V() / 20.0, 0.0), looks=8)
        line.attach(0x49, self.adc)
        bus = LockstepI2cBus("i2c0", line, self.clock, lambda: None)
        self.monitor = AmplifierMonitor(Ads1115(bus, self.clock, 0x49), self.guard, self.clock, settle_s=settle_s)
        self.time_ms = 0

    def outputs_V(self) -> np.ndarray:
        return 50.0 + self.gain * (np.array(self.guard.last_V) - 50.0) + self.error_V

    def run(self, ticks: int) -> list[tuple[int, str]]:
        """10 Hz tremor commands every tick, a look in every other; what was said and when (ms)."""
        said = []
        for _ in range(ticks):
            t = self.time_ms * 1e-3
            self.adc.advance_to(self.clock.now_ns())  # it has seen what was there until now
            self.guard.admit(50.0 + 20.0 * np.sin(2 * np.pi * 10.0 * t + np.arange(3)))
            self.guard.sent()
            if self.time_ms % 2 and (text := self.monitor.poll()):
                said.append((self.time_ms, text))
            self.time_ms += 1
            self.clock.advance_to(self.time_ms * MS)
        return said


def test_a_healthy_amplifier_is_never_suspected():
    stand = Stand()
    assert stand.run(2000) == []
    assert stand.monitor.suspicions == 0
    assert stand.monitor.readings > 900


@pytest.mark.parametrize("output", [0, 1, 2])
def test_a_dead_output_is_named_within_nine_ms(output: int):
    stand = Stand()
    stand.run(100)
    stand.gain[output], stand.error_V[output] = 0.0, -50.0
    when, text = stand.run(40)[0]
    assert when - 100 <= 9
    assert text.startswith(f"output {output + 1} is at ")
    assert "V and was told" in text


def test_a_small_error_is_believed_at_the_second_look_only():
    stand = Stand()
    stand.run(100)
    stand.error_V[1] = 1.2
    said = stand.run(40)
    assert said
    assert said[0][0] - 100 <= 12
    assert stand.monitor.suspicions >= 2


def test_one_wrong_reading_is_not_believed(monkeypatch: pytest.MonkeyPatch):
    stand = Stand()
    stand.run(100)
    exchange, wrong = Ads1115.exchange, [0.06]  # 1.2 V at the output, once

    def disturbed(adc: Ads1115, channel: int) -> float | None:
        value_V = exchange(adc, channel)
        return value_V if value_V is None or not wrong else value_V + wrong.pop()

    monkeypatch.setattr(Ads1115, "exchange", disturbed)
    assert stand.run(200) == []
    assert stand.monitor.suspicions == 1


def test_two_outputs_that_fail_at_once_do_not_hide_each_other():
    """Each is suspected while the other is looked at again."""
    stand = Stand()
    stand.run(100)
    stand.error_V[:2] = 1.2
    said = stand.run(40)
    assert said
    assert said[0][0] - 100 <= 12
    assert said[0][1].startswith(("output 1 is", "output 2 is"))


def test_every_output_is_looked_at_in_turn_and_a_suspected_one_in_between(monkeypatch: pytest.MonkeyPatch):
    stand = Stand()
    stand.run(100)
    order: list[int] = []
    exchange = Ads1115.exchange

    def noting(adc: Ads1115, channel: int) -> float | None:
        order.append(channel)
        return exchange(adc, channel)

    monkeypatch.setattr(Ads1115, "exchange", noting)
    stand.run(12)
    healthy = [(order[0] + i) % 3 for i in range(6)]
    assert order == healthy
    stand.error_V[healthy[-1]] = 1.2  # under way already: half of the conversion sees it
    order.clear()
    stand.run(6)
    suspect = healthy[-1]
    assert order == [(suspect + 1) % 3, suspect, (suspect + 2) % 3]


def test_a_command_under_way_may_have_arrived_already():
    """A host that was put to sleep between the acknowledge and its own note of it."""
    stand = Stand()
    stand.run(10)
    begun_ns = stand.clock.now_ns()
    stand.guard.admit(np.array([60.0, 50.0, 50.0]))
    stand.clock.burn_ns(3 * MS)
    stand.guard.sent()
    last_V = list(stand.guard.sent_commands())[1].volts[0]
    window = Window(begun_ns, begun_ns, 2 * MS, 2 * MS)
    assert stand.monitor.expected_V(0, window) == pytest.approx((min(last_V, 60.0), max(last_V, 60.0)))


def told_at(stand: Stand, *commands: tuple[float, float, float]) -> None:
    """Send commands to output 1: offered at (ms), in force at the latest at (ms), volts. The slew limit is off."""
    state = stand.guard.state
    for offered_ms, sent_ms, volts in commands:
        state.slew_V_per_s[0] = np.inf
        admit(state, (volts, 50.0, 50.0), round(offered_ms * MS))
        note_sent(state, round(sent_ms * MS))


@pytest.mark.parametrize(
    ("window_ms", "expected_V"),
    [
        ((2.0, 2.0, 1.0, 1.0), (20.0, 20.0)),  # within one command
        ((1.5, 1.5, 1.0, 1.0), (15.0, 15.0)),  # half of the old, half of the new
        ((2.6, 2.6, 1.0, 1.0), (24.0, 26.0)),  # the third comes at 3.0 to 3.2 ms
        ((1.2, 1.4, 1.0, 1.0), (12.0, 14.0)),  # begins 0.8 to 0.6 ms before the second
        ((1.2, 1.2, 1.1, 0.9), (10 + 10 * 0.1 / 0.9, 10 + 10 * 0.3 / 1.1)),  # ends 0.1 to 0.3 ms after it
    ],
)
def test_the_mean_of_commands_over_a_conversion(window_ms: tuple[float, ...], expected_V: tuple[float, float]):
    """Worked out by hand for steps at 1, 2 and 3.0 to 3.2 ms and an amplifier without delay."""
    stand = Stand(settle_s=0.0)
    told_at(stand, (1.0, 1.0, 10.0), (2.0, 2.0, 20.0), (3.0, 3.2, 30.0))
    found = stand.monitor.expected_V(0, Window(*(round(ms * MS) for ms in window_ms)))
    assert found is not None
    assert found[0] <= expected_V[0] + 1e-9
    assert found[1] >= expected_V[1] - 1e-9
    assert found == pytest.approx(expected_V, abs=1.0)  # bounds may be wider, but not by much


def test_an_amplifier_that_settles_may_be_late():
    stand = Stand(settle_s=0.0003)
    told_at(stand, (1.0, 1.0, 10.0), (2.0, 2.0, 20.0))
    assert stand.monitor.expected_V(0, Window(2 * MS, 2 * MS, MS, MS)) == pytest.approx((17.0, 20.0))


def test_what_is_within_the_tolerance_is_nothing():
    stand = Stand()
    stand.error_V[:] = 0.45
    assert stand.run(500) == []


def test_a_command_that_nobody_remembers_judges_nothing():
    stand = Stand()
    assert stand.monitor.expected_V(0, Window(0, 0, 10, 10)) is None
    stand.run(100)
    early_ns = stand.clock.now_ns() - 50 * MS
    assert stand.monitor.expected_V(0, Window(early_ns, early_ns, MS, MS)) is None


def test_a_small_change_of_what_is_usual_is_seen_within_the_tolerance():
    stand = Stand()
    stand.error_V[:], stand.gain[:] = 0.2, 1.01  # trimmed that badly, and healthy for it
    assert stand.run(1000) == []
    assert stand.monitor.suspicions == 0
    stand.error_V[2] -= 0.4  # still within +- 0.5 V
    said = stand.run(60)
    assert said
    assert said[0][0] - 1000 <= 20
    assert said[0][1].startswith("output 3 is at ")
    assert "V, from which it usually differs by +" in said[0][1]


def test_a_bus_that_waits_is_no_change_of_what_is_usual():
    """A host that stands still within transfers leaves wide ranges of commands; the true means lie at their ends."""
    stand = Stand()
    known = Window(0, 0, MS, MS)
    for k in range(400):
        t_ms = 20 * k
        told_at(stand, *((t_ms + i, t_ms + i + 0.1, 40.0 + i) for i in range(8)))
        waited = Window((t_ms + 2) * MS, (t_ms + 6) * MS, MS, MS)  # its order took 4 ms
        lowest_V, highest_V = stand.monitor.expected_V(0, waited) or (0.0, 0.0)
        assert highest_V - lowest_V > 3.0
        assert stand.monitor._judge(0, waited, lowest_V if k < 300 else highest_V) == ""
        told_at(stand, *((t_ms + i, t_ms + i + 0.1, 47.0) for i in range(8, 16)))
        known = Window((t_ms + 12) * MS, (t_ms + 12) * MS, MS, MS)
        assert stand.monitor._judge(0, known, 47.0) == ""
    assert stand.monitor.suspicions == 0
    assert stand.monitor._judge(0, known, 47.2) == ""
    assert "usually differs by +0.00 V" in stand.monitor._judge(0, known, 47.2)


def test_what_changes_slowly_becomes_usual():
    stand = Stand()
    assert stand.run(500) == []
    for _ in range(40):
        stand.error_V[0] += 0.01
        assert stand.run(100) == []


def test_a_change_while_nothing_is_known_yet_is_judged_by_the_tolerance_alone():
    stand = Stand()
    assert stand.run(100) == []
    stand.error_V[1] = 0.3
    assert stand.run(300) == []


def test_the_usual_line_is_the_one_through_the_readings():
    usual = Usual(0.15)
    for k in range(400):
        x = 20.0 * np.sin(0.7 * k)
        usual.learn((49.9 + x, 50.1 + x), 50.1 + 1.02 * x)
    assert usual.at(50.0) == pytest.approx(0.1, abs=1e-3)
    assert usual.at(70.0) == pytest.approx(0.5, abs=3e-3)  # the slope is drawn to 0 by 1 V^2 of 200 V^2
