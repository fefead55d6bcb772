"""CAN traffic, frame by frame, decoded with our database where it knows the id."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from drivers.dbc import load_database
from hal.bench import OpenBench
from hal.types import CanFrame


@dataclass(frozen=True)
class Heard:
    """Holds one frame: time since the start of listening, and its decoded content, if its id is known."""

    bus: str
    t_s: float
    frame: CanFrame
    message: str
    signals: dict[str, float]

    def as_dict(self) -> dict[str, object]:
        return {
            "bus": self.bus,
            "t_s": self.t_s,
            "id": self.frame.can_id,
            "data": self.frame.data.hex(),
            "message": self.message,
            "signals": self.signals,
        }


class Decoder:
    """Frames to names and numbers."""

    def __init__(self) -> None:
        self._messages = {m.frame_id: m for m in getattr(load_database(), "messages", ())}

    def __call__(self, frame: CanFrame) -> tuple[str, dict[str, float]]:
        message = self._messages.get(frame.can_id)
        if message is None:
            return "", {}
        try:
            decoded = message.decode(frame.data, decode_choices=False)
        except Exception:  # cantools has no common base for what it raises on a frame that is too short
            return f"{message.name} (cannot be decoded)", {}
        return message.name, {key: float(value) for key, value in decoded.items()}


def listen(bench: OpenBench, buses: list[str], seconds: float, count: int | None) -> Iterator[Heard]:
    """Everything heard on ``buses`` until the time or ``count`` frames are over."""
    decode, clock = Decoder(), bench.clock
    start_ns = clock.now_ns()
    end_ns, left = start_ns + round(seconds * 1e9), count
    while clock.now_ns() < end_ns and left != 0:
        for bus in buses:
            frame = bench.can(bus).recv(0.02 / len(buses))
            if frame is not None and left != 0:
                name, signals = decode(frame)
                yield Heard(bus, (clock.now_ns() - start_ns) * 1e-9, frame, name, signals)
                left = None if left is None else left - 1
