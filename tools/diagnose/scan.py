"""Scans the ports of the machine, the addresses on the I2C buses of a bench, and the traffic on its CAN buses."""

from __future__ import annotations

import glob
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from drivers.dbc import load_database
from hal.bench import OpenBench
from hal.errors import HalError
from hal.types import I2cOp, I2cRead, I2cWrite

Probe = Literal["read", "write"]
FIRST, LAST = 0x08, 0x77
PROBES: dict[str, str] = {
    "read": "reads one byte; takes no register pointer along, but empties what a read empties",
    "write": "writes one zero byte, which most chips take for a register pointer; a few obey it",
}


@dataclass(frozen=True)
class Answer:
    """Holds an I2C address: the device of the bench file, and whether something answered."""

    bus: str
    address: int
    declared: str
    answered: bool


@dataclass(frozen=True)
class CanTraffic:
    """Frames of one CAN id."""

    bus: str
    can_id: int
    name: str
    frames: int
    rate_hz: float


@dataclass
class ScanResult:
    """Holds the result of a scan. ``missing`` names declared I2C devices that did not answer."""

    probe: Probe
    ports: list[str] = field(default_factory=list[str])
    i2c: list[Answer] = field(default_factory=list[Answer])
    can: list[CanTraffic] = field(default_factory=list[CanTraffic])

    @property
    def missing(self) -> list[str]:
        return [a.declared for a in self.i2c if a.declared and not a.answered]

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "missing": self.missing}


def machine_ports() -> list[str]:
    """Serial ports, I2C buses and CAN interfaces of this machine."""
    patterns = ("/dev/ttyACM*", "/dev/ttyUSB*", "/dev/ttyAMA*", "/dev/i2c-*", "/sys/class/net/*can*")
    return sorted(path for pattern in patterns for path in glob.glob(pattern))


@dataclass(frozen=True)
class SerialPort:
    """A serial port of this machine and what its USB descriptor says of the device; empty when there is none."""

    path: str
    product: str


def serial_ports(root: Path = Path("/")) -> list[SerialPort]:
    """Serial ports with maker, product and serial number as USB told the system. Nothing is sent to a device.

    ``root`` has ``dev`` and ``sys`` in it.
    """
    ports: list[SerialPort] = []
    for pattern in ("ttyACM*", "ttyUSB*", "ttyAMA*"):
        for port in sorted((root / "dev").glob(pattern)):
            # .../usb1/1-2/1-2:1.0/ttyUSB0: the descriptor is one or two folders above the interface
            device = (root / "sys/class/tty" / port.name / "device").resolve()
            usb = next((p for p in (device, *device.parents[:3]) if (p / "idVendor").is_file()), None)
            words = [] if usb is None else [_descriptor(usb / name) for name in ("manufacturer", "product", "serial")]
            ports.append(SerialPort("/" + str(port.relative_to(root)), " ".join(w for w in words if w)))
    return ports


def _descriptor(file: Path) -> str:
    """Return a line of a USB descriptor. A device can write anything into it."""
    try:
        line = file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
    return "".join(c for c in line if c.isprintable())[:60]


def scan_bench(
    bench: OpenBench, probe: Probe, listen_s: float, progress: Callable[[str], None] = lambda _: None
) -> ScanResult:
    """Look at every I2C and CAN bus of an open bench. Nothing is written with the ``read`` probe."""
    result = ScanResult(probe, machine_ports())
    ops: list[I2cOp] = [I2cRead(1)] if probe == "read" else [I2cWrite(b"\0")]
    description = bench.file.description
    for name, spec in description.bus.items():
        if spec.kind == "i2c":
            progress(f"{name}: addresses 0x{FIRST:02X} to 0x{LAST:02X}")
            declared = {d.address: n for n, d in description.device.items() if d.bus == name and d.address}
            for address in range(FIRST, LAST + 1):
                answered = _answers(bench, name, address, ops)
                if answered or address in declared:
                    result.i2c.append(Answer(name, address, declared.get(address, ""), answered))
        elif spec.kind == "can":
            progress(f"{name}: listening for {listen_s:g} s")
            result.can += _listen(bench, name, listen_s)
    return result


def _answers(bench: OpenBench, bus: str, address: int, ops: list[I2cOp]) -> bool:
    try:
        bench.i2c(bus).transfer(address, ops)
    except HalError:
        return False
    return True


def _names() -> dict[int, str]:
    return {message.frame_id: message.name for message in getattr(load_database(), "messages", ())}


def _listen(bench: OpenBench, bus: str, listen_s: float) -> list[CanTraffic]:
    names, counts = _names(), dict[int, int]()
    end_ns = bench.clock.now_ns() + round(listen_s * 1e9)
    while (left_s := (end_ns - bench.clock.now_ns()) * 1e-9) > 0:
        frame = bench.can(bus).recv(min(left_s, 0.1))
        if frame is not None:
            counts[frame.can_id] = counts.get(frame.can_id, 0) + 1
    return [CanTraffic(bus, i, names.get(i, "?"), n, n / listen_s) for i, n in sorted(counts.items())]
