"""``python -m benchmarks.first_minute [--runs 50] [--busy 4]``: does the first command of the README always end well?

Starts ``--busy`` processes that compute without a pause, then ``micron run`` ``--runs`` times, and prints how many runs
ended with exit status 0 and with the same result tables. Not part of ``make bench``: 50 runs take about ten minutes.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from hal.children import child_command, child_environment

SAME = ("tremor", "voluntary", "samples", "commands", "latency", "safe_state", "holds", "noticed")
"""Parts of a run's JSON that must not depend on the machine. CPU times, the host and the pace may."""


def main() -> int:
    """Print the count; 0 when every run ended with 0 and with the same tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=50, help="how many runs")
    parser.add_argument("--busy", type=int, default=4, help="processes that compute beside them")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each run")
    chosen = parser.parse_args()
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(chosen.busy)]
    done, tables, walls = 0, list[str](), list[float]()
    try:
        for number in range(chosen.runs):
            code, table, wall_s = _run(chosen.seconds)
            done += code == 0
            tables.append(table)
            walls.append(wall_s)
            print(f"run {number + 1}: exit status {code}, {wall_s:.0f} s", file=sys.stderr, flush=True)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    same = sum(table == tables[0] for table in tables)
    print(f"{done} of {len(tables)} runs with exit status 0 beside {chosen.busy} busy processes")
    print(f"{same} of {len(tables)} runs with the result tables of the first")
    print(f"seconds of a run: {min(walls):.0f} to {max(walls):.0f}")
    return 0 if done == same == chosen.runs else 1


def _run(seconds: float) -> tuple[int, str, float]:
    """Exit status, the parts of the result that must not change, and wall-clock seconds of one run."""
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        result, picture = Path(folder) / "run.json", Path(folder) / "run.png"
        command = child_command("tools.cli.main", "run", "--seconds", str(seconds), "--json", str(result))
        ended = subprocess.run(
            [*command, "--picture", str(picture)], stderr=subprocess.DEVNULL, env=child_environment(), check=False
        )
        table: dict[str, Any] = json.loads(result.read_text()) if result.exists() else {}
    return ended.returncode, json.dumps({key: table.get(key) for key in SAME}), time.monotonic() - began_s


if __name__ == "__main__":
    sys.exit(main())
