"""(k) Memory at ten times the length: peak resident size of a process of its own for each job, less the start."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

from benchmarks.row import Row

JOBS = {
    "step in a batch": (
        "from benchmarks.step_input import stages, scans; s = stages(); s.warm_up(); x = scans({n})",
        "s.run(x)",
        60_000,
    ),
    "closed loop": (
        "from tools.closed_loop.simulate import simulate; from hal.bench import load_bench; "
        "from tools.cli.bench_option import bench_path; b = load_bench(bench_path(None)); simulate(b, 0.5)",
        "simulate(b, {n} / 1000)",
        30_000,
    ),
    "replay": (
        "from benchmarks.world import recording_of, replay_recording; from pathlib import Path; import tempfile; "
        "d = tempfile.TemporaryDirectory(); r = recording_of({n} / 1000, Path(d.name) / 'r.mcap')",
        "replay_recording(r)",
        30_000,
    ),
    "Allan deviation": (
        "import numpy as np; from tools.noise.allan import allan_curve; "
        "x = np.random.default_rng(1).standard_normal({n}); allan_curve(x[:100], 1e3)",
        "allan_curve(x, 1e3)",
        180_000,
    ),
    "attitude filter": (
        "from benchmarks.attitude import signals, Fusion, FusionConfig; x = signals({n}); "
        "f = Fusion(FusionConfig(method='mahony'), 286.0); f.step(*(a[0] for a in x))",
        "f.run(*x)",
        60_000,
    ),
    "mismatch diagnose": (
        "from benchmarks.mismatch import stack_recording; "
        "from tools.mismatch.infer import diagnose; r = stack_recording({n} / 1000)",
        "diagnose(r, jobs=1)",
        15_000,
    ),
}
MEASURE = """
import resource
from pathlib import Path
def resident():
    return int(next(l for l in Path("/proc/self/status").read_text().splitlines() if l.startswith("VmHWM")).split()[1])
{setup}
Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
before = resident()
{job}
print(resident() - before)
"""


def peak_MB(job: str, n: int) -> float:
    """What the job needed beyond its input and the interpreter, MB."""
    setup, call, _ = JOBS[job]
    text = MEASURE.format(setup=setup.format(n=n), job=call.format(n=n))
    run = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    return int(run.stdout.split()[-1]) / 1024.0


def rows() -> Iterator[Row]:
    for job, (_, _, n) in JOBS.items():
        once, ten = peak_MB(job, n), peak_MB(job, 10 * n)
        yield Row(
            f"memory, {job}", f"peak beyond input and interpreter, {10 * n / 1000:g} k samples against a tenth", ten,
            once, "a tenth", "MB", ten / max(once, 0.1), "-", None,
        )  # fmt: skip
