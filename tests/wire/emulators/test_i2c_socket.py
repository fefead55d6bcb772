"""The I2C socket server's bytes against its own specification, and bus time on the socket, with time injected."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from sim_devices.devices.ad5696r import Ad5696r
from sim_devices.transports.i2c_line import I2cLine
from sim_devices.transports.i2c_socket import I2cSocketServer


class Stand:
    def __init__(self, path: Path) -> None:
        self.dac = Ad5696r()
        self.line = I2cLine(400_000)
        self.line.attach(0x0C, self.dac)
        self.server = I2cSocketServer(self.line, path)
        self.client = self.connect()

    def connect(self) -> socket.socket:
        client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        client.settimeout(2.0)
        client.connect(str(self.server.path))
        self.server.on_readable(self.server.filenos()[0], 0, 0)
        return client

    def ask(self, words: str, asked_ns: int = 0, client: socket.socket | None = None) -> None:
        """``words``: address and count, then the operations; the time of the request goes between them."""
        data = bytes.fromhex(words)
        (client or self.client).sendall(data[:2] + asked_ns.to_bytes(8, "little") + data[2:])

    def deliver(self, t_ns: int, client: int = 1, reached_ns: int | None = None) -> None:
        """At ``t_ns`` the world sees the request; it has gone up to ``reached_ns`` before, else to now."""
        self.server.on_readable(self.server.filenos()[client], t_ns if reached_ns is None else reached_ns, t_ns)
        self.server.advance_to(t_ns)


@pytest.fixture
def stand(tmp_path: Path) -> Iterator[Stand]:
    stand = Stand(tmp_path / "i2c0.sock")
    yield stand
    stand.client.close()
    stand.server.close()


def test_an_answer_that_is_held_is_said_when_it_is_released(stand: Stand) -> None:
    """The transfer may end before its time has come; the caller must not know."""
    stand.client.setblocking(False)
    stand.ask("0c 01 00 0300 31 4000")
    stand.deliver(1000)
    stand.server.hold()
    stand.server.advance_to(1000 + 95_000)
    assert stand.dac.output_V[0] == 1.25
    with pytest.raises(BlockingIOError):
        stand.client.recv(10)
    stand.server.release()
    assert stand.client.recv(10) == bytes.fromhex("00 0000")
    stand.ask("0c 01 00 0300 31 8000")  # released for good
    stand.deliver(200_000)
    stand.server.advance_to(300_000)
    assert stand.client.recv(10) == bytes.fromhex("00 0000")


def test_an_answer_does_not_go_to_the_next_client_that_has_the_same_descriptor(stand: Stand) -> None:
    """The firmware dies in the middle of a transfer and its guardian connects: each has its own answers."""
    stand.ask("0c 01 00 0300 31 4000")
    stand.deliver(1000)
    stand.client.close()
    descriptor = stand.server.filenos()[1]
    stand.deliver(2000)
    other = stand.connect()
    assert stand.server.filenos() == [stand.server.filenos()[0], descriptor]
    stand.ask("0c 02 00 0100 01 01 0200", client=other)
    stand.deliver(3000)
    stand.server.advance_to(10_000_000)
    assert other.recv(64) == bytes.fromhex("00 0200 4000")
    assert stand.dac.output_V[0] == 1.25
    other.close()


def test_write_answers_after_its_bus_time(stand: Stand) -> None:
    stand.ask("0c 01 00 0300 31 4000")
    stand.deliver(1000)
    # START 1 + 4 bytes x 9 = 37 bits of 2.5 us, then STOP
    assert stand.server.next_event_ns() == 1000 + 92_500
    assert stand.dac.output_V[0] == 2.5
    stand.server.advance_to(1000 + 92_500)
    assert stand.dac.output_V[0] == 1.25
    assert stand.server.next_event_ns() == 1000 + 95_000
    stand.client.setblocking(False)
    with pytest.raises(BlockingIOError):
        stand.client.recv(1)
    stand.client.settimeout(2.0)
    stand.server.advance_to(1000 + 95_000)
    assert stand.client.recv(100) == bytes.fromhex("00 0000")
    assert stand.server.next_event_ns() is None


@pytest.mark.parametrize(
    ("reached_ns", "asked_ns", "begins_ns"),
    [(1000, 61_000, 61_000), (1000, 200_000, 141_000), (100_000, 61_000, 100_000)],
    ids=["when it was asked for", "never in the future", "never before what has happened"],
)
def test_begin_of_a_transfer(stand: Stand, reached_ns: int, asked_ns: int, begins_ns: int) -> None:
    stand.ask("0c 01 00 0300 31 4000", asked_ns)
    stand.deliver(141_000, reached_ns=reached_ns)
    assert stand.dac.output_V[0] == (1.25 if begins_ns + 92_500 <= 141_000 else 2.5)
    stand.server.advance_to(begins_ns + 95_000 - 1)
    stand.client.setblocking(False)
    with pytest.raises(BlockingIOError):
        stand.client.recv(1)
    stand.client.settimeout(2.0)
    stand.server.advance_to(begins_ns + 95_000)
    assert stand.client.recv(100) == bytes.fromhex("00 0000")


def test_write_then_read_in_one_transfer(stand: Stand) -> None:
    stand.ask("0c 02 00 0100 01 01 0200")
    stand.deliver(0)
    stand.server.advance_to(10**6)
    assert stand.client.recv(100) == bytes.fromhex("00 0200 8000")


@pytest.mark.parametrize(
    ("request_hex", "prepare", "reply"),
    [
        ("50 01 01 0100", "", "01 0000"),
        ("0c 01 00 0300 31 4000", "nack_data", "02 0000"),
        ("0c 01 00 0300 31 4000", "stuck", "03 0000"),
    ],
)
def test_status_codes(stand: Stand, request_hex: str, prepare: str, reply: str) -> None:
    if prepare == "stuck":
        stand.line.stuck = True
    elif prepare:
        setattr(stand.dac, prepare, True)
    stand.ask(request_hex)
    stand.deliver(0)
    stand.server.advance_to(10**6)
    assert stand.client.recv(100) == bytes.fromhex(reply)


def test_request_in_pieces(stand: Stand) -> None:
    for piece in ("0c", "01 0000", "0000 0000 0000 00 03", "00 31 40", "00"):
        assert stand.server.next_event_ns() is None
        stand.client.sendall(bytes.fromhex(piece))
        stand.deliver(5)
    assert stand.server.next_event_ns() == 5 + 92_500


def test_two_clients_share_the_bus_in_turn(stand: Stand) -> None:
    other = stand.connect()
    stand.ask("0c 01 00 0300 31 4000")
    stand.deliver(0, client=1)
    stand.ask("0c 01 00 0300 31 c000", client=other)
    stand.deliver(0, client=2)
    stand.server.advance_to(95_000)
    assert stand.dac.output_V[0] == 1.25
    assert stand.server.next_event_ns() == 95_000 + 92_500
    stand.server.advance_to(10**6)
    assert stand.dac.output_V[0] == 3.75
    assert stand.client.recv(10) == other.recv(10) == bytes(3)
    other.close()


@pytest.mark.parametrize("garbage", ["ff 01", "0c 00", "0c ff", "0c 01 07 0000", "0c 01 01 ffff"])
def test_garbage_closes_the_connection_only(stand: Stand, garbage: str) -> None:
    stand.ask(garbage)
    stand.deliver(0)
    assert stand.client.recv(10) == b""
    stand.client.close()
    stand.client = stand.connect()
    stand.ask("0c 01 01 0200")
    stand.deliver(0)
    stand.server.advance_to(10**6)
    assert len(stand.client.recv(10)) == 5


def test_client_that_goes_away_during_a_transfer(stand: Stand) -> None:
    stand.ask("0c 01 00 0300 31 4000")
    stand.deliver(0)
    stand.client.close()
    stand.deliver(10)
    stand.server.advance_to(10**6)
    assert stand.dac.output_V[0] == 1.25
    assert len(stand.server.filenos()) == 1


def test_bus_time_at_100_khz() -> None:
    line = I2cLine(100_000)
    line.attach(0x0C, Ad5696r())
    assert list(line.transfer(0x0D, [], 0)) == [10_000]
    with pytest.raises(ValueError, match="0x0c"):
        line.attach(0x0C, Ad5696r())
