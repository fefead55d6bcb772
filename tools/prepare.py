"""Compiles for the first run on a machine: two processes at a time, with a progress bar.

Kernels are kept on disk (``hal.compiled``), so this happens once per version and machine. A marker beside them, named
after the sources that they come from, says that it has been done.
"""

from __future__ import annotations

import contextlib
import hashlib
import selectors
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from hal.bench import BenchFile
from hal.children import child_command, child_environment

WAVES: tuple[tuple[str, ...], ...] = (("instrument", "tremor"), ("step",))
"""Parts that are compiled beside each other. The step needs the others' stages and is compiled last."""
EXPECTED: Mapping[str, int] = {"instrument": 79, "tremor": 64, "step": 7}
"""Kernels that numba compiles for each part: the scale of the progress bar and nothing else."""


def prepare(bench: BenchFile, method: str | None, console: Console) -> None:
    """Compile what a run of ``bench`` needs, unless this machine has it. The run itself reports what fails here."""
    from hal.compiled import user_cache

    marker = user_cache() / f"prepared-{_fingerprint(bench, method)}"
    if marker.exists():
        return
    columns = TextColumn("compiling, once on this machine"), BarColumn(24), TimeElapsedColumn(), TimeRemainingColumn()
    # in a pipe Rich's own prints an empty line at its end
    with Progress(*columns, console=console, transient=True, disable=not console.is_interactive) as progress:
        bar = progress.add_task("compile", total=sum(EXPECTED.values()))
        done = 0
        for wave in WAVES:
            with contextlib.ExitStack() as running:  # waits for each and closes its pipe
                children = [running.enter_context(_start(part, bench.path, method)) for part in wave]
                for _ in _lines([child.stdout for child in children if child.stdout is not None]):
                    progress.advance(bar)
            if any(child.returncode for child in children):
                return
            done += sum(EXPECTED[part] for part in wave)
            progress.update(bar, completed=done)
    marker.parent.mkdir(parents=True, exist_ok=True)
    marker.touch()


def _fingerprint(bench: BenchFile, method: str | None) -> str:
    """Changes with every source that a kernel of a run can see, with numba, and with the chosen methods."""
    import numba

    from hal.compiled import ROOT, source_fingerprint

    sources = (
        ROOT / "firmware_py" / "control" / "stages.py",
        ROOT / "sim_devices" / "plant_factory.py",
        ROOT / "drivers" / "daq" / "di4108_kernels.py",
        ROOT / "drivers" / "piezo" / "e727_kernels.py",
    )
    firmware = {key: bench.description.firmware.get(key) for key in ("sensing", "tremor", "actuation", "calibration")}
    text = repr(([source_fingerprint(file) for file in sources], firmware, method, numba.__version__, sys.version))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _start(part: str, bench: Path, method: str | None) -> subprocess.Popen[str]:
    return subprocess.Popen(
        child_command("tools.prepare", part, str(bench), *([method] if method else [])),
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=child_environment(),
    )  # fmt: skip


def _lines(streams: list[IO[str]]) -> Iterator[str]:
    """Lines of all streams as they come, until all have ended."""
    with selectors.DefaultSelector() as waiting:
        for stream in streams:
            waiting.register(stream, selectors.EVENT_READ)
        while waiting.get_map():
            for key, _ in waiting.select():
                stream = key.fileobj
                line = stream.readline()  # type: ignore[union-attr]
                if line:
                    yield line
                else:
                    waiting.unregister(stream)


def compile_part(part: str, bench: BenchFile, method: str | None) -> None:
    """Compile the kernels of one part of ``WAVES`` into the cache on disk."""
    from firmware_py.control.plan import load_plan
    from firmware_py.control.stages import Stages

    configs = load_plan(bench, method).stages
    stages = Stages(configs)
    if part == "instrument":
        stages.warm_up_parts("sense", "actuate")
        _compile_drivers({device.driver for device in bench.description.device.values()})
    elif part == "tremor":
        stages.warm_up_parts("estimate", "detect")
        if bench.description.emulated_buses():
            _compile_plant(bench)
    else:
        stages.warm_up()


def _compile_drivers(drivers: set[str]) -> None:
    if "di4108" in drivers:
        from drivers.daq import di4108_kernels

        di4108_kernels.warm_up()
    if "e727" in drivers:
        import numpy as np

        from drivers.piezo import e727_kernels

        e727_kernels.encode(np.zeros(e727_kernels.TEXT_BYTES, np.uint8), False, np.zeros(3), 1.0)


def _compile_plant(bench: BenchFile) -> None:
    from sim_devices.process import load_factory, warm_up
    from sim_devices.register import PLANT
    from sim_devices.world import World

    table = bench.description.model_dump()
    table["folder"] = str(bench.path.parent)
    warm_up(World(table, load_factory(PLANT)(table, None, None)).plant)


def main(arguments: list[str]) -> int:
    """``python -m tools.prepare PART BENCH [METHOD]``: one line on standard output for each compiled kernel."""
    from numba.core import event

    from hal.bench import load_bench

    class Ticks(event.Listener):
        def on_start(self, event: object) -> None: ...

        def on_end(self, event: object) -> None:
            print("compiled", flush=True)

    event.register("numba:compile", Ticks())
    compile_part(arguments[0], load_bench(Path(arguments[1])), arguments[2] if len(arguments) > 2 else None)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
