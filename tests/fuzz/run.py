"""Coverage-guided fuzzing of one target: ``python -m tests.fuzz.run TARGET [--seconds 60]``, or ``all``.

Starts from the seeds and ``corpus/TARGET``; new inputs that reach new code go to ``out/fuzz/TARGET``. A crash is
printed, written to ``out/fuzz`` and ends the run with a status that is not 0: repair it, and put the input into
``tests/fuzz/corpus/TARGET`` so that the default tests keep it repaired.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def fuzz(name: str, seconds: int) -> None:
    import atheris

    with atheris.instrument_imports(include=["hal", "drivers", "firmware_py", "tools", "sim_devices", "mcap"]):
        from tests.fuzz.targets import TARGETS, seeds
    found = ROOT / "out" / "fuzz" / name
    found.mkdir(parents=True, exist_ok=True)
    for k, data in enumerate(seeds()[name]):
        (found / f"seed-{k}").write_bytes(data)
    corpus = ROOT / "tests" / "fuzz" / "corpus" / name
    folders = [str(found), *([str(corpus)] if corpus.is_dir() else [])]
    flags = [
        f"-max_total_time={seconds}",
        f"-artifact_prefix={found.parent}/{name}-",
        "-rss_limit_mb=2048",
        "-timeout=10",
    ]
    atheris.Setup([sys.argv[0], *flags, *folders], TARGETS[name])
    atheris.Fuzz()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", help="a name of tests/fuzz/targets.py, or all")
    parser.add_argument("--seconds", type=int, default=60, help="per target")
    chosen = parser.parse_args()
    if chosen.target != "all":
        fuzz(chosen.target, chosen.seconds)
        return 0
    from tests.fuzz.targets import TARGETS

    failed = []
    for name in TARGETS:
        command = [sys.executable, "-m", "tests.fuzz.run", name, "--seconds", str(chosen.seconds)]
        if subprocess.run(command, cwd=ROOT, check=False).returncode:
            failed.append(name)
    print(f"{len(TARGETS) - len(failed)} of {len(TARGETS)} targets without a crash", *failed)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
