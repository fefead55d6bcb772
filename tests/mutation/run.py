"""Does a test fail when a line of what must not be wrong is changed? ``python -m tests.mutation.run [GROUP ...]``.

mutmut changes one expression at a time and runs the tests that reach it. A group is a few files with the tests that
are about them, and nothing else: each runs in a copy of the tree under ``out/mutation/GROUP``. The table goes to
standard output, what no test noticed to ``out/mutation/survivors.diff``: read it, and write the test that is missing.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
OUT = ROOT / "out" / "mutation"
PACKAGES = ("hal", "drivers", "firmware_py", "sim_devices", "tools", "benches", "tests")
# mutmut's exit codes of the run of one mutant's tests (mutmut.stats); a time limit is a test that noticed
SURVIVED, UNREACHED = 0, 33

GROUPS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "scheduler": (
        tuple(f"firmware_py/scheduler/{name}.py" for name in ("scheduler", "ticker", "task", "background", "check")),
        (
            "tests/virtual_time/test_scheduler.py",
            "tests/virtual_time/test_scheduler_counts.py",
            "tests/virtual_time/test_waiting_tasks.py",
            "tests/virtual_time/test_tickers.py",
            "tests/virtual_time/test_background.py",
        ),
    ),
    "safety": (("firmware_py/run/safety.py",), ("tests/unit/control/test_safety.py",)),
    "guardian": (
        tuple(
            f"firmware_py/guardian/{name}.py" for name in ("amplifier", "gate", "guardian", "heartbeat", "lifecycle")
        ),
        ("tests/unit/guardian",),
    ),
    "outputs": (("drivers/output_guard.py",), ("tests/unit/drivers/test_output_guard.py",)),
    "daq": (
        ("drivers/daq/di4108.py",),
        ("tests/wire/drivers/test_di4108_wire.py", "tests/wire/drivers/test_di4108_edges.py"),
    ),
    "e727": (
        ("drivers/piezo/gcs.py",),
        ("tests/wire/drivers/test_gcs_link.py", "tests/wire/drivers/test_e727_wire.py"),
    ),
    "can": (("drivers/can_frames.py", "drivers/can_telemetry.py"), ("tests/wire/drivers/test_can_drivers_wire.py",)),
    "motion card": (
        ("drivers/motion_card_protocol.py",),
        ("tests/wire/drivers/test_motion_card_wire.py", "tests/wire/drivers/test_motion_card_edges.py"),
    ),
}


def prepare(name: str, folder: Path) -> None:
    """A copy of the tree in ``folder`` with mutmut's settings for one group."""
    files, tests = GROUPS[name]
    shutil.rmtree(folder, ignore_errors=True)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    settings = {
        "source_paths": ["hal", "drivers", "firmware_py"],
        "only_mutate": list(files),
        "also_copy": ["sim_devices", "tools", "benches"],
        # one order for all mutants; a mutant may leave a thread or a file behind that would be warned of
        "pytest_add_cli_args": ["-p", "no:randomly", "-p", "no:xdist", "-p", "no:cacheprovider", "-W", "default"],
        "pytest_add_cli_args_test_selection": list(tests),
        "use_git_change_detection": False,
    }
    lines = "\n".join(f"{key} = {json.dumps(value)}" for key, value in settings.items())
    (folder / "pyproject.toml").write_text(f"{project}\n[tool.mutmut]\n{lines}\n", encoding="utf-8")


def mutate(folder: Path, processes: int, seconds: float | None) -> dict[str, dict[str, int | None]]:
    """Exit code of each mutant by file, None where ``seconds`` ended before it, and ``run.log``.

    Raises SystemExit where mutmut itself failed. What an earlier run in ``folder`` has tried is not tried again.
    """
    command = [str(Path(sys.executable).with_name("mutmut")), "run", "--max-children", str(processes)]
    with (folder / "run.log").open("w") as log:
        process = subprocess.Popen(
            command, cwd=folder, env=_environment(), stdout=log, stderr=log, start_new_session=True
        )
        try:
            failed = process.wait(seconds) != 0
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            failed = False
    found = {
        str(meta.relative_to(folder / "mutants").with_suffix("")): json.loads(meta.read_text())["exit_code_by_key"]
        for meta in sorted((folder / "mutants").rglob("*.py.meta"))
    }
    if failed or not found:
        raise SystemExit(f"mutmut did not finish; see {folder / 'run.log'}")
    return found


def diffs_of(folder: Path, mutants: list[str]) -> list[str]:
    """One text a mutant: its name and what it changed."""
    script = (
        "import sys; from mutmut.mutation.diff_apply import get_diff_for_mutant as of\n"
        "for name in sys.argv[1:]: print('# ' + name, of(name), sep='\\n', end='\\0')"
    )
    command = [sys.executable, "-c", script, *mutants]
    done = subprocess.run(command, cwd=folder, env=_environment(), capture_output=True, text=True, check=True)
    return done.stdout.split("\0")[:-1]


def is_wording(diff: str) -> bool:
    """Whether only the text between quotation marks was changed: the wording of a message, in nearly all cases."""
    without = [re.sub(r'"[^"]*"', '""', line) for line in diff.splitlines() if line[:3] not in ("---", "+++")]
    gone, come = ([line[1:] for line in without if line.startswith(sign)] for sign in "-+")
    return gone == come


def _environment() -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"of: {', '.join(GROUPS)}; default: all")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seconds", type=float, help="end each group after so long; the rest with --resume")
    parser.add_argument("--resume", action="store_true", help="go on where a run of the same tree was ended")
    chosen = parser.parse_args()
    unknown = [name for name in chosen.groups if name not in GROUPS]
    if unknown:
        parser.error(f"no group {', '.join(unknown)}; there are: {', '.join(GROUPS)}")
    OUT.mkdir(parents=True, exist_ok=True)
    print(
        "| group | file | mutants | tried | noticed | not noticed | of them wording |\n" + "|---" * 7 + "|", flush=True
    )
    survivors: list[str] = []
    total: Counter[str] = Counter()
    for name in chosen.groups or GROUPS:
        folder = OUT / name.replace(" ", "_")
        if not (chosen.resume and folder.is_dir()):
            prepare(name, folder)
        for file, codes in mutate(folder, chosen.processes, chosen.seconds).items():
            left = [mutant for mutant, code in codes.items() if code in (SURVIVED, UNREACHED)]
            diffs = diffs_of(folder, left)
            wording = sum(map(is_wording, diffs))
            tried = sum(code is not None for code in codes.values())
            counts = {
                "mutants": len(codes),
                "tried": tried,
                "noticed": tried - len(left),
                "left": len(left),
                "wording": wording,
            }
            total += Counter(counts)
            print(f"| {name} | `{file}` | {' | '.join(map(str, counts.values()))} |", flush=True)
            survivors += sorted(diffs, key=is_wording)
    print(f"| all | | {' | '.join(map(str, total.values()))} |")
    (OUT / "survivors.diff").write_text("\n".join(survivors), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
