"""Handles a request to run either instrument: the request itself, the bench opened for it, the loop's scheduling."""

from __future__ import annotations

import contextlib
import json
import signal
import tempfile
from collections.abc import Callable, Generator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from drivers.specs import check_devices
from firmware_py.machine.settings import read_machine
from firmware_py.machine.tree import Tree
from firmware_py.machine.workers import WORKER_PRIORITY
from firmware_py.scheduler.realtime import RealtimeConfig, RealtimeReport, realtime
from hal.bench import BenchFile, OpenBench, Port, SerialSpec, open_bench
from hal.clock import Pace, PacedClock
from hal.contracts import Clock
from hal.errors import Disconnected

LOOP_PRIORITY = 80


@dataclass(frozen=True)
class RunRequest:
    """Describes a run. ``hand_file`` may carry a part (``FILE#id``), which is why it is text."""

    bench: Path
    seconds: float
    pace: Pace | None = None
    """Pace at which bench time passes. None: paced where every bus is emulated, else real time."""
    hand_file: str | None = None
    hand_scale: float | None = None
    record: Path | None = None
    seed: int | None = None
    live_fds: tuple[int, int] | None = None
    """Memory and control socket of ``firmware_py.live``, inherited from the bench page's server."""
    stale_ms: float | None = None
    """Overrides the bench file's limit for missing or belated scans."""
    policy: bool = True
    """Asks, in real time, for a real-time policy, locked memory and no garbage collector. False is for comparison
    only."""
    compiled: bool = False
    """Runs the ticks in one compiled thread (``firmware_py.compiled``). Raises ``BenchError`` where a device cannot."""
    spin_us: float = 0.0
    """With ``compiled``: the thread waits awake from so long before each scan is expected until so long after."""
    cpu: int | None = None
    """In real time: the processor that the loop, and no other part of the run, stays on."""
    sense_only: bool = False
    """Runs without arming the outputs. Readings that would end a run are only noticed."""
    method: str | None = None
    """Overrides the bench file's tremor estimator."""
    truth_s: float | None = None
    """Length of the truth that an emulated world keeps. None: all of it."""
    clock_start_ns: int = 0
    """Start of the virtual clock. A late start crosses marks of time without waiting for them."""
    inject: tuple[str, ...] = ()
    """Faults on buses (``firmware_py.inject``)."""
    manual: Path | None = None
    """Program of voltages (``firmware_py.control.program``) that the outputs play in place of the compensation."""
    max_effect: int | None = None
    """Limit on how much the injected faults may disturb a real bench (scale of ``firmware_py.inject``)."""

    def to_json(self, runtime_dir: Path) -> str:
        """Return the request as JSON for the firmware's own process."""
        table = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(self).items()}
        return json.dumps({**table, "runtime_dir": str(runtime_dir)})


@contextlib.contextmanager
def open_requested(
    request: RunRequest,
    bench: BenchFile,
    runtime_dir: Path | None,
    wrap: Callable[[str, Port, Clock], Port] | None = None,
) -> Generator[OpenBench]:
    """Open the bench as the request says; without ``runtime_dir`` in a folder of its own.

    Raises ``BenchError`` for devices that cannot be together, before an emulated world is started or a port touched.
    """
    check_devices(bench.description, str(bench.path))
    with contextlib.ExitStack() as stack:
        folder = runtime_dir or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="micron-")))
        yield stack.enter_context(
            open_bench(
                bench,
                pace=request.pace,
                runtime_dir=folder,
                hand_file=Path(request.hand_file) if request.hand_file else None,
                hand_scale=request.hand_scale,
                seed=request.seed,
                truth_s=request.truth_s,
                start_ns=request.clock_start_ns,
                wrap=wrap,
            )
        )


def truth_of(opened: OpenBench) -> dict[str, Any] | None:
    """Stop the emulated world. Return its truth, or None where nothing is emulated or the world died."""
    if opened.world is None:
        return None
    opened.world.stop()
    with contextlib.suppress(Disconnected):
        return opened.world.truth()
    return None


@contextlib.contextmanager
def scheduling(request: RunRequest, opened: OpenBench) -> Generator[RealtimeReport]:
    """Apply real-time settings for the length of the block, in real time and unless the request does without."""
    if isinstance(opened.clock, PacedClock):
        opened.clock.begin()
    if opened.virtual or not request.policy:
        yield RealtimeReport()
        return
    config = RealtimeConfig(
        priority=LOOP_PRIORITY, cpu=request.cpu, idle_exit_us=0,
        worker_priority=WORKER_PRIORITY if has_ttys(opened.file) else None,
    )  # fmt: skip
    with realtime(config) as report:
        yield report


def has_ttys(bench: BenchFile) -> bool:
    """Return True if a bus of ``bench`` is a serial port, or CAN over one."""
    return any(isinstance(spec, SerialSpec) or "slcan" in spec.uri for spec in bench.description.bus.values())


def serial_ports(bench: BenchFile) -> list[str]:
    """Return the paths of the serial ports that the buses of ``bench`` name."""
    uris = [spec.uri.partition("://") for spec in bench.description.bus.values()]
    return [rest.split("?")[0] for scheme, _, rest in uris if scheme in ("serial", "slcan")]


def describe_machine(opened: OpenBench) -> list[dict[str, object]]:
    """Return, as JSON values, the machine's settings that a loop in real time depends on; none in emulated time."""
    if opened.virtual:
        return []
    return [state.as_dict() for state in read_machine(Tree(), serial_ports(opened.file))]


@contextlib.contextmanager
def count_interrupts() -> Generator[Callable[[], int]]:
    """Count SIGINT and SIGTERM beside the loop, which has handlers of its own, and ignore them after the block.

    For a process that is the firmware and nothing else: a run that ends is told to the end, with an outcome file.
    """
    count = 0

    def handle(_number: int, _frame: object) -> None:
        nonlocal count
        count += 1

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handle)
    yield lambda: count
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
