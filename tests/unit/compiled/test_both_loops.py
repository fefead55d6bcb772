"""Both loops give the same bits on the same bytes: whole runs in virtual time, over socket pairs, with damage.

The thread takes a minute to compile.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from firmware_py.app import run_in_process
from firmware_py.compiled.loop import CompiledMicron
from firmware_py.compiled.memory import BEAT_LIMIT_NS
from firmware_py.recording.reader import Recording
from firmware_py.run_request import RunRequest
from hal.contracts import Clock
from hal.middleware.faults import FaultCan, FaultI2c, FaultPlan, FaultSerial
from tools.research.faults.carriers import SocketPort

BENCHES = Path(__file__).parents[3] / "benches"
SERIAL, DEFAULT, CAN = (BENCHES / f"{name}.toml" for name in ("micron-e727", "micron", "micron-can"))
SECONDS = 0.6
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


def run(
    folder: Path, plans: dict[str, FaultPlan], *, compiled: bool, bench: Path = SERIAL
) -> tuple[dict[str, Any], bytes, list[Any]]:
    """Return the outcome, the truth's bytes, and the recorded events and rows."""

    def wrap(bus: str, port: Any, clock: Clock) -> Any:
        if not hasattr(port, "drain_input"):
            sabotaged = FaultI2c if hasattr(port, "transfer") else FaultCan
            return sabotaged(port, clock, plans[bus]) if bus in plans else port
        return SocketPort(FaultSerial(port, clock, plans[bus]) if bus in plans else port)

    file = folder / f"{compiled}.mcap"
    file.unlink(missing_ok=True)
    request = RunRequest(bench, SECONDS, pace="virtual", record=file, compiled=compiled)
    outcome, truth = run_in_process(request, wrap=wrap)
    assert truth is not None
    recording = Recording(file)
    recorded = [recording.array(recording.names).tobytes(), [event.content for event in recording.events]]
    return outcome, b"".join(np.ascontiguousarray(truth[name]).tobytes() for name in sorted(truth)), recorded


def compare(folder: Path, plans: dict[str, FaultPlan], bench: Path = SERIAL) -> dict[str, Any]:
    """Run both; return the compiled one's outcome."""
    python, compiled = (run(folder, plans, compiled=c, bench=bench) for c in (False, True))
    assert compiled[1] == python[1]
    assert compiled[2] == python[2]
    for key in ("armed_ns", "safe_ns", "samples", "noticed", "commands", "holds", "warnings", "safe_state", "latency"):
        assert compiled[0][key] == python[0][key], key
    for name, task in python[0]["tasks"].items():
        for key in ("runs", "skipped", "errors"):
            assert compiled[0]["tasks"][name][key] == task[key], (name, key)
    for key in ("run", "caught_up", "skipped"):
        assert compiled[0]["ticks"][key] == python[0]["ticks"][key], key
    return compiled[0]


@pytest.mark.parametrize("bench", [SERIAL, DEFAULT, CAN], ids=lambda bench: bench.stem)
def test_a_quiet_run(tmp_path: Path, bench: Path):
    outcome = compare(tmp_path, {}, bench)
    assert outcome["loop"]["kind"] == "compiled"
    assert outcome["loop"]["ticks"] > 0.9 * 1000 * SECONDS
    assert outcome["safe_state"]["normal"]


@pytest.mark.parametrize("bench", [SERIAL, DEFAULT, CAN], ids=lambda bench: bench.stem)
def test_the_thread_ramps_alone_when_python_is_silent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: Path):
    """Python's heartbeat counts as stopped for one entry: neutral without Python, a hold, and on."""
    feed = CompiledMicron._feed  # pyright: ignore[reportPrivateUsage]
    commanded_V: list[list[float]] = []

    def feed_late(loop: CompiledMicron, last_due_ns: int) -> None:
        feed(loop, last_due_ns)
        words = loop._words  # pyright: ignore[reportPrivateUsage]
        if loop.entries == 200:
            words[BEAT_LIMIT_NS] = -1

    sync = CompiledMicron._sync  # pyright: ignore[reportPrivateUsage]

    def sync_and_look(loop: CompiledMicron) -> None:
        sync(loop)
        words = loop._words  # pyright: ignore[reportPrivateUsage]
        if words[BEAT_LIMIT_NS] < 0:
            commanded_V.append(list(loop.run.output.commanded_V))  # pyright: ignore[reportOptionalMemberAccess]
            words[BEAT_LIMIT_NS] = 100_000_000

    monkeypatch.setattr(CompiledMicron, "_feed", feed_late)
    monkeypatch.setattr(CompiledMicron, "_sync", sync_and_look)
    outcome, _, _ = run(tmp_path, {}, compiled=True, bench=bench)
    assert commanded_V == [[50.0, 50.0, 50.0]], "neutral before Python knows"
    assert [hold["finding"] for hold in outcome["holds"]] == ["supervision_silent"]
    assert outcome["safe_state"]["normal"]
    assert outcome["loop"]["ticks"] > 220, "the thread went on after the hold"


def scan_faults() -> st.SearchStrategy[FaultPlan]:
    rare = st.sampled_from([0.0, 0.0, 0.0001, 0.001])
    return st.builds(
        FaultPlan, seed=st.integers(0, 1000), loss=rare, corruption=rare, duplication=rare,
        truncation=st.sampled_from([0.0, 0.01]), delay=st.sampled_from([0.0, 0.05]),
        delay_s=st.sampled_from([0.0005, 0.003, 0.02]), from_s=st.sampled_from([0.7, 0.9]),
    )  # fmt: skip


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(plan=scan_faults())
@example(FaultPlan(duplication=0.0001, delay=0.05, delay_s=0.003, from_s=0.7))  # bytes without a scan until silence
def test_losses_splits_and_damage_of_scans(tmp_path: Path, plan: FaultPlan):
    compare(tmp_path, {"daq0": plan})


@pytest.mark.parametrize(
    ("bus", "plan"),
    [
        ("daq0", FaultPlan(silent_after_s=0.9, silent_for_s=0.1)),
        ("daq0", FaultPlan(disconnect_after_s=0.9)),
        ("e7270", FaultPlan(seed=3, corruption=0.2, from_s=0.8)),
        ("e7270", FaultPlan(silent_after_s=0.8)),
        ("e7270", FaultPlan(disconnect_after_s=0.9)),
        ("e7270", FaultPlan(full_after_s=0.8)),
        ("e7270", FaultPlan(full_after_s=0.8, full_for_s=0.1)),
    ],
)
def test_ports_that_fail(tmp_path: Path, bus: str, plan: FaultPlan):
    compare(tmp_path, {bus: plan})


@pytest.mark.parametrize(
    "plan",
    [
        FaultPlan(seed=3, loss=0.02, from_s=0.7),
        FaultPlan(seed=3, corruption=0.02, from_s=0.7),
        FaultPlan(seed=3, delay=0.05, delay_s=0.001, from_s=0.7),
        FaultPlan(delay=1.0, delay_s=0.001, from_s=0.7),  # what is put off in a tick waits for the next one
        FaultPlan(delay=1.0, delay_s=0.5, from_s=0.9, for_s=0.001),  # one transfer blocks
        FaultPlan(silent_after_s=0.9, silent_for_s=0.1),
        FaultPlan(disconnect_after_s=0.9),
    ],
)
def test_transfers_that_fail(tmp_path: Path, plan: FaultPlan):
    compare(tmp_path, {"i2c0": plan}, DEFAULT)


@pytest.mark.parametrize(
    "plan",
    [
        FaultPlan(seed=3, loss=0.3, corruption=0.1, from_s=0.7),
        FaultPlan(seed=3, truncation=0.2, duplication=0.2, reorder=0.2, from_s=0.7),
        FaultPlan(babble_hz=4000.0, from_s=0.7),
        FaultPlan(silent_after_s=0.8),
        FaultPlan(bus_off_after_s=0.8),
        FaultPlan(full_after_s=0.8),
        FaultPlan(full_after_s=0.8, full_for_s=0.05),
        FaultPlan(disconnect_after_s=0.9),
    ],
)
def test_frames_that_fail(tmp_path: Path, plan: FaultPlan):
    compare(tmp_path, {"can0": plan}, CAN)
