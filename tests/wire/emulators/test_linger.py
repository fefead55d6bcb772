"""How long an emulated world outlives its firmware, without a process and without a second of real time."""

from __future__ import annotations

from sim_devices.linger import LINGER_NS, LONGEST_LINGER_NS, Linger

START_NS = 5_000_000_000
LOOK_NS = 100_000_000


def test_a_world_whose_firmware_lives_never_ends_by_itself() -> None:
    assert not Linger().is_over(10 * LONGEST_LINGER_NS, False)


def test_a_world_without_clients_ends_a_second_after_its_firmware() -> None:
    linger = Linger()
    linger.begin(START_NS)
    linger.begin(START_NS + LOOK_NS)  # told twice: by the signal, and by a look at the parent
    assert not linger.is_over(START_NS + LINGER_NS - 1, False)
    assert linger.is_over(START_NS + LINGER_NS, False)


def test_a_guardian_that_connects_again_after_a_transfer_without_an_answer_finds_the_world() -> None:
    linger = Linger()
    linger.begin(START_NS)
    for now_ns in range(START_NS, START_NS + 3 * LINGER_NS, LOOK_NS):
        assert not linger.is_over(now_ns, True)
    gone_ns = START_NS + 3 * LINGER_NS
    assert not linger.is_over(gone_ns, False), "its connection is closed, and it has not tried again yet"
    assert not linger.is_over(gone_ns + LOOK_NS, True)
    assert not linger.is_over(gone_ns + LINGER_NS, False)
    assert linger.is_over(gone_ns + LOOK_NS + LINGER_NS, False)


def test_a_client_that_never_leaves_keeps_the_world_for_a_minute_at_most() -> None:
    linger = Linger()
    linger.begin(START_NS)
    assert not linger.is_over(START_NS + LONGEST_LINGER_NS - 1, True)
    assert linger.is_over(START_NS + LONGEST_LINGER_NS, True)
