"""Motion card: the ends of what is accepted, and what stands before a line. Forms of Erat 2018, section 4.2."""

from __future__ import annotations

import pytest

from drivers.motion_card_protocol import LONGEST_LINE, LineParser, decode_line, decode_packet
from tests.wire.drivers.test_motion_card_wire import EXAMPLE, LINE


@pytest.mark.parametrize("status", [0, 1, 2])
def test_every_status_of_the_card_is_a_packet(status: int):
    assert decode_packet(EXAMPLE[:-1] + bytes((status,))).status == status


def test_counts_end_where_16_bits_do():
    assert decode_line(b"#:-32768:32767:0:0:0:0:0:0:", "raw").values[:2] == (-32768, 32767)
    for beyond in (b"-32769", b"32768"):
        with pytest.raises(ValueError, match="counts beyond 16 bit"):
            decode_line(b"#:" + beyond + b":0:0:0:0:0:0:0:", "raw")


def test_a_parser_of_counts_takes_no_scaled_line_and_one_of_scaled_fields_does():
    scaled = b"#:0.5:-0.5:0.9:0.0:0.0:0.0:20.9:1:\r\n"
    raw = LineParser()
    assert raw.feed(LINE + scaled + b"#:40000:0:0:0:0:0:0:0:\r\n" + LINE) == [decode_packet(EXAMPLE)] * 2
    assert raw.bad_frames == 2
    (reading,) = LineParser("scaled").feed(scaled)
    assert reading.values[6] == 20.9


@pytest.mark.parametrize("stray", [b"x", b"xy", b":", b"#"])
def test_what_came_in_between_is_counted_and_the_line_behind_it_is_read(stray: bytes):
    parser = LineParser()
    assert parser.feed(LINE + stray + LINE) == [decode_packet(EXAMPLE)] * 2
    assert (parser.discarded_bytes, parser.bad_frames) == (len(stray), 1)


def test_a_beginning_of_the_longest_line_is_kept_behind_one_stray_byte():
    parser = LineParser()
    parser.feed(b"x#:" + b"1" * (LONGEST_LINE - 2))
    assert parser.discarded_bytes == 1
    parser.feed(b"1")
    assert parser.discarded_bytes == 2 + LONGEST_LINE, "now it is too long itself"
