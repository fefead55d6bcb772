"""The command ``micron mismatch heal``: experiments, a diagnosis, and remedies, each of which is kept or reverted."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hal.bench import SIM_SCHEME, BenchFile, load_bench
from sim_devices.config import emulation_config
from tools.bench.bench_copy import with_calibration
from tools.closed_loop.simulate import COMMAND_DELAY_S, wires_of
from tools.errors import InputError
from tools.heal.experiments import StackTwin, twin_of_stack
from tools.heal.figures import BANDS, WHOLE, TipError, is_better, tip_error
from tools.heal.parts import PARTS, Comparison, Lab, Part
from tools.heal.without_remedy import WITHOUT_REMEDY
from tools.output import write_text_atomic

VERIFY_FROM = 1000
"""First seed of the runs that decide; the bench's own seed drew the experiments."""
STACK_EFFECTS = frozenset(
    (
        "hysteresis", "rate_dependent_hysteresis", "creep", "backlash", "dead_zone", "static_nonlinearity",
        "saturation", "first_order_lag", "resonance", "dead_time",
    )
)  # fmt: skip
"""Effects of a stack that the firmware's inverse (loops, creep, curve) or feedforward (lag, resonance) compensates."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class Step:
    """Records the treatment of a part: misfit, effects that the engine named, and if and why its remedy was kept.

    ``no_remedy`` lists what was found that the firmware cannot compensate, ``split`` those for which an experiment
    was planned and played. ``twin`` is the corrected twin of the stack that differed most.
    """

    part: str
    difference: float
    unit: str
    effects: tuple[str, ...]
    no_remedy: tuple[str, ...]
    kept: bool
    why: str
    after: Mapping[str, float]
    twin: str | None = None
    split: tuple[str, ...] = ()


@dataclass(frozen=True)
class Healed:
    """Holds the mean tip error (um) by band ``before`` and ``after`` over the same seeds, and the healed file."""

    original: str
    bench: str | None
    seeds: tuple[int, ...]
    seconds: float
    before: Mapping[str, float]
    after: Mapping[str, float]
    steps: tuple[Step, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the JSON of the command."""
        return {"format": 1, **asdict(self)}


def check_bench(bench: BenchFile, max_effect: int | None) -> None:
    """Raise InputError for a bench that cannot be healed: a real one, or one with sensors unknown to the lab."""
    if not all(bus.uri.startswith(SIM_SCHEME) for bus in bench.description.bus.values()):
        if max_effect is None:
            raise InputError(
                f"{bench.path}: healing moves the outputs of a real bench over their full range; allow it with "
                "--max-effect 4, or heal an emulated copy"
            )
        raise InputError(
            f"{bench.path}: on a real bench the strokes have to be measured by an instrument of yours; record them "
            "beside a program of micron mismatch plan, then micron calibrate piezo"
        )
    if emulation_config(bench.description.model_dump()).endoscope is not None:
        raise InputError(f"{bench.path}: an endoscope bench has no tip that is compensated; name an instrument's bench")
    wires_of(bench, 0, COMMAND_DELAY_S)  # raises InputError for a bench whose runs cannot be simulated


def heal(
    path: Path,
    out: Path,
    *,
    seconds: float,
    runs: int,
    name_effects: bool = True,
    jobs: int = 1,
    say: Say,
    parts: Sequence[Part] = PARTS,
) -> Healed:
    """Heal the emulated bench ``path``; the healed copy and all recordings go to the folder ``out``."""
    original = load_bench(path)
    config = emulation_config(original.description.model_dump())
    seeds = tuple(range(VERIFY_FROM, VERIFY_FROM + runs))
    before = now = tip_error(original, seconds, seeds)
    bench, steps = original, list[Step]()
    for part in parts:
        say(f"{part.name}: measuring")
        lab = Lab(bench, config, out / "recordings")
        compared = part.compare(lab)
        effects = _named(compared, jobs) if name_effects else ()
        beyond = WITHOUT_REMEDY[part.name](lab) if part.name in WITHOUT_REMEDY else ()
        named = effects, (*(e for e in effects if e not in STACK_EFFECTS), *beyond)
        twin: StackTwin | None = None
        if name_effects and compared.axis is not None:
            say(f"{part.name}: the twin of stack {compared.axis + 1}")
            twin = twin_of_stack(lab, compared.axis, jobs)
        say(f"{part.name}: identifying")
        try:
            file = out / f"{part.name}.toml"
            write_text_atomic(file, part.identify(lab).read_text())
            candidate = with_remedy(bench, file, out / f"bench-{part.name}.toml")
            after = tip_error(candidate, seconds, seeds)
        except InputError as error:
            steps.append(_step(part, compared, named, (False, str(error)), now, twin))
            continue
        kept, why = is_better(now, after)
        steps.append(_step(part, compared, named, (kept, why), after, twin))
        if kept:
            bench, now = candidate, after
        else:
            candidate.path.unlink()
            file.unlink()
    return Healed(
        str(path),
        None if bench is original else str(bench.path),
        seeds,
        seconds,
        before.mean(),
        now.mean(),
        tuple(steps),
    )


def with_remedy(bench: BenchFile, file: Path, out: Path) -> BenchFile:
    """Return the bench with one more calibration.

    If the preview of the stacks changes, the horizon of the tremor estimator changes by the same amount.
    """
    from firmware_py.control.plan import load_plan

    was = load_plan(bench).stages.actuation.preview_s
    healed = load_bench(with_calibration(bench, file.resolve(), out))
    found = re.search(r"^preview_s = ([0-9.e+-]+)$", file.read_text(), re.MULTILINE)
    shift = float(found.group(1)) - was if found else 0.0
    if shift:
        text = re.sub(
            r"^(loop_delay_s = )([0-9.e+-]+)",
            lambda m: f"{m.group(1)}{float(m.group(2)) + shift:.6g}",
            healed.text,
            flags=re.MULTILINE,
        )
        write_text_atomic(out, text)
        healed = load_bench(out)
    return healed


def _named(compared: Comparison, jobs: int) -> tuple[str, ...]:
    if compared.recording is None:
        return ()
    from tools.mismatch.infer import diagnose

    report = diagnose(compared.recording, jobs=jobs)
    return tuple(p.name for p in report.physics)


def _step(
    part: Part, compared: Comparison, named: tuple[tuple[str, ...], tuple[str, ...]], verdict: tuple[bool, str],
    after: TipError, twin: StackTwin | None,
) -> Step:  # fmt: skip
    file = str(twin.file) if twin is not None and twin.file is not None else None
    split = twin.split if twin is not None else ()
    return Step(part.name, compared.rms, compared.unit, *named, *verdict, after.mean(), file, split)


def lines(healed: Healed) -> list[str]:
    """Return what the command prints: a sentence per line, and a table."""
    out: list[str] = []
    for s in healed.steps:
        named = f"; the engine names {', '.join(s.effects).replace('_', ' ')}" if s.effects else ""
        out.append(f"{s.part}: differs from what the firmware believes by {s.difference:.3g} {s.unit} rms{named}.")
        out += [f"  {e.replace('_', ' ')}: the firmware has no remedy." for e in s.no_remedy]
        if s.split:
            out.append(f"  planned and recorded: what splits {', '.join(s.split).replace('_', ' ')}.")
        if s.twin is not None:
            out.append(f"  corrected twin of the stack: {s.twin}")
        out.append(f"  {'kept' if s.kept else 'reverted'}: {s.why}.")
    out.append(f"tip error, um rms, mean of {len(healed.seeds)} runs of {healed.seconds:g} s")
    out += [f"  {b:12} {healed.before[b]:8.3f} -> {healed.after[b]:8.3f}" for b in (*BANDS, WHOLE)]
    return out
