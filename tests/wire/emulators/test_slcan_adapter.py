"""The slcan adapter against the LAWICEL ASCII protocol; and python-can's own slcan driver on its pty."""

from __future__ import annotations

import pytest

from sim_devices.devices.can_stop_button import CanStopButton
from sim_devices.devices.can_telemetry_listener import CanTelemetryListener
from sim_devices.transports.can_hub import CanHub
from sim_devices.transports.slcan_adapter import SlcanAdapter


def make() -> tuple[SlcanAdapter, CanHub, CanTelemetryListener]:
    hub = CanHub(500_000)
    panel = CanTelemetryListener()
    hub.attach(panel)
    hub.attach(CanStopButton(start_ns=0))
    return SlcanAdapter(hub), hub, panel


def ask(adapter: SlcanAdapter, data: bytes) -> bytes:
    adapter.receive(data, 0)
    return adapter.take(1000)


def test_what_python_can_sends_when_it_opens() -> None:
    adapter, _, _ = make()
    assert ask(adapter, b"C\r") == b"\r"
    assert ask(adapter, b"S6\r\r") == b"\r\r"
    assert ask(adapter, b"O\r") == b"\r"
    assert ask(adapter, b"O\r") == b"\x07"
    assert ask(adapter, b"V\rN\rF\r") == b"V1013\rNA123\rF00\r"


def test_frames_both_ways() -> None:
    adapter, hub, panel = make()
    ask(adapter, b"O\r")
    assert ask(adapter, b"t20181122334455667788\r") == b"z\r"
    hub.advance_to(10**6)
    assert panel.frames == 1
    hub.advance_to(2 * 10**6)
    assert adapter.take(100) == b"t08020000\r"  # the button's first heartbeat
    assert ask(adapter, b"T000000801FF\r") == b"Z\r"
    assert ask(adapter, b"r1230\r") == b"z\r"


@pytest.mark.parametrize(
    "line", [b"t2018112233\r", b"t8001AA\r", b"t1239" + b"00" * 9 + b"\r", b"tXYZ0\r", b"t\r", b"Q\r"]
)
def test_bad_frames_are_refused(line: bytes) -> None:
    adapter, _, _ = make()
    ask(adapter, b"O\r")
    assert ask(adapter, line) == b"\x07"


def test_closed_or_listening_adapter_sends_nothing() -> None:
    adapter, hub, panel = make()
    assert ask(adapter, b"t2010\r") == b"\x07"
    ask(adapter, b"L\r")
    assert ask(adapter, b"t2010\r") == b"\x07"
    hub.advance_to(10**6)
    assert panel.malformed == 0
    hub.advance_to(2 * 10**6)
    assert adapter.take(100) == b"t08020000\r"
    ask(adapter, b"C\r")
    hub.advance_to(10**9)
    hub.advance_to(2 * 10**9)
    assert adapter.take(100) == b""
