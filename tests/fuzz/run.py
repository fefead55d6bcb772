"""Coverage-guided fuzzing: ``python -m tests.fuzz.run TARGET [--seconds 60]``, or ``all``.

Starts from the seeds and ``corpus/TARGET``; new inputs that reach new code go to ``out/fuzz/TARGET``. A crash is
printed, written to ``out/fuzz`` and ends the run with a status that is not 0: repair it, and put the input into
``tests/fuzz/corpus/TARGET`` so that the default tests keep it repaired. ``--collect`` puts small inputs that reached
new code into the corpus; the default tests replay it.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
CORPUS = ROOT / "tests" / "fuzz" / "corpus"
SMALL_BYTES = 2048
FILES = 24  # per target
STRUCTURED = ("own_recording", "columns_mcap")  # targets whose inputs are changed behind their CRCs


def fuzz(name: str, seconds: int, seed: int) -> None:
    """Does not return."""
    import atheris

    from tests.fuzz.targets import TARGETS, seeds

    found = ROOT / "out" / "fuzz" / name
    found.mkdir(parents=True, exist_ok=True)
    for data in seeds()[name]:
        (found / hashlib.sha1(data).hexdigest()).write_bytes(data)
    corpus = CORPUS / name
    folders = [str(found), *([str(corpus)] if corpus.is_dir() else [])]
    flags = [
        f"-max_total_time={seconds}",
        f"-seed={seed}",
        f"-artifact_prefix={found.parent}/{name}-",
        "-rss_limit_mb=2048",
        "-timeout=30",
        "-verbosity=0",
    ]
    more = {"custom_mutator": _behind_the_crcs} if name in STRUCTURED else {}
    atheris.Setup([sys.argv[0], *flags, *folders], TARGETS[name], **more)
    atheris.Fuzz()


def _behind_the_crcs(data: bytes, max_size: int, seed: int) -> bytes:
    """Change a recording behind its CRCs three times of four, its bytes otherwise."""
    import atheris

    from tests.fuzz.mcap_parts import change, change_some_bytes

    rng = random.Random(seed)
    if rng.randrange(4) == 0:
        return atheris.Mutate(data, max_size)

    def change_bytes(body: bytes, rng: random.Random) -> bytes:
        return atheris.Mutate(body, len(body) + 64) if rng.randrange(2) else change_some_bytes(body, rng)

    changed = change(data, rng, change_bytes)
    return changed if len(changed) <= max_size else data


def collect(name: str) -> int:
    """Small inputs of ``out/fuzz/NAME`` into the corpus, from the shortest to the longest; how many there are now."""
    from tests.fuzz.targets import seeds

    known = {hashlib.sha1(data).hexdigest() for data in seeds()[name]}
    found = sorted((ROOT / "out" / "fuzz" / name).iterdir(), key=lambda path: (path.stat().st_size, path.name))
    small = [p for p in found if 0 < p.stat().st_size <= SMALL_BYTES and p.name not in known]
    folder = CORPUS / name
    folder.mkdir(parents=True, exist_ok=True)
    room = FILES - len(list(folder.iterdir()))
    for path in small[:: max(1, len(small) // max(1, room))][: max(0, room)]:
        (folder / path.name[:16]).write_bytes(path.read_bytes())
    return len(list(folder.iterdir()))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", help="a name of tests/fuzz/targets.py, or all")
    parser.add_argument("--seconds", type=int, default=60, help="per target")
    parser.add_argument("--seed", type=int, default=0, help="0: another one each time; CI looks where it looked before")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="targets at a time")
    parser.add_argument("--collect", action="store_true", help="put small inputs that reached new code into the corpus")
    chosen = parser.parse_args()
    import atheris

    with atheris.instrument_imports(include=["hal", "drivers", "firmware_py", "tools", "sim_devices", "mcap"]):
        from tests.fuzz.targets import TARGETS
    names = list(TARGETS) if chosen.target == "all" else [chosen.target]
    if unknown := [name for name in names if name not in TARGETS]:
        print(f"there is no target {unknown[0]!r}; targets are {', '.join(TARGETS)}", file=sys.stderr)
        return 2
    failed: list[str] = []
    running: dict[int, str] = {}
    waiting = list(names)
    while waiting or running:
        while waiting and len(running) < chosen.jobs:
            child = os.fork()  # the instrumented imports are made once
            if child == 0:
                fuzz(waiting[0], chosen.seconds, chosen.seed)
            running[child] = waiting.pop(0)
        child, status = os.wait()
        name = running.pop(child)
        print(f"{name}: {f'CRASH, status {status}' if status else 'no crash'} in {chosen.seconds} s", flush=True)
        if status:
            failed.append(name)
        elif chosen.collect:
            print(f"{name}: {collect(name)} inputs in the corpus", flush=True)
    print(f"{len(names) - len(failed)} of {len(names)} targets without a crash", *failed)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
