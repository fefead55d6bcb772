"""Time bases in virtual time: host clock, device scans, silence of the device."""

from __future__ import annotations

from collections import deque

from firmware_py.scheduler import HostTicker, ScanTicker, Ticks
from hal.clock import VirtualClock
from hal.types import ScanBlock, TimeSource

MS = 1_000_000


class FakeDaq:
    """Delivers blocks (arrival time, scans, first sequence number); waiting moves the clock."""

    def __init__(self, clock: VirtualClock, *blocks: tuple[float, int, int]) -> None:
        self.clock = clock
        self.blocks = deque(blocks)

    def read(self, timeout_s: float) -> ScanBlock:
        until_ns = self.clock.now_ns() + int(timeout_s * 1e9)
        if self.blocks and self.blocks[0][0] * MS <= until_ns:
            arrives_ms, n, seq0 = self.blocks.popleft()
            self.clock.advance_to(round(arrives_ms * MS))
            return ScanBlock(n, seq0 * MS, MS, seq0, TimeSource.DEVICE_CLOCK)
        self.clock.advance_to(until_ns)
        return ScanBlock(0, 0, 0, 0, TimeSource.DEVICE_CLOCK)


def scan_ticker(clock: VirtualClock, *blocks: tuple[float, int, int]) -> ScanTicker:
    return ScanTicker(FakeDaq(clock, *blocks).read, clock, MS, silent_after_ns=3 * MS)


def test_host_ticks_keep_the_grid() -> None:
    clock = VirtualClock(start_ns=500)
    ticker = HostTicker(clock, MS, t0_ns=2000)
    assert [ticker.wait().due_ns for _ in range(3)] == [2000, 2000 + MS, 2000 + 2 * MS]
    clock.burn_ns(3 * MS + 1)
    late = ticker.wait()
    assert late == Ticks(5, 1, 2000 + 5 * MS, MS, TimeSource.HOST)
    assert clock.now_ns() == 2000 + 5 * MS + 1
    assert ticker.wait().k0 == 6
    assert clock.now_ns() == 2000 + 6 * MS


def test_host_ticks_may_start_at_any_number() -> None:
    clock = VirtualClock()
    ticker = HostTicker(clock, MS, t0_ns=0, k0=2**31)
    assert ticker.wait() == Ticks(2**31, 1, 2**31 * MS, MS, TimeSource.HOST)


def test_scans_carry_the_device_time_and_number() -> None:
    clock = VirtualClock(start_ns=70 * MS)
    ticker = scan_ticker(clock, (71.2, 1, 71), (72.3, 1, 72), (75.9, 3, 73))
    assert ticker.wait() == Ticks(0, 1, 71 * MS, MS, TimeSource.DEVICE_CLOCK)
    assert ticker.wait() == Ticks(1, 1, 72 * MS, MS, TimeSource.DEVICE_CLOCK)
    clock.advance_to(76 * MS)  # the loop was busy; three scans wait
    assert ticker.wait() == Ticks(2, 3, 73 * MS, MS, TimeSource.DEVICE_CLOCK)


def test_lost_scans_leave_a_gap_in_the_numbers() -> None:
    clock = VirtualClock()
    ticker = scan_ticker(clock, (1.0, 1, 1), (2.0, 1, 2), (5.0, 1, 5))
    assert [ticker.wait().k0 for _ in range(3)] == [0, 1, 4]


def test_a_silent_device_is_replaced_by_the_host_clock() -> None:
    clock = VirtualClock()
    ticker = scan_ticker(clock, (1.5, 1, 1), (9.5, 1, 9))
    assert ticker.wait().k0 == 0  # due at 1 ms
    ticks = [ticker.wait() for _ in range(6)]
    # silent until 4 ms: tick 3 is the newest due; then one per period, on the device's grid
    assert [(t.k0, t.due_ns // MS, t.source) for t in ticks[:5]] == [
        (3, 4, TimeSource.HOST),
        (4, 5, TimeSource.HOST),
        (5, 6, TimeSource.HOST),
        (6, 7, TimeSource.HOST),
        (7, 8, TimeSource.HOST),
    ]
    assert (ticks[5].k0, ticks[5].source) == (8, TimeSource.HOST)  # 9.5 is later than the tick of 9
    back = ticker.wait()
    assert (back.k0, back.due_ns, back.source) == (9, 9 * MS, TimeSource.DEVICE_CLOCK)
    assert (ticker.host_ticks, ticker.rebased) == (6, 1)  # scan 9 would have been tick 8, already used


def test_a_device_that_never_speaks_still_ticks() -> None:
    clock = VirtualClock(start_ns=10 * MS)
    ticker = scan_ticker(clock)
    assert [(t.k0, t.due_ns // MS) for t in (ticker.wait(), ticker.wait())] == [(2, 13), (3, 14)]


def test_a_host_that_was_away_itself_asks_once_more_before_it_blames_the_device() -> None:
    clock = VirtualClock(start_ns=70 * MS)
    ticker = scan_ticker(clock, (71.0, 1, 71), (90.5, 2, 89))
    assert ticker.wait().due_ns == 71 * MS
    clock.advance_to(90 * MS)  # nothing there yet when the host comes back: the link delivers a moment later
    assert ticker.wait() == Ticks(18, 2, 89 * MS, MS, TimeSource.DEVICE_CLOCK)
    clock.advance_to(110 * MS)
    assert ticker.wait().source is TimeSource.HOST
    assert clock.now_ns() == 113 * MS
