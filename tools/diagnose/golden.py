"""Makes golden transcripts: all traffic of every bus while the firmware's drivers opened a bench and scanned for a
while, and what differs when the same is done again with today's drivers, or said again to the emulated devices.

A folder with one transcript per bus (``hal.middleware.trace``) and ``golden.json``: bench text, scan time, clock.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from firmware_py.control.wiring import open_devices
from hal.bench import OpenBench, load_bench
from hal.clock import Pace, VirtualClock
from hal.contracts import Clock
from hal.errors import HalError
from hal.middleware.trace import Entry, TraceCan, TraceI2c, TraceSerial, read_transcript
from hal.types import I2cOp, I2cRead, I2cWrite
from tools.diagnose.golden_ports import Divergence, replay_port
from tools.diagnose.opened import opened_bench
from tools.errors import InputError

SUFFIX = ".transcript"
MAX_SHOWN = 20
QUIET_NS = 50_000_000
STREAM_SLACK_BYTES = 64


@dataclass(frozen=True)
class Difference:
    """Describes where two sides differ. ``kind``: protocol (other length, no answer, other question) or data (other
    values)."""

    bus: str
    side: str
    entry: int
    kind: str
    recorded: str
    found: str


@dataclass(frozen=True)
class GoldenReport:
    """``compared`` transfers on both sides; at most ``MAX_SHOWN`` differences a bus and side are kept, all counted."""

    compared: int
    differences: tuple[Difference, ...]
    protocol: int
    data: int

    @property
    def same(self) -> bool:
        """Values of a live measurement may differ; how it is asked for and answered may not."""
        return self.protocol == 0

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "same": self.same}


def run_scenario(bench: OpenBench, seconds: float) -> None:
    """Run the scenario of every transcript: open and probe all devices, scan for ``seconds``, stop. Nothing is
    armed."""
    devices = open_devices(bench)
    rows = np.zeros((1024, len(devices.scan.channels)), dtype=np.int16)
    devices.daq.start()
    end_ns = bench.clock.now_ns() + round(seconds * 1e9)
    while bench.clock.now_ns() < end_ns:
        devices.daq.read_scans(rows, 0.1)
    devices.daq.stop()


def capture(bench_file: Path, out: Path, seconds: float, *, pace: Pace | None) -> dict[str, int]:
    """Record the scenario on ``bench_file`` into the new folder ``out``; lines per bus. Raises ``HalError``."""
    out.mkdir(parents=True)
    counts: dict[str, int] = {}
    with ExitStack() as files, opened_bench(bench_file, pace=pace) as bench:
        for name, spec in bench.file.description.bus.items():
            sink = files.enter_context((out / f"{name}{SUFFIX}").open("w", encoding="ascii"))
            bench.ports[name] = _traced(bench, name, spec.kind, sink)
        run_scenario(bench, seconds)
        text, kinds = bench.file.text, {n: s.kind for n, s in bench.file.description.bus.items()}
    facts = {"format": 1, "bench": text, "bench_file": str(bench_file.resolve()), "seconds": seconds, "kinds": kinds}
    (out / "golden.json").write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    for name in kinds:
        counts[name] = len(_entries(out, name))
    return counts


def _traced(bench: OpenBench, name: str, kind: str, sink: TextIO) -> Any:
    if kind == "serial":
        return TraceSerial(bench.serial(name), bench.clock, sink)
    if kind == "i2c":
        return TraceI2c(bench.i2c(name), bench.clock, sink)
    return TraceCan(bench.can(name), bench.clock, sink)


def _facts(folder: Path) -> dict[str, Any]:
    try:
        facts = json.loads((folder / "golden.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{folder}/golden.json: no transcript ({why}); make one with 'micron capture'") from error
    if not isinstance(facts, dict) or facts.get("format") != 1:
        raise InputError(f"{folder}/golden.json: format must be 1")
    return facts


def _entries(folder: Path, bus: str) -> list[Entry]:
    path = folder / f"{bus}{SUFFIX}"
    try:
        return read_transcript(path.read_text(encoding="ascii").splitlines())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def diff(folder: Path, bench_file: Path | None = None) -> GoldenReport:
    """Replay a golden transcript against today's drivers and against the emulated devices (virtual time)."""
    facts = _facts(folder)
    bench_path = bench_file or Path(facts["bench_file"])
    entries = {bus: _entries(folder, bus) for bus in facts["kinds"]}
    differences = _against_driver(bench_path, entries, facts)
    with opened_bench(bench_path, pace="virtual") as bench:
        for bus, kind in facts["kinds"].items():
            if kind == "i2c":
                differences += _i2c_against_emulator(bench, bus, entries[bus])
            elif kind == "serial":
                differences += _serial_against_emulator(bench, bus, entries[bus])
    compared = sum(len(e) for e in entries.values())
    protocol = sum(d.kind == "protocol" for d in differences)
    selected: list[Difference] = []
    for bus, side in sorted({(d.bus, d.side) for d in differences}):
        selected += [d for d in differences if (d.bus, d.side) == (bus, side)][:MAX_SHOWN]
    return GoldenReport(compared, tuple(selected), protocol, len(differences) - protocol)


def _against_driver(bench_path: Path, entries: dict[str, list[Entry]], facts: dict[str, Any]) -> list[Difference]:
    """The drivers talk to the transcript: do they still ask what they asked?"""
    clock: Clock = VirtualClock()
    file = load_bench(bench_path)
    log: list[Divergence] = []
    ports = {bus: replay_port(bus, kind, entries[bus], clock, log) for bus, kind in facts["kinds"].items()}
    bench = OpenBench(file, clock, ports, None, bench_path.parent)
    differences: list[Difference] = []
    try:
        run_scenario(bench, float(facts["seconds"]))
    except HalError as error:
        if not log:
            differences.append(Difference("", "driver", -1, "protocol", "the scenario ran", str(error)))
    return differences + [Difference(d.bus, "driver", d.entry, "protocol", d.recorded, d.found) for d in log]


def _i2c_against_emulator(bench: OpenBench, bus: str, entries: list[Entry]) -> list[Difference]:
    """Every recorded transfer again, at its time."""
    port, differences = bench.i2c(bus), list[Difference]()
    start_ns = bench.clock.now_ns()
    for number, entry in enumerate(entries):
        bench.clock.sleep_until_ns(start_ns + entry.t_ns)
        words, failed = list(entry.words), "!" in entry.words
        segments = words[1 : words.index("!")] if failed else words[1:]
        ops: list[I2cOp] = [
            I2cWrite(bytes.fromhex(w[1:])) if w[0] == "w" else I2cRead(len(w[1:]) // 2) for w in segments
        ]
        recorded = "" if failed else "".join(w[1:] for w in segments if w[0] == "r")
        try:
            answer = port.transfer(int(words[0], 16), ops).hex()
        except HalError as error:
            if not failed:
                differences.append(Difference(bus, "emulator", number, "protocol", " ".join(words), f"failed: {error}"))
            continue
        if failed:
            differences.append(Difference(bus, "emulator", number, "protocol", " ".join(words), f"answered {answer}"))
        elif answer != recorded:
            differences.append(Difference(bus, "emulator", number, "data", recorded, answer))
    return differences


def _serial_against_emulator(bench: OpenBench, bus: str, entries: list[Entry]) -> list[Difference]:
    """Everything that the host wrote again, at its time; what came back between two writes is compared."""
    port, differences, buf = bench.serial(bus), list[Difference](), memoryview(bytearray(65536))
    start_ns = bench.clock.now_ns()
    exchanges: list[tuple[int, int, bytes, bytes]] = []
    for number, entry in enumerate(entries):
        data = bytes.fromhex(entry.words[0])
        if entry.verb == "w":
            exchanges.append((number, entry.t_ns, data, b""))
        elif exchanges:
            n, t_ns, asked, answer = exchanges[-1]
            exchanges[-1] = (n, t_ns, asked, answer + data)
    for i, (number, t_ns, asked, recorded) in enumerate(exchanges):
        bench.clock.sleep_until_ns(start_ns + t_ns)
        port.write(asked, 1.0)
        # an answer may be a little later than it was then; the next question waits for it
        next_ns = start_ns + exchanges[i + 1][1] if i + 1 < len(exchanges) else 0
        end_ns = max(next_ns, bench.clock.now_ns()) + QUIET_NS
        answer = b""
        while bench.clock.now_ns() < end_ns and len(answer) < len(recorded):
            n = port.read_into(buf, max(1e-4, (end_ns - bench.clock.now_ns()) * 1e-9))
            answer += bytes(buf[:n])
        answer = answer[: len(recorded)]
        if answer != recorded:
            differences.append(
                Difference(
                    bus, "emulator", number, _kind(recorded, answer), _short(asked, recorded), _short(asked, answer)
                )
            )
    return differences


def _kind(recorded: bytes, answer: bytes) -> str:
    """Text must be the same; of a binary stream the amount must be about the same."""
    if _is_text(recorded):
        return "protocol"
    return "data" if abs(len(recorded) - len(answer)) <= max(STREAM_SLACK_BYTES, len(recorded) // 10) else "protocol"


def _is_text(data: bytes) -> bool:
    return bool(data) and all(32 <= b < 127 or b in (0, 9, 10, 13) for b in data)


def _short(asked: bytes, answer: bytes) -> str:
    text = answer[:40].decode("ascii", "replace") if _is_text(answer) else answer[:24].hex()
    return f"{asked[:24]!r} -> {text!r} ({len(answer)} bytes)"
