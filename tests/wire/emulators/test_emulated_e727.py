"""The emulated PI E-727 against GCS 2.0 as captured from real devices (ecosystem.md section 6b)."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_devices.devices.e727 import E727

BYTE_NS = 86_806  # 10 bits at 115200 baud
S = 10**9


class Line:
    """Host end of the serial line; waits long enough for each answer."""

    def __init__(self) -> None:
        self.outputs: list[tuple[int, float]] = []
        self.device = E727(on_output=lambda c, v, t: self.outputs.append((c, v)))
        self.t_ns = 0

    def send(self, data: bytes) -> None:
        self.device.receive(data, self.t_ns)

    def wait(self, seconds: float = 0.05) -> bytes:
        self.t_ns += round(seconds * S)
        self.device.advance_to(self.t_ns)
        return self.device.take(4096)

    def ask(self, data: bytes) -> bytes:
        self.send(data)
        return self.wait()

    def error(self) -> int:
        return int(self.ask(b"ERR?\n"))


def test_identity_and_axes() -> None:
    line = Line()
    identity = b"(c)2016 Physik Instrumente (PI) GmbH & Co. KG, E-727.3SDA, 0116047977, 13.21.00.02\n"
    assert line.ask(b"*IDN?\n") == identity
    assert line.ask(b"SAI?\n") == b"1 \n2 \n3\n"  # every line but the last ends SP LF
    assert line.ask(b"CSV?\n") == b"2.0\n"


def test_position_lines_have_the_captured_form() -> None:
    line = Line()
    line.send(b"SVA 1 50 2 100\n")
    assert line.ask(b"POS?\n") == b"1=7.500000000e+00 \n2=1.500000000e+01 \n3=0.000000000e+00\n"
    assert line.ask(b"pos? 2\n") == b"2=1.500000000e+01\n"  # mnemonics are not case sensitive
    assert line.ask(b"VOL?\n").count(b"\n") == 4  # per output, not per axis


@pytest.mark.parametrize(
    ("commands", "number"),
    [
        (b"XYZ 1\n", 2),
        (b"MOV 1 5\n", 5),  # servo off
        (b"SVO 1 1\nMOV 1 20\n", 7),  # beyond TMX
        (b"SVO 1 1\nSVA 1 10\n", 303),
        (b"SVA 1 101\n", 302),
        (b"SVA 4 10\n", 15),
        (b"SVA 1\n", 24),
        (b"SVA 1 volt\n", 25),
        (b"SVA 1 nan\n", 25),
        (b"SVA 1 1 1 2\n", 22),
        (b"SPA 1 0x06000500 2\n", 60),
        (b"CCL 1 wrong\n", 56),
        (b"SPA? 1 0x1\n", 54),
        (b"STP\n", 10),
        (b"\x18", 10),
        (b"SVA 1 " + b"0" * 600 + b"\n", 3),
    ],
)
def test_errors_are_latched_and_cleared_by_reading(commands: bytes, number: int) -> None:
    line = Line()
    assert line.ask(commands) == b""  # a set command never answers
    line.wait(0.1)
    assert line.error() == number
    assert line.error() == 0


def test_its_lists_name_every_command_and_parameter_that_it_knows() -> None:
    line = Line()

    def ask(command: bytes) -> bytes:
        line.send(command)
        return line.wait(0.3)

    told = ask(b"HLP?\n").decode().splitlines()
    assert told[0].startswith("The following commands are valid")
    assert told[-1] == "end of help"
    names = [text.split()[0] for text in told[1:-1]]
    for name in names:
        if name.endswith("?"):
            assert ask(name.encode() + b"\n")
            assert line.error() == 0
    assert {"MOV", "SVO", "WGO"} - set(names) == {"WGO"}
    parameters = ask(b"HPA?\n").decode().splitlines()[1:-1]
    every = ask(b"SPA?\n").decode().splitlines()
    assert len(every) == 3 * len(parameters)
    assert "1 0x0E000200=5e-05 " in every  # manual p. 108: the servo update time is 50 us
    assert line.ask(b"WGO 1 1\n") == b""
    assert line.error() == 2


def test_all_axes_move_or_none() -> None:
    line = Line()
    line.send(b"SVO 1 1 2 1\nMOV 1 5 2 16\n")
    line.wait()
    assert line.error() == 7
    assert line.ask(b"MOV?\n") == b"1=0.000000000e+00 \n2=0.000000000e+00 \n3=0.000000000e+00\n"


def test_servo_reaches_its_target_and_says_so() -> None:
    line = Line()
    line.send(b"SVO 1 1\nMOV 1 7.5\n")
    line.wait(0.2)
    assert line.ask(b"ONT? 1\n") == b"1=1\n"
    assert line.device.position_um(0) == pytest.approx(7.5, abs=0.05)
    assert line.ask(b"\x05") == b"0\n"


def test_single_byte_commands_need_no_line_feed() -> None:
    line = Line()
    assert line.ask(b"\x07") == b"\xb1\n"
    line.send(b"ATZ 1 NaN\n")
    line.wait(0.01)
    assert line.ask(b"\x07") == b"\xb0\n"  # busy
    line.wait(0.6)
    assert line.ask(b"ATZ? 1\n") == b"1=1\n"


def test_bytes_take_their_time_on_the_line() -> None:
    """MOV with 28 bytes takes 2.4 ms, a three-axis POS? 5.3 ms (section 6b, speed honesty)."""
    line = Line()
    line.send(b"SVA 1 12.345678 2 23.456789\n")
    line.device.advance_to(28 * BYTE_NS - 100)
    assert line.outputs == []
    line.device.advance_to(28 * BYTE_NS + 100)
    assert line.outputs == [(0, 12.345678), (1, 23.456789)]
    line.t_ns = 10**9
    line.send(b"POS?\n")
    end_ns = 10**9 + (5 + 56) * BYTE_NS
    line.device.advance_to(end_ns - 2 * BYTE_NS)
    got = line.device.take(100)
    assert len(got) < 56
    line.device.advance_to(end_ns + BYTE_NS)
    assert len(got + line.device.take(100)) == 56


def test_frozen_controller_loses_what_it_is_sent() -> None:
    line = Line()
    line.device.frozen = True
    assert line.ask(b"*IDN?\n") == b""
    line.device.frozen = False
    assert line.ask(b"ERR?\n") == b"0\n"


_WORDS = st.sampled_from(
    ["SVA", "MOV", "SVO", "SPA?", "SPA", "VEL", "ATZ", "VOL?", "1", "2", "0x", "-1", "1e400", "nan", "9"]
)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=30), st.lists(_WORDS, max_size=6).map(lambda w: " ".join(w).encode()))))
def test_no_bytes_from_the_host_break_it(lines: list[bytes]) -> None:
    line = Line()
    for data in lines:
        line.send(data + b"\n")
        line.wait()
    line.wait(0.5)
    line.device.receive(b"\n", line.t_ns)
    line.wait()
    assert line.ask(b"SAI?\n").endswith(b"1 \n2 \n3\n")
    assert all(0.0 <= v <= 100.0 for _, v in line.outputs)
