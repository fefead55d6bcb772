"""GCS on the serial line: replies of several lines, errors with their meaning, and a loop that never waits."""

from __future__ import annotations

import pytest

from drivers.piezo.gcs import ERRORS, LONGEST_REPLY, GcsLink
from hal.clock import VirtualClock
from hal.errors import HalTimeout, ProtocolError
from tests.wire.drivers.scripted_ports import ScriptedSerial, SilentSerial

MS = 1_000_000


class Line(SilentSerial):
    """A port that takes ``room`` bytes at once and gives what the test lets arrive."""

    def __init__(self, room: int = 1000) -> None:
        self.room, self.sent, self.arrived = room, b"", b""

    def write(self, data: bytes, timeout_s: float) -> None:
        assert timeout_s == 0.0, "the loop never waits"
        taken = data[: self.room]
        self.sent += taken
        self.room -= len(taken)
        if len(taken) < len(data):
            raise HalTimeout("the port is full", device="line", partial=len(taken))

    def read_into(self, buf: memoryview, timeout_s: float) -> int:
        assert timeout_s == 0.0, "the loop never waits"
        n = min(len(buf), len(self.arrived))
        buf[:n], self.arrived = self.arrived[:n], self.arrived[n:]
        return n


def scripted(*script: tuple[object, ...]) -> GcsLink:
    clock = VirtualClock()
    return GcsLink(ScriptedSerial(clock, script), clock, "piezo")


def loop(room: int = 1000) -> tuple[GcsLink, Line, VirtualClock]:
    line, clock = Line(room), VirtualClock()
    return GcsLink(line, clock, "piezo", timeout_s=0.1), line, clock


def test_a_reply_ends_with_the_line_that_has_no_space():
    link = scripted(("w", b"SVO?\n"), ("r", b"1=1 \n"), ("r", b"2=0 \n3=1\n"))
    assert link.query("SVO?") == ["1=1", "2=0", "3=1"]


def test_values_are_finite_numbers_after_an_equals_sign():
    assert scripted(("w", b"POS?\n"), ("r", b"1=1.5 \n2=-2e1\n")).values("POS?", 2) == [1.5, -20.0]
    for reply in (b"1.5\n", b"1=fast\n", b"1=nan\n", b"1=2=3\n", b"1=1.5\n", b"\n"):
        with pytest.raises(ProtocolError, match=r"answer to 'POS\?'") as caught:
            scripted(("w", b"POS?\n"), ("r", reply)).values("POS?", 2)
        assert caught.value.device == "piezo"


def test_a_silent_controller_is_told_with_what_came():
    link = scripted(("w", b"*IDN?\n"), ("r", b"PI"))
    with pytest.raises(HalTimeout, match=r"no answer to '\*IDN\?' within 0.5 s, got b'PI'") as caught:
        link.query("*IDN?")
    assert (caught.value.device, caught.value.partial) == ("piezo", 2)


def test_a_reply_that_never_ends_is_cut_off():
    pieces = (LONGEST_REPLY + 256) // 256 + 1
    link = scripted(("w", b"HLP?\n"), *[("r", b"x" * 256)] * pieces)
    with pytest.raises(HalTimeout) as caught:
        link.query("HLP?")
    assert LONGEST_REPLY < caught.value.partial <= LONGEST_REPLY + 256


def test_a_reply_that_comes_slowly_and_never_ends_is_a_bounded_wait():
    clock = VirtualClock()
    pieces = [e for k in range(1, 20) for e in (("at", k * 200 * MS), ("r", b"1=1 \n"))]
    link = GcsLink(ScriptedSerial(clock, [("w", b"SVO?\n"), *pieces]), clock, "piezo", timeout_s=1.0)
    with pytest.raises(HalTimeout, match=r"no answer to 'SVO\?' within 1\.0 s") as caught:
        link.query("SVO?")
    assert caught.value.partial == 5 * 5
    assert clock.now_ns() <= 1200 * MS


def test_a_command_is_asked_for_its_error_at_once():
    scripted(("w", b"SVO 1 1\n"), ("w", b"ERR?\n"), ("r", b"0\n")).command("SVO 1 1")
    for code, meaning in (*ERRORS.items(), (4711, "see the manual's error list")):
        link = scripted(("w", b"SVO 1 1\n"), ("w", b"ERR?\n"), ("r", b"%d\n" % code))
        with pytest.raises(ProtocolError, match=f"error {code} after 'SVO 1 1': {meaning}") as caught:
            link.command("SVO 1 1")
        assert caught.value.device == "piezo"
    with pytest.raises(ProtocolError, match=r"answer to 'ERR\?' was 'what'") as caught:
        scripted(("w", b"SVO 1 1\n"), ("w", b"ERR?\n"), ("r", b"what\n")).command("SVO 1 1")
    assert caught.value.device == "piezo"


def test_a_latched_error_can_be_forgotten():
    scripted(("w", b"ERR?\n"), ("r", b"10\n")).clear_error()


def test_what_the_port_did_not_take_goes_first_and_nothing_overtakes_it():
    link, line, _ = loop(room=3)
    assert link.send(b"MOV 1 5\n"), "it is on its way"
    assert not link.send(b"MOV 1 6\n"), "nothing of it was taken"
    line.room = 2
    assert not link.send(b"MOV 1 7\n")
    line.room = 100
    assert link.send(b"MOV 1 8\n")
    assert line.sent == b"MOV 1 5\nMOV 1 8\n"


def test_an_error_is_asked_for_once_and_found_later():
    link, line, clock = loop()
    link.ask_error()
    link.ask_error()
    assert line.sent == b"ERR?\n"
    link.take_error()
    line.arrived = b"30"
    link.take_error()
    clock.burn_ns(100 * MS)
    line.arrived = b"2\n"
    with pytest.raises(ProtocolError, match="error 302 after 'an earlier command': voltage out of limits"):
        link.take_error()
    link.ask_error()
    line.arrived = b"0\n"
    link.take_error()
    assert line.sent == b"ERR?\n" * 2
    clock.burn_ns(1000 * MS)
    link.take_error()


def test_what_comes_behind_an_answer_waits_and_an_empty_one_is_none():
    link, line, _ = loop()
    link.ask_error()
    line.arrived = b"0\n10\n"
    link.take_error()
    link.ask_error()
    line.arrived = b"\r"
    with pytest.raises(ProtocolError, match="error 10 after"):
        link.take_error()
    link.ask_error()
    line.arrived = b"\n"
    with pytest.raises(ProtocolError, match=r"answer to 'ERR\?' was '.{2}'"):
        link.take_error()
    link.ask_error()
    line.arrived = b"\n"
    with pytest.raises(ProtocolError, match=r"answer to 'ERR\?' was ''"):
        link.take_error()


def test_an_answer_that_is_late_is_a_lost_link():
    link, line, clock = loop()
    link.take_error()
    link.ask_error()
    clock.burn_ns(100 * MS)
    link.take_error()
    line.arrived = b"0"
    clock.burn_ns(1)
    with pytest.raises(HalTimeout, match=r"no answer to 'ERR\?' within 0.1 s: link lost\?") as caught:
        link.take_error()
    assert caught.value.device == "piezo"


def test_a_port_that_takes_nothing_for_the_timeout_is_told():
    link, line, clock = loop(room=3)
    assert link.send(b"SVA 1 2\n")
    clock.burn_ns(90 * MS)
    link.take_error()
    line.room = 1  # it moves: the time begins anew
    link.take_error()
    clock.burn_ns(100 * MS)
    link.take_error()
    clock.burn_ns(MS)
    with pytest.raises(HalTimeout, match=r"taken nothing for 0\.1 s"):
        link.take_error()
    with pytest.raises(HalTimeout, match=r"taken nothing for 0\.1 s"):
        link.send(b"SVA 1 3\n")  # a step of the ramp, which would be tried for ever
    line.room = 1000
    link.take_error()
    assert line.sent == b"SVA 1 2\n"


def test_an_error_cannot_be_asked_for_behind_a_stuck_command():
    link, line, _ = loop(room=2)
    link.send(b"MOV 1 5\n")
    link.ask_error()
    line.room = 100
    link.take_error()
    assert line.sent == b"MOV 1 5\n", "sent on by take_error, and no question behind it"
    link.ask_error()
    assert line.sent == b"MOV 1 5\nERR?\n"


def test_settling_waits_for_the_answer_and_not_for_ever():
    link, line, clock = loop()
    link.settle()
    assert clock.now_ns() == 0, "nothing is under way"
    link.ask_error()
    line.arrived = b"0\n"
    link.settle()
    assert clock.now_ns() == MS
    stuck, _, clock = loop(room=0)
    stuck.send(b"MOV 1 5\n")
    stuck.settle()
    assert clock.now_ns() == 100 * MS


def test_closing_closes_the_port():
    link, line, _ = loop()
    link.close()
    assert line.closed
