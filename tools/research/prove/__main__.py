"""`python -m tools.research.prove`: the proof with the switches that tuning needs."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from hal.children import use_one_thread


def _only(text: str) -> tuple[str, str, float]:
    parts = [p.strip() for p in text.split(",")] + ["", "", ""]
    return parts[0], parts[1], float(parts[2] or 0.0)


def main() -> int:
    """Exit 0 when the proof ran, whatever its figures; 2 on bad usage."""
    use_one_thread()
    from tools.research.prove.proof import MOST_SAMPLES

    p = argparse.ArgumentParser(prog="python -m tools.research.prove", description="Blind self-proof, for tuning.")
    p.add_argument("--cases", type=int, default=40)
    p.add_argument("--seed", type=int, default=None, help="a fresh one if left out; it is printed")
    p.add_argument("--only", type=_only, default=None, help="twin,effect,severity; empty = free; effect may be "
                   "agrees, recalibrate, unknown or pair")  # fmt: skip
    p.add_argument("--jobs", type=int, default=2)
    p.add_argument("--keep", type=Path, default=None, help="folder for recordings, sealed answers and reports")
    p.add_argument("--max-samples", type=int, default=MOST_SAMPLES)
    p.add_argument("--json", type=Path, default=None)
    p.add_argument("--generate-only", action="store_true", help="write recordings and answers, diagnose nothing")
    args = p.parse_args()

    from tools.research.prove import plans, seal
    from tools.research.prove.proof import generate, prove
    from tools.research.prove.table import show
    from tools.terminal import plain_console

    if args.generate_only:
        if args.keep is None or args.seed is None:
            p.error("--generate-only needs --keep and --seed")
        asked = plans.plans(args.seed, args.cases, args.only)
        _, answers = generate(args.seed, asked, args.keep / "recordings", jobs=args.jobs, max_samples=args.max_samples)
        print(f"{len(answers)} recordings, sha256 {seal.close(answers, args.keep / 'sealed')}")
        return 0
    result = prove(args.cases, args.seed, args.jobs, args.keep, only=args.only, max_samples=args.max_samples)
    show(result, plain_console(file=sys.stdout if args.json is None else sys.stderr, width=150))
    if args.json is not None:
        args.json.write_text(json.dumps(result.to_json(), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
