"""Machine settings on trees of /dev, /proc and /sys that the tests make: read, explained, set; never this machine's."""

from __future__ import annotations

import json
import os
import struct
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.machine.attendant import attend, attend_workers
from firmware_py.machine.processors import format_processors, parse_processors
from firmware_py.machine.settings import SETTINGS, MachineState, read_machine, set_machine
from firmware_py.machine.tree import DMA_LATENCY, Tree, hold_latency_limit, read_latency_limit_us
from firmware_py.machine.workers import (
    NAME,
    WORKER_PRIORITY,
    has_attendant,
    has_ordinary_workers,
    lower_workers,
    may_raise,
    raise_workers,
)
from firmware_py.scheduler import RealtimeConfig, realtime
from tests.command import micron
from tools.diagnose.findings import setting_findings

CPUS = "sys/devices/system/cpu"
USB = "sys/devices/pci0000:00/usb1/1-2"
NO_LIMIT = 2_000_000_000
LAB = {
    f"{CPUS}/isolated": "3\n",
    f"{CPUS}/nohz_full": "(null)\n",
    f"{CPUS}/online": "0-3\n",
    f"{CPUS}/cpu0/cpufreq/scaling_governor": "powersave\n",
    f"{CPUS}/cpu1/cpufreq/scaling_governor": "powersave\n",
    f"{CPUS}/cpu10/cpufreq/scaling_governor": "performance\n",
    "proc/irq/9/smp_affinity_list": "0-3\n",
    "proc/irq/30/smp_affinity_list": "0-2\n",
    "proc/sys/kernel/sched_rt_runtime_us": "500000\n",
    "proc/sys/kernel/sched_rt_period_us": "1000000\n",
    "proc/sys/kernel/version": "#1 SMP PREEMPT_DYNAMIC Debian 6.1\n",
    "proc/12/comm": "kworker/u8:0-events_unbound\n",
    "proc/12/stat": "12 (kworker/u8:0-ev) I 2 0" + " 0" * 34 + " 0 0 0\n",
    "proc/13/comm": "kworker/0:1\n",
    "proc/self/status": "Name:\tpython\nCapEff:\t0000000000000000\n",
    f"{USB}/idVendor": "0403\n",
    f"{USB}/power/control": "auto\n",
    f"{USB}/1-2:1.0/ttyUSB0/latency_timer": "16\n",
    f"{USB}/1-2:1.0/ttyUSB0/tty/ttyUSB0/dev": "188:0\n",
    "dev/ttyUSB0": "",
}


@pytest.fixture
def lab(tmp_path: Path) -> Tree:
    """A machine of four processors, of which 3 is isolated, with an FTDI adapter."""
    for name, text in LAB.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    (tmp_path / DMA_LATENCY).write_bytes(struct.pack("=i", NO_LIMIT))
    for link, to in (
        ("sys/class/tty/ttyUSB0", f"{USB}/1-2:1.0/ttyUSB0/tty/ttyUSB0"),
        ("sys/bus/usb-serial/devices/ttyUSB0", f"{USB}/1-2:1.0/ttyUSB0"),
        ("dev/micron-daq", "dev/ttyUSB0"),
    ):
        (tmp_path / link).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / link).symlink_to(tmp_path / to)
    return Tree(tmp_path)


def states(tree: Tree, *ports: str) -> dict[str, MachineState]:
    return {state.setting.name: state for state in read_machine(tree, ports)}


def test_each_setting_is_read_and_judged(lab: Tree):
    found = {name: (state.describe(), state.is_good) for name, state in states(lab).items()}
    assert found == {
        "idle states": ("no limit, but a run holds it at 0 us", True),
        "workers of ttys": ("ordinary priority", False),
        "isolated processors": ("processor 3", True),
        "processors without a tick": ("none", False),
        "interrupts": ("0-3: irq 9; 0-2: irq 30", False),
        "share of real-time tasks": ("50 % of a processor", False),
        "governor": ("powersave: cpu0, cpu1; performance: cpu10", False),
        "USB autosuspend": ("auto", False),
        "FTDI latency timer": ("16 ms", False),
        "preemption": ("PREEMPT_DYNAMIC", False),
    }


def test_a_machine_without_any_of_it_needs_nothing(tmp_path: Path):
    found = read_machine(Tree(tmp_path))
    assert len(found) == len(SETTINGS)
    assert all(state.is_good and not state.readings for state in found)
    assert {f.verdict for f in setting_findings(Tree(tmp_path))} == {"ok"}
    assert set_machine(Tree(tmp_path)) == []


def test_what_is_not_as_wanted_is_explained_and_has_a_remedy(lab: Tree):
    for finding in setting_findings(lab):
        state = states(lab)[finding.part]
        assert (finding.verdict == "ok") is state.is_good
        if not state.is_good:
            assert state.setting.explain in finding.remedy
            assert ("micron doctor --set" in finding.remedy) is (state.setting.lasts == "boot")


def test_what_may_be_set_is_set_and_nothing_else(lab: Tree):
    before = {name: (lab.root / name).read_bytes() for name in [*LAB, DMA_LATENCY]}
    changes = set_machine(lab)
    assert not any(change.failure for change in changes)
    assert [(change.what, change.before) for change in changes] == [
        ("irq 9", "0-3"), ("sched_rt_runtime_us", "50 % of a processor"), ("cpu0", "powersave"), ("cpu1", "powersave"),
        ("ttyUSB0", "auto"), ("ttyUSB0", "16 ms"),
    ]  # fmt: skip
    assert lab.read("proc/irq/9/smp_affinity_list") == "0-2"
    assert lab.read("proc/sys/kernel/sched_rt_runtime_us") == "950000"
    assert lab.read(f"{CPUS}/cpu0/cpufreq/scaling_governor") == "performance"
    assert lab.read(f"{USB}/power/control") == "on"
    assert lab.read(f"{USB}/1-2:1.0/ttyUSB0/latency_timer") == "1"
    assert set_machine(lab) == []
    changed = {name for name, data in before.items() if (lab.root / name).read_bytes() != data}
    was = ("0-3", "500000", "powersave", "auto", "16")
    assert changed == {name for name, text in LAB.items() if text.strip() in was and "online" not in name}


def test_a_setting_that_is_refused_is_a_change_with_a_reason(lab: Tree, monkeypatch: pytest.MonkeyPatch):
    def refuse(tree: Tree, name: str, text: str) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Tree, "write", refuse)
    changes = set_machine(lab)
    assert len(changes) == 6
    assert {change.failure for change in changes} == {"Permission denied"}
    assert lab.read(f"{USB}/power/control") == "auto"


def test_the_ports_of_a_bench_are_looked_at_alone(lab: Tree):
    other = f"{USB}9/power/control"
    (lab.root / other).parent.mkdir(parents=True)
    (lab.root / other).write_text("auto\n")
    (lab.root / f"{USB}9/idVendor").write_text("1a86\n")
    (lab.root / "sys/class/tty/ttyACM0").symlink_to(lab.root / f"{USB}9")
    assert len(states(lab)["USB autosuspend"].readings) == 2
    named = states(lab, "/dev/micron-daq")  # by a link that a udev rule made
    assert [r.what for r in named["USB autosuspend"].readings] == ["ttyUSB0"]
    assert [r.what for r in named["FTDI latency timer"].readings] == ["ttyUSB0"]
    assert states(lab, "/dev/ttyS0")["USB autosuspend"].readings == ()


@pytest.mark.parametrize(
    ("runtime", "value", "is_good"),
    [("-1", "no limit", True), ("950000", "95 % of a processor", True), ("100000", "10 % of a processor", False)],
)
def test_the_share_of_real_time_tasks(lab: Tree, runtime: str, value: str, is_good: bool):
    (lab.root / "proc/sys/kernel/sched_rt_runtime_us").write_text(runtime)
    state = states(lab)["share of real-time tasks"]
    assert (state.describe(), state.is_good) == (value, is_good)


def test_what_the_kernel_writes_without_sense_is_not_there(lab: Tree):
    (lab.root / "proc/sys/kernel/sched_rt_runtime_us").write_text("no number")
    (lab.root / DMA_LATENCY).write_bytes(b"x")
    assert states(lab)["share of real-time tasks"].readings == ()
    assert states(lab)["idle states"].readings == ()


def open_files() -> set[str]:
    return {str(Path(f"/proc/self/fd/{fd}").resolve()) for fd in os.listdir("/proc/self/fd")}


def test_the_latency_limit_is_held_until_it_is_let_go(lab: Tree):
    let_go = hold_latency_limit(lab, 0)
    assert str(lab.root / DMA_LATENCY) in open_files()
    assert read_latency_limit_us(lab) == 0
    let_go()
    assert str(lab.root / DMA_LATENCY) not in open_files()
    with pytest.raises(OSError, match="No such file"):
        hold_latency_limit(Tree(lab.root / "nowhere"), 0)


def test_a_run_reports_idle_states_as_one_of_its_settings(lab: Tree):
    off = RealtimeConfig(priority=None, lock_memory=False, timer_slack_ns=None, freeze_gc=False, idle_exit_us=0)
    with realtime(off, lab) as report:
        assert report["idle_states"].done
        assert report["idle_states"].wanted == "idle states off"
        assert read_latency_limit_us(lab) == 0
    (lab.root / DMA_LATENCY).unlink()
    with realtime(off, lab) as report:
        assert not report["idle_states"].done


class Policies:
    """Stands for the kernel's table of scheduling policies and their priorities."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, table: dict[int, tuple[int, int]]) -> None:
        self.table = table
        monkeypatch.setattr(os, "sched_getscheduler", lambda pid: self.get(pid)[0])
        monkeypatch.setattr(os, "sched_getparam", lambda pid: os.sched_param(self.get(pid)[1]))
        monkeypatch.setattr(os, "sched_setscheduler", self.set)

    def get(self, pid: int) -> tuple[int, int]:
        if pid not in self.table:
            raise ProcessLookupError(3, "No such process")
        return self.table[pid]

    def set(self, pid: int, policy: int, param: os.sched_param) -> None:
        self.get(pid)
        self.table[pid] = policy, param.sched_priority


def add_processes(lab: Tree, **names: str) -> None:
    for pid, name in names.items():
        (lab.root / f"proc/{pid[1:]}").mkdir()
        (lab.root / f"proc/{pid[1:]}/comm").write_text(f"{name}\n")


def test_workers_of_ttys_are_raised_and_those_of_a_killed_run_lowered_as_well(
    lab: Tree, monkeypatch: pytest.MonkeyPatch
):
    add_processes(lab, p14="kworker/u8:14", p15="kworker/u8:15", p16="kworker/u8:16", p17="kworker/u8:17")
    other, fifo = (os.SCHED_OTHER, 0), (os.SCHED_FIFO, WORKER_PRIORITY)
    somebodys = os.SCHED_FIFO, 50
    # a killed run has left 14, somebody else has raised 17, and the kernel has ended 16
    policies = Policies(monkeypatch, {12: other, 13: other, 14: fifo, 15: other, 17: somebodys})
    raise_workers(lab, WORKER_PRIORITY)
    assert policies.table == {12: fifo, 13: other, 14: fifo, 15: fifo, 17: somebodys}
    del policies.table[15]
    lower_workers(lab, WORKER_PRIORITY)
    assert policies.table == {12: other, 13: other, 14: other, 17: somebodys}


@pytest.mark.parametrize("others", [False, True])
def test_the_attendant_lowers_them_when_the_last_run_is_over(lab: Tree, monkeypatch: pytest.MonkeyPatch, others: bool):
    add_processes(lab, **{f"p{os.getpid()}": NAME}, **({"p77": NAME} if others else {}))
    raised = os.SCHED_FIFO, WORKER_PRIORITY
    policies = Policies(monkeypatch, {12: raised})
    ours, runs = os.pipe()
    os.close(runs)  # what the kernel does when the run dies
    attend(lab, WORKER_PRIORITY, ours)
    os.close(ours)
    assert policies.table == {12: raised if others else (os.SCHED_OTHER, 0)}


@pytest.mark.realtime
def test_the_attendant_ends_with_its_run():
    """The process is there while the block lasts, where this user may have it."""
    if not may_raise(Tree()):
        pytest.skip("needs the capability CAP_SYS_NICE")
    end = attend_workers(WORKER_PRIORITY)
    assert has_attendant(Tree())
    end()


def test_what_a_killed_run_has_left_is_told(lab: Tree):
    stat = lab.root / "proc/12/stat"
    stat.write_text(stat.read_text().replace(" 0 0 0\n", f" {WORKER_PRIORITY} 1 0\n"))
    assert "a killed run has left" in states(lab)["workers of ttys"].describe()
    assert not states(lab)["workers of ttys"].is_good
    add_processes(lab, p77=NAME)
    assert states(lab)["workers of ttys"].describe() == "real-time priority"


def test_raised_workers_are_told_from_ordinary_ones(lab: Tree):
    stat = lab.root / "proc/12/stat"
    assert has_ordinary_workers(lab)
    stat.write_text(stat.read_text().replace(" 0 0 0\n", " 60 1 0\n"))
    assert not has_ordinary_workers(lab)
    assert states(lab)["workers of ttys"].is_good


def test_who_may_raise_them_is_read_from_the_capabilities(lab: Tree):
    (lab.root / "proc/self/status").write_text("CapEff:\t0000000000800000\n")
    assert states(lab)["workers of ttys"].describe() == "ordinary priority, but a run raises it"


def test_a_run_that_may_not_raise_them_says_so(monkeypatch: pytest.MonkeyPatch):
    def refuse(_priority: int) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(sys.modules["firmware_py.scheduler.realtime"], "attend_workers", refuse)
    asked = RealtimeConfig(priority=None, lock_memory=False, timer_slack_ns=None, freeze_gc=False, worker_priority=70)
    with realtime(asked) as report:
        assert not report["tty_workers"].done
        assert "CAP_SYS_NICE" in report["tty_workers"].detail


def test_doctor_shows_and_sets_another_tree(lab: Tree):
    def doctor(*more: str) -> dict:
        done = micron("doctor", "--root", lab.root, "--json", "-", *more)
        assert done.exit_code == 0, done.output
        return json.loads(done.stdout)

    verdicts = {f["part"]: f["verdict"] for f in doctor()["findings"]}
    assert (verdicts["governor"], verdicts["isolated processors"]) == ("limited", "ok")
    result = doctor("--set")
    assert len(result["set"]) == 6
    assert {f["part"]: f["verdict"] for f in result["findings"]}["governor"] == "ok"
    assert micron("doctor", "--root", lab.root / "nowhere").exit_code == 2


@given(st.sets(st.integers(0, 255)))
def test_lists_of_processors_come_back(numbers: set[int]):
    assert parse_processors(format_processors(sorted(numbers))) == sorted(numbers)


@pytest.mark.parametrize("text", [None, "", "(null)", "\n"])
def test_an_empty_list_of_processors(text: str | None):
    assert parse_processors(text) == []
