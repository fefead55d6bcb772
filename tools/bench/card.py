"""Prints the motion card of a bench as JSON lines for the targeting experiment (``python -m tools.bench.card BENCH``).

psi is the roll, theta the pitch of the card, degrees, from gravity and the rate gyroscope (complementary filter with
``BLEND_S``). One line per sample; ``use`` is false for samples that the driver's spike filter held back.
"""

from __future__ import annotations

import json
import math
import signal
import sys
import tempfile
from pathlib import Path

from drivers.imu.base import ImuSample
from drivers.motion_card import MotionCard
from drivers.options import MotionCardOptions
from drivers.specs import check_devices
from hal.bench import OpenBench, load_bench, open_bench
from hal.errors import HalError
from hal.types import Status

BLEND_S = 1.0
TILT_RAD = math.pi / 180.0


def open_card(bench: OpenBench) -> MotionCard:
    """Open and probe the first motion card of the bench."""
    description = bench.file.description
    name, spec = next(iter(description.devices_with("motion_card").items()))
    options: MotionCardOptions = check_devices(description, str(bench.file.path))[name]
    assert spec.bus is not None
    card = MotionCard(bench.serial(spec.bus), bench.clock, rate_hz=options.rate_hz, fields=options.fields, name=name)
    card.probe()
    return card


class Tilt:
    """Estimates roll and pitch, in degrees."""

    def __init__(self) -> None:
        self.angles: tuple[float, float] | None = None
        self._t_ns = 0

    def step(self, sample: ImuSample) -> tuple[float, float]:
        ax, ay, az = (float(v) for v in sample.accel_mps2)
        seen = (math.atan2(ay, az) / TILT_RAD, math.atan2(-ax, math.hypot(ay, az)) / TILT_RAD)
        passed_s = max(0.0, min(0.1, (sample.t_ns - self._t_ns) * 1e-9))
        self._t_ns = sample.t_ns
        if self.angles is None:
            self.angles = seen
        keep = BLEND_S / (BLEND_S + passed_s)
        roll, pitch = (
            keep * (angle + float(rate) / TILT_RAD * passed_s) + (1.0 - keep) * other
            for angle, rate, other in zip(self.angles, sample.gyro_rad_s[:2], seen, strict=True)
        )
        self.angles = roll, pitch
        return self.angles


def stream(bench: OpenBench) -> None:
    """Print samples until the pipe or the card goes."""
    card, tilt, sample = open_card(bench), Tilt(), ImuSample()
    due_ns = bench.clock.now_ns()
    while True:
        due_ns += 5_000_000
        bench.clock.sleep_until_ns(due_ns)
        while True:
            waiting = card.waiting()
            status = card.read(sample)
            if status & Status.STALE and not waiting:
                break
            psi, theta = tilt.step(sample)
            line = {"psi": psi, "theta": theta, "status": card.card_status, "use": not status & Status.STALE}
            sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


def main(arguments: list[str]) -> int:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    try:
        with (
            tempfile.TemporaryDirectory(prefix="micron-") as folder,
            open_bench(load_bench(Path(arguments[0])), pace=None, runtime_dir=Path(folder)) as bench,
        ):
            stream(bench)
    except BrokenPipeError:
        return 0
    except HalError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
