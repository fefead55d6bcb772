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
from tools.heal.balance import Balance, is_weighed, next_balance
from tools.heal.experiments import StackTwin, twin_of_stack
from tools.heal.figures import BANDS, WHOLE, TipError, is_better, is_worth_trying, rises, tip_error
from tools.heal.parts import PARTS, Comparison, Lab, Part
from tools.heal.without_remedy import WITHOUT_REMEDY
from tools.output import write_text_atomic

TRY_FROM, VERIFY_FROM = 1000, 5000
"""First seeds of the runs on which a remedy is tried, and of those that decide if it is kept. The bench's own seed drew
the experiments."""
VERIFY_RUNS = 2
"""Number of runs that decide for each run on which a remedy is tried."""
MOVES_OUTPUTS = 4
"""Least ``--max-effect`` at which an experiment may move the outputs of a real bench."""
NO_RISE = 0.5
"""Level at which a band counts as risen on the runs where a remedy is tried: its mean must not rise at all."""
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
    was planned and played. ``twin`` is the corrected twin of the stack that differed most. ``balance`` states the new
    weights of the tremor estimator, "" where they stay.
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
    balance: str = ""


@dataclass(frozen=True)
class Healed:
    """Holds the mean tip error (um) by band ``before`` and ``after`` over deciding seeds, and the healed file."""

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
        if max_effect is None or max_effect < MOVES_OUTPUTS:
            raise InputError(
                f"{bench.path}: healing moves the outputs of a real bench over their full range, which needs "
                f"--max-effect {MOVES_OUTPUTS} and strokes that an instrument of yours measures; heal an emulated copy"
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
    say: Say,
    parts: Sequence[Part] = PARTS,
) -> Healed:
    """Heal the emulated bench ``path``; the healed copy and all recordings go to the folder ``out``.

    A remedy is tried on ``runs`` runs, and kept if ``VERIFY_RUNS`` times as many others have less error and no band in
    which it rises (``is_better``).
    """
    original = load_bench(path)
    config = emulation_config(original.description.model_dump())
    trial = Trial(seconds, range(TRY_FROM, TRY_FROM + runs))
    seeds = tuple(range(VERIFY_FROM, VERIFY_FROM + VERIFY_RUNS * runs))
    before = now = tip_error(original, seconds, seeds)
    bench, steps = original, list[Step]()
    for part in parts:
        say(f"{part.name}: measuring")
        lab = Lab(bench, config, out / "recordings")
        compared = part.compare(lab)
        effects = _named(compared) if name_effects else ()
        beyond = WITHOUT_REMEDY[part.name](lab) if part.name in WITHOUT_REMEDY else ()
        named = effects, (*(e for e in effects if e not in STACK_EFFECTS), *beyond)
        twin: StackTwin | None = None
        if name_effects and compared.axis is not None:
            say(f"{part.name}: the twin of stack {compared.axis + 1}")
            twin = twin_of_stack(lab, compared.axis)
        say(f"{part.name}: identifying")
        remedy = Remedy(out / f"{part.name}.toml", out / f"weights-{part.name}.toml", out / f"bench-{part.name}.toml")
        balance = Balance()
        try:
            write_text_atomic(remedy.file, part.identify(lab).read_text())
            candidate, balance, why = trial.run(bench, remedy)
            after, kept = now, False
            if candidate is not None:
                say(f"{part.name}: verifying")
                after = tip_error(candidate, seconds, seeds)
                kept, why = is_better(now, after)
        except InputError as error:
            candidate, after, kept, why = None, now, False, str(error)
        steps.append(_step(part, compared, named, (kept, why), after, twin=twin, balance=balance))
        if kept and candidate is not None:
            bench, now = candidate, after
        else:
            remedy.remove()
    return Healed(
        str(path),
        None if bench is original else str(bench.path),
        seeds,
        seconds,
        before.mean(),
        now.mean(),
        tuple(steps),
    )


@dataclass(frozen=True)
class Remedy:
    """Names the files of a remedy: calibration, weights of the tremor estimator, and the bench with both."""

    file: Path
    weights: Path
    bench: Path

    def apply(self, to: BenchFile, balance: Balance) -> BenchFile:
        """Return the bench ``to`` with the calibration in ``file`` and the estimator's weights as ``balance`` says."""
        healed = with_remedy(to, self.file, self.bench)
        if balance == Balance():
            return healed
        write_text_atomic(self.weights, balance.calibration(healed))
        return load_bench(with_calibration(healed, self.weights.resolve(), self.bench))

    def remove(self) -> None:
        """Delete the files."""
        for file in (self.file, self.weights, self.bench):
            file.unlink(missing_ok=True)


@dataclass(frozen=True)
class Trial:
    """Tries remedies on runs that do not decide: ``seconds`` long, one for each of ``seeds``."""

    seconds: float
    seeds: Sequence[int]

    def run(self, bench: BenchFile, remedy: Remedy) -> tuple[BenchFile | None, Balance, str]:
        """Return the bench with the remedy, and the first balance with which no band rises; None and why if none is.

        The remedy must help with the estimator as it is: other weights alone are no reason to keep it.
        """
        before = tip_error(bench, self.seconds, self.seeds)
        balance = Balance()
        while True:
            candidate = remedy.apply(bench, balance)
            after = tip_error(candidate, self.seconds, self.seeds)
            is_worth_it, why = is_worth_trying(before, after)
            rising = rises(before, after, NO_RISE)
            if not is_worth_it:
                return None, balance, why
            if not rising:
                return candidate, balance, why
            following = next_balance(balance, rising) if is_weighed(bench) else None
            if following is None:
                return None, balance, f"{why}, but {', '.join(rising.values())}"
            balance = following


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


def _named(compared: Comparison) -> tuple[str, ...]:
    if compared.recording is None:
        return ()
    from tools.mismatch.infer import diagnose

    report = diagnose(compared.recording, jobs=1)
    return tuple(p.name for p in report.physics)


def _step(
    part: Part, compared: Comparison, named: tuple[tuple[str, ...], tuple[str, ...]], verdict: tuple[bool, str],
    after: TipError, *, twin: StackTwin | None, balance: Balance,
) -> Step:  # fmt: skip
    file = str(twin.file) if twin is not None and twin.file is not None else None
    split = twin.split if twin is not None else ()
    weights = "" if balance == Balance() else str(balance)
    return Step(part.name, compared.rms, compared.unit, *named, *verdict, after.mean(), file, split, weights)


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
        weights = f" (tremor estimator: {s.balance})" if s.balance else ""
        out.append(f"  {'kept' if s.kept else 'reverted'}: {s.why}{weights}.")
    out.append(f"tip error, um rms, mean of {len(healed.seeds)} runs of {healed.seconds:g} s")
    out += [f"  {b:12} {healed.before[b]:8.3f} -> {healed.after[b]:8.3f}" for b in (*BANDS, WHOLE)]
    return out
