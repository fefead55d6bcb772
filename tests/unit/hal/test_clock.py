"""Virtual time moves only when told to, and callbacks see their own due time."""

from hal.clock import MonotonicClock, VirtualClock


def test_callbacks_run_in_order_of_time_then_registration():
    clock, seen = VirtualClock(), []
    clock.at(30, lambda t: seen.append(("late", t, clock.now_ns())))
    clock.at(10, lambda t: seen.append(("first", t, clock.now_ns())))
    clock.at(10, lambda t: seen.append(("second", t, clock.now_ns())))
    clock.advance_to(29)
    assert seen == [("first", 10, 10), ("second", 10, 10)]
    clock.burn_ns(1)
    assert seen[-1] == ("late", 30, 30)
    assert clock.now_ns() == 30


def test_a_callback_may_register_the_next():
    clock, ticks = VirtualClock(), []

    def tick(t_ns: int) -> None:
        ticks.append(t_ns)
        clock.at(t_ns + 1_000_000, tick)

    clock.at(0, tick)
    clock.advance_to(3_500_000)
    assert ticks == [0, 1_000_000, 2_000_000, 3_000_000]
    assert clock.next_event_ns() == 4_000_000


def test_time_never_runs_backwards():
    clock = VirtualClock(100)
    assert clock.sleep_until_ns(40) == 60
    clock.advance_to(50)
    assert clock.now_ns() == 100


def test_a_callback_in_the_past_runs_at_the_next_move_without_turning_time_back():
    clock, seen = VirtualClock(100), []
    clock.at(10, lambda t: seen.append((t, clock.now_ns())))
    clock.burn_ns(0)
    assert seen == [(10, 100)]


def test_monotonic_sleep_returns_at_or_after_the_deadline():
    clock = MonotonicClock()
    due_ns = clock.now_ns() + 200_000
    late_ns = clock.sleep_until_ns(due_ns)
    assert late_ns >= 0
    assert clock.now_ns() >= due_ns
