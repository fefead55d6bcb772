"""A bench whose only device is a motion card over the air: opened with a stand-in for the radio stack."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.motion_card_protocol import BATTERY_CHARACTERISTIC, IMU_CHARACTERISTIC, PACKET
from firmware_py.endoscope.wiring import is_endoscope, open_sensors
from hal.backends import bleak_gatt
from hal.bench import load_bench, open_bench
from hal.contracts import Clock

BENCH = """
format = 1
name = "air"
[bus]
[device.ring]
driver = "ble_motion_card"
"""


class Radio:
    """Battery 42 %, and a packet whenever one is asked for with time to wait."""

    def __init__(self, peripheral: str, clock: Clock) -> None:
        self.peripheral, self._clock, self.subscribed, self.closed = peripheral, clock, [], False  # type: ignore[var-annotated]
        self._left = 3

    def read(self, characteristic: str, timeout_s: float) -> bytes:
        assert characteristic == BATTERY_CHARACTERISTIC
        return bytes((42,))

    def subscribe(self, characteristic: str, timeout_s: float) -> None:
        self.subscribed.append(characteristic)

    def receive(self, timeout_s: float) -> tuple[str, bytes, int] | None:
        if self._left == 0:
            return None
        self._left -= 1
        return IMU_CHARACTERISTIC, PACKET.pack(0, 0, 16384, 164, 0, 0, 0, 1), self._clock.now_ns()

    def close(self) -> None:
        self.closed = True


def test_a_card_over_the_air_is_wired(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(BENCH)
    bench = load_bench(path)
    assert is_endoscope(bench.description)
    made: list[Radio] = []
    monkeypatch.setattr(
        bleak_gatt, "BleakGatt", lambda peripheral, clock: made.append(Radio(peripheral, clock)) or made[0]
    )
    with open_bench(bench, pace="realtime", runtime_dir=tmp_path) as opened:
        sensors = open_sensors(opened)
        assert sensors.identities == {"ring": "motion card, battery 42 %"}
        assert made[0].peripheral == "CONTROL.CMR"
        assert made[0].subscribed == [BATTERY_CHARACTERISTIC, IMU_CHARACTERISTIC]
        ring = sensors.by_name["ring"]
        ring.read()
        assert ring.sample.accel_mps2 == pytest.approx([0.0, 0.0, 9.80665])
        assert ring.card is not None
        assert ring.card.card_status == 1
        sensors.close()
    assert made[0].closed
