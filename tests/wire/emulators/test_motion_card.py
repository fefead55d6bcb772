"""The emulated motion card against Erat 2018, sections 4.2 and 6.2, and errata nos. 112, 113, 121."""

from __future__ import annotations

import re

import numpy as np
import pytest

from sim_devices.devices.motion_card import MotionCard
from tests.wire.emulators.imu_stand import Stand, words

MS = 1_000_000


def make(**keywords: object) -> tuple[MotionCard, Stand]:
    stand = Stand()
    return MotionCard(stand, **{"errors": 0.0, "noise": 0.0, **keywords}), stand  # type: ignore[arg-type]


def text(card: MotionCard, t_ns: int) -> str:
    card.advance_to(t_ns)
    return card.take(100_000).decode("ascii")


def test_line_as_printed_with_raw_counts() -> None:
    """#:ax:ay:az:wx:wy:wz:temperature:status: CR LF; 16384 LSB/g, 16.4 LSB/dps, T = n / 340 + 36.53."""
    card, stand = make()
    stand.g, stand.dps, stand.temperature_C = np.array([0.5, -0.25, 1.0]), np.array([10.0, -20.0, 100.0]), 25.0
    lines = text(card, 500 * MS).split("\r\n")
    assert lines[-2] == f"#:8192:-4096:16384:164:-328:1640:{round((25.0 - 36.53) * 340)}:0:"


def test_scaled_fields() -> None:
    card, stand = make(scaled=True)
    stand.g = np.array([0.5, -0.25, 1.0])
    assert text(card, 500 * MS).split("\r\n")[-2] == "#:0.5000:-0.2500:1.0000:0.00:0.00:0.00:25.00:0:"


def test_packet_is_the_example_of_the_document() -> None:
    """Errata no. 112: 03-5A-FA-AE-3F-0E-...-EB-47-00: a_z 0x3F0E = 0.985 g, T 0xEB47 = 20.9 degC, big-endian."""
    card, stand = make()
    stand.g = np.array([0x035A, 0xFAAE - 0x10000, 0x3F0E]) / 16384
    stand.temperature_C = (0xEB47 - 0x10000) / 340 + 36.53
    card.advance_to(500 * MS)
    assert len(card.packet) == 15
    assert card.packet[:6] == bytes.fromhex("035afaae3f0e")
    assert card.packet[12:] == bytes.fromhex("eb4700")


def test_hundred_lines_a_second_paced_by_the_baud_rate() -> None:
    card, _ = make()
    card.advance_to(10 * MS)
    assert card.take(100) == b""  # the line starts when the sample is there
    card.advance_to(10 * MS + 86_000)  # 10 bits at 115200 baud: 86.8 us a byte
    assert card.take(100) == b""
    card.advance_to(10 * MS + 87_000)
    assert card.take(100) == b"#"
    card.advance_to(10 * MS + 10 * 86_806)
    assert len(card.take(100)) == 9
    rest = text(card, 1010 * MS - 1)
    assert rest.count("\r\n") == 100
    assert card.skipped == 0


def test_too_slow_a_line_drops_whole_lines_and_counts() -> None:
    card, _ = make(rate_hz=1000.0)
    lines = text(card, 1000 * MS).split("\r\n")[:-1]
    assert card.skipped > 300
    assert card.lines + card.skipped == 1000
    assert all(re.fullmatch(r"#(:-?\d+){7}:[012]:", line) for line in lines)
    fast, _ = make(rate_hz=1000.0, baud=921_600)
    assert sum(text(fast, 100 * k * MS).count("\r\n") for k in range(1, 11)) >= 999
    assert fast.skipped == 0


def test_host_that_does_not_read() -> None:
    card, _ = make()
    card.unread = 5000
    card.advance_to(100 * MS)
    assert card.skipped == 10


@pytest.mark.parametrize(("held_ms", "status"), [(100, 1), (499, 1), (500, 2), (800, 2)])
def test_short_and_long_press(held_ms: int, status: int) -> None:
    """Shorter than 0.5 s: status 1; longer: 2; exactly 0.5 s is long (errata no. 121); a short one ends both."""
    card, _ = make()
    card.advance_to(100 * MS)
    card.press()
    card.advance_to((100 + held_ms) * MS)
    assert card.status == 0
    card.release()
    assert card.status == status
    assert text(card, (150 + held_ms) * MS).split("\r\n")[-2].endswith(f":{status}:")
    card.press()
    card.advance_to((250 + held_ms) * MS)
    card.release()
    assert card.status == 0


def test_click_shakes_accelerometer_and_gyroscope_for_twenty_ms() -> None:
    card, _ = make(rate_hz=500.0, baud=921_600)
    card.advance_to(300 * MS)
    card.press()
    shaken: list[int] = []
    for t_ms in range(302, 380, 2):
        card.advance_to(t_ms * MS)
        *accel, _, wx, _, _ = words(card.packet[:14])
        if abs(accel[2] - 16384) > 300:
            shaken.append(t_ms - 300)
        assert (abs(wx) > 20) <= (t_ms <= 326)
    assert shaken
    assert max(shaken) <= 24  # 20 ms and the tail of the 94 Hz filter


def test_battery() -> None:
    """220 mAh at 6.184 mA: 35.6 h, then silence."""
    card, _ = make()
    card.frozen = True
    hour_ns = 3_600_000_000_000
    card.advance_to(10 * hour_ns + 29 * 60_000_000_000)
    assert card.battery_percent == pytest.approx(100 - (10 + 29 / 60) * 6.184 / 2.2)
    card.frozen = False
    card.battery_percent = 0.0
    text(card, 10 * hour_ns + 29 * 60_000_000_000 + 100 * MS)
    assert card.lines == 0


def test_corrupted_bytes() -> None:
    card, _ = make()
    card.corrupt_bytes = 1
    card.advance_to(19 * MS)
    assert card.take(2) == bytes((ord("#") ^ 0xFF, ord(":")))


def test_calibrated_at_its_temperature() -> None:
    """The automatic calibration leaves what the offset registers cannot hold: scale and later temperature."""
    stand = Stand()
    rough = MotionCard(stand, noise=0.0, calibrated=False)
    smooth = MotionCard(stand, noise=0.0)
    for card in (rough, smooth):
        card.advance_to(500 * MS)
    left, raw = (np.abs(words(card.packet[6:12])).max() / 16.4 for card in (smooth, rough))
    assert left < 0.1 < raw
