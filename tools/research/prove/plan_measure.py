"""Groups of equivalent effects: how many a planned recording splits, and how many a random multisine of equal energy.

``python -m tools.research.prove.plan_measure --keep FOLDER --groups 100 --seed 1 --minutes 8`` goes on where it ended.
A group is drawn: a twin, an effect at a drawn place, size and parameters, and a slow first recording on which a rival
of another name leaves at most 1.05 times the residual and which does not split the group, although some input would.
The plan knows the two fits of that recording and not the truth. Both are then fitted to one planned and one random
recording of the true system. A group is split when the log likelihood ratio favours the truth by ``ENOUGH``. The truth
has the form of the vocabulary: a measure of plans, not of the vocabulary.

With much energy every input splits every group. All inputs therefore have the same energy while the plan is designed
(``RMS``), and the energy of a group is the least at which its plan is predicted to split nine recordings of ten: the
planned waveform is made smaller until the prediction just holds, and the random multisine gets that energy. Where the
plan says that it will not split a group with all that the limits allow, both inputs get that. Seeds 0, 26 and 27 were
looked at while this was made; at seed 27 the first version, which gave both inputs all that the limits allow, split 27
of 34 as planned and 32 at random.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim_devices.physics.catalogue import EFFECTS
from tools.mismatch.plan.design import FULL, design, random_inputs
from tools.mismatch.plan.limits import Wish, settle_limits
from tools.mismatch.plan.models import Rival, best_rival, distance, log_ratio, refit, squares
from tools.mismatch.plan.responses import ground
from tools.mismatch.plan.situation import Situation, noisy, problem_of, simulated, with_outputs
from tools.mismatch.plan.waveforms import LIBRARY, SIZE, draw
from tools.mismatch.recording import Array, Recording
from tools.mismatch.recording_load import from_table
from tools.mismatch.simulate import Model
from tools.mismatch.simulate_sites import sites
from tools.mismatch.simulate_start import prepare
from tools.research.prove import excite
from tools.research.prove.harness import read_rows
from tools.research.prove.nulls import clopper_pearson

ENOUGH = math.log(100.0)
"""Log likelihood ratio from which a group counts as split."""
SAME = 1.05
"""Residual of the rival over that of the truth up to which the engine calls two effects equivalent."""
GOALS = (0.8, 0.4)
"""Share that a plan should split at least, and a random multisine of equal energy at most."""
RATE_HZ, SAMPLES = 500.0, 2000
RELIABLE = 1.2816
"""Standard deviations of the log likelihood ratio (its variance is the squared distance) that the prediction is below
its mean: nine recordings of ten exceed it."""
HALVINGS, BISECTIONS = 12, 4
REACH = 20.0
"""Largest input of the first recording, and of the plan: the default of the command."""
RMS = REACH / 3.0
"""Rms of every input while the plan is designed: one that the multisines reach within ``REACH``, too."""
WISH = Wish(amplitude=REACH, centre=0.0, duration_s=SAMPLES / RATE_HZ, rms=RMS)
"""Limits of the plan."""
DRAWS = 100
"""Systems that are drawn at most until one has an equivalent rival."""
PAIRS = (
    ("first_order_lag", "dead_time"), ("first_order_lag", "resonance"), ("dead_time", "resonance"),
    ("backlash", "hysteresis"), ("hysteresis", "rate_dependent_hysteresis"), ("saturation", "static_nonlinearity"),
    ("dead_zone", "static_nonlinearity"), ("dead_zone", "backlash"), ("creep", "first_order_lag"),
    ("creep", "hysteresis"), ("creep", "rate_dependent_hysteresis"), ("slew_limit", "first_order_lag"),
    ("slew_limit", "saturation"), ("hysteresis", "first_order_lag"),
)  # fmt: skip
TWINS: dict[str, dict[str, Any]] = {
    "piezo_stack": {
        "twin": {"kind": "piezo_stack", "parameters": {"gain_um_per_V": 0.12, "offset_um": 0.0}},
        "channels": [
            {"column": "u", "role": "input", "signal": "command", "unit": "V"},
            {"column": "y", "role": "output", "signal": "displacement", "unit": "um"},
        ],
    },
    "state_space": {
        "twin": {
            "kind": "state_space",
            "parameters": {"A": [[0.0, 1.0], [-900.0, -30.0]], "B": [[0.0], [900.0]], "C": [[1.0, 0.0]]},
        },
        "channels": [
            {"column": "u", "role": "input", "signal": "drive", "unit": "V"},
            {"column": "y", "role": "output", "signal": "response", "unit": "V"},
        ],
    },
}


@dataclass(frozen=True)
class Group:
    """``truth`` is the true system, ``rivals`` its name and another one, as fitted to the first recording."""

    twin: str
    where: Situation
    truth: Rival
    rivals: tuple[Rival, Rival]
    sigma: dict[str, float]
    severity: float


def situation_of(twin: str) -> Situation:
    """A twin without data at ``RATE_HZ``."""
    text = {"format": 1, "rate_hz": RATE_HZ, **TWINS[twin]}
    wave: Array = np.sin(np.linspace(0.0, 20.0, 64))
    return Situation(Path(twin), from_table(Path(twin), text, {"u": wave, "y": 0.9 * wave}), False, text)


def draw_group(seed: int, index: int) -> Group | None:
    """The first system of ``DRAWS`` that has an equivalent rival; None where there is none."""
    rng = np.random.default_rng([seed, index])
    for _ in range(DRAWS):
        names = list(PAIRS[int(rng.integers(len(PAIRS)))])
        rng.shuffle(names)
        found = _try_group(rng, str(rng.choice(list(TWINS))), names[0], names[1])
        if found is not None:
            return found
    return None


def first_input(rng: np.random.Generator, t: Array) -> Array:
    """Two slow sinusoids, or one of the courses that recordings of the proof have."""
    if rng.random() >= 0.7:
        return excite.scalar(rng, str(rng.choice(["sine", "staircase", "tremor"])), t)
    size, hertz, phase = rng.uniform(0.3, 1, 2), rng.uniform(0.25, 1.5, 2), rng.uniform(0, 6.3, 2)
    return np.sum(size * np.sin(2 * np.pi * hertz * t[:, None] + phase), axis=1)


def _try_group(rng: np.random.Generator, twin: str, name: str, other: str) -> Group | None:
    where = situation_of(twin)
    signal = next(iter(where.template.inputs))
    t: Array = np.arange(SAMPLES) / RATE_HZ
    slow = first_input(rng, t)
    first = where.course({signal: REACH * slow / float(np.max(np.abs(slow)))})
    on = ground(first, dict.fromkeys(first.outputs, 1e-3), int(rng.integers(1 << 30)))
    places = sites(on.problem.twin, on.problem.recording, EFFECTS[name])
    if not places:
        return None
    placed = prepare(on.model, on.problem.fit_view, on.theta, places[int(rng.integers(min(2, len(places))))])
    model = Model(on.problem.twin, (placed,))
    theta = model.carry(on.model, on.theta, first)
    a, b = model.slices(0)
    for i in range(a.start, a.stop):
        p, share = model.parameters[i], rng.uniform(0.05, 0.95)
        if np.isfinite(p.hi - p.lo):
            theta[i] = p.lo * (p.hi / p.lo) ** share if p.log and p.lo > 0 else p.lo + share * (p.hi - p.lo)
    theta[b] = rng.uniform(0.2, 1.0, b.stop - b.start)
    with np.errstate(all="ignore"):
        plain = simulated(first, on.model, on.theta)
        if b.stop > b.start:
            # the weights' size is free: an effect of 0.3 to 5 % of the output
            moved = simulated(first, model, theta)
            size = max(float(np.std(moved[o] - plain[o]) / np.std(plain[o])) for o in plain)
            if not np.isfinite(size) or size == 0.0:
                return None
            theta[b] *= 10 ** rng.uniform(-2.5, -1.3) / size
        truth = simulated(first, model, theta)
        change = on.stack({o: truth[o] - plain[o] for o in plain})
    kept = float(np.sqrt(np.mean(on.less_base(change) ** 2))) * 1e-3
    whole = max(float(np.std(truth[o] - plain[o]) / np.std(plain[o])) for o in plain)
    if not np.isfinite(kept) or not 1e-4 < whole < 0.3 or kept < 1e-6:
        return None
    severity = float(rng.uniform(2.0, 6.0))
    sigma = dict.fromkeys(first.outputs, kept / severity)
    recorded = with_outputs(first, noisy(truth, sigma, rng))
    problem = problem_of(recorded, sigma)
    rest = Model(problem.twin)
    begin = problem.twin.start(recorded)
    fits = [best_rival(problem, rest, rest, begin, n) for n in (name, other)]
    if fits[0] is None or fits[1] is None:
        return None
    left = [_rms(recorded, r, sigma) for r in fits if r is not None]
    if left[1] > SAME * left[0] or left[0] > SAME or fits[0].name == fits[1].name:
        return None
    if log_ratio(recorded, fits[0], fits[1], sigma) >= ENOUGH:
        return None  # told apart by the first recording already
    group = Group(twin, where, Rival(name, (placed,), theta), (fits[0], fits[1]), sigma, severity)
    return group if is_splittable(group, rng) else None


def is_splittable(group: Group, rng: np.random.Generator) -> bool:
    """Return whether any of some strong inputs within the limits, none of them planned, would split the true system
    from the rival: no plan can split what is alike on every input.
    """
    signal = next(iter(group.where.template.inputs))
    box = settle_limits(replace(WISH, rms=None), group.where.template.unit[signal], 1 / RATE_HZ, None, "", None)
    inputs = [draw(family, np.asarray(z), box, 1 / RATE_HZ) for family, z in LIBRARY.values()]
    inputs += [draw("multisine", rng.random(SIZE["multisine"]), box, 1 / RATE_HZ) for _ in range(2)]
    pair = (group.truth, group.rivals[1])
    return any(predicted(group.where.course({signal: u}), pair, group.sigma) >= ENOUGH for u in inputs)


def _rms(recorded: Any, rival: Rival, sigma: dict[str, float]) -> float:
    found = refit(recorded, rival, sigma)
    return float(np.sqrt(np.mean([np.mean((r / sigma[o]) ** 2) for o, r in found.residual.items()])))


def thorough(recorded: Recording, rival: Rival, sigma: dict[str, float]) -> Rival:
    """``rival`` from where it fits a new recording best: its old parameters, or a search that begins anew as the engine
    would. An old fit may lie in another valley.
    """
    problem = problem_of(recorded, sigma)
    rest = Model(problem.twin)
    fresh = best_rival(problem, rest, rest, problem.twin.start(recorded), rival.name)
    old = refit(recorded, rival, sigma, iterations=25)
    if fresh is None or squares(refit(recorded, fresh, sigma), sigma) >= squares(old, sigma):
        return replace(rival, theta=old.theta)
    return fresh


def predicted(course: Recording, rivals: tuple[Rival, Rival], sigma: dict[str, float]) -> float:
    """The log likelihood ratio that nine recordings of ten exceed when the first rival is true."""
    d = distance(course, *rivals, sigma, FULL, thorough=True)
    price = 0.5 * math.log(course.n * len(course.outputs)) * (rivals[1].theta.size - rivals[0].theta.size)
    return 0.5 * d * d - RELIABLE * d + price


def least_waves(group: Group, waves: Mapping[str, Array]) -> dict[str, Array]:
    """The planned ``waves`` (about zero), as small as the prediction that they split the group allows."""

    def scaled(share: float) -> dict[str, Array]:
        return {s: share * x for s, x in waves.items()}

    def splits(share: float) -> bool:
        return predicted(group.where.course(scaled(share)), group.rivals, group.sigma) >= ENOUGH

    if not splits(1.0):
        return scaled(1.0)
    high, low = 1.0, 0.5
    for _ in range(HALVINGS):
        if not splits(low):
            break
        high, low = low, 0.5 * low
    for _ in range(BISECTIONS):
        middle = math.sqrt(low * high)
        if splits(middle):
            high = middle
        else:
            low = middle
    return scaled(high)


def run_one(seed: int, index: int, evaluations: int) -> dict[str, Any]:
    """Draw a group, plan, record both inputs, and compare; what came of it, as a row."""
    began = time.process_time()
    group = draw_group(seed, index)
    row: dict[str, Any] = {"seed": seed, "index": index, "drawn": group is not None}
    if group is None:
        return row
    signal = next(iter(group.where.template.inputs))
    box = {signal: settle_limits(WISH, group.where.template.unit[signal], 1 / RATE_HZ, None, group.twin, None)}
    plan = design(group.where, group.rivals, box, group.sigma, evaluations=evaluations, seed=index)
    least = least_waves(group, plan.waves)
    rng = np.random.default_rng([seed, index, 1])
    ratio = {}
    for name, waves in (("planned", least), ("random", random_inputs(least, box, 1 / RATE_HZ, rng))):
        course = group.where.course(waves)
        truth = simulated(course, Model(problem_of(course, group.sigma).twin, group.truth.placed), group.truth.theta)
        recorded = with_outputs(course, noisy(truth, group.sigma, rng))
        ratio[name] = log_ratio(
            recorded,
            thorough(recorded, group.rivals[0], group.sigma),
            thorough(recorded, group.rivals[1], group.sigma),
            group.sigma,
        )
    return {
        **row,
        "twin": group.twin,
        "effect": group.truth.name,
        "rival": group.rivals[1].name,
        "severity": group.severity,
        "input": plan.description,
        "amplitude": float(np.max(np.abs(least[signal]))),
        "predicted": predicted(group.where.course(least), group.rivals, group.sigma),
        "expected_sd": plan.separation,
        "random_expected_sd": plan.random_separation,
        "log_ratio": ratio["planned"],
        "random_log_ratio": ratio["random"],
        "cpu_s": round(time.process_time() - began, 1),
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Counts with exact 95 % intervals (Clopper and Pearson 1934)."""
    drawn = [r for r in rows if r["drawn"]]
    promised = [r for r in drawn if r["predicted"] >= ENOUGH]
    text: list[str] = []
    for title, some in (("all groups", drawn), ("groups that the plan says it splits", promised)):
        text.append(title)
        for label, k in (
            ("planned recording splits", sum(r["log_ratio"] >= ENOUGH for r in some)),
            ("random multisine splits", sum(r["random_log_ratio"] >= ENOUGH for r in some)),
            ("planned names the wrong one", sum(r["log_ratio"] <= -ENOUGH for r in some)),
            ("random names the wrong one", sum(r["random_log_ratio"] <= -ENOUGH for r in some)),
        ):
            low, high = clopper_pearson(k, len(some)) if some else (0.0, 1.0)
            text.append(f"  {label:28} {k:3} of {len(some):3}   {100 * low:.0f} to {100 * high:.0f} %")
    seconds = sum(r["cpu_s"] for r in drawn)
    goals = f"goals: at least {100 * GOALS[0]:.0f} % and at most {100 * GOALS[1]:.0f} %"
    return "\n".join([*text, goals, f"{len(rows) - len(drawn)} could not be drawn; {seconds:.0f} s of CPU"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is not done yet and print the table."""
    parser = argparse.ArgumentParser(description="Measure how many groups a planned recording splits.")
    parser.add_argument("--keep", type=Path, required=True, help="rows.jsonl there; a stopped run goes on")
    parser.add_argument("--groups", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--evaluations", type=int, default=60)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no group after these")
    options = parser.parse_args(arguments)
    options.keep.mkdir(parents=True, exist_ok=True)
    file = options.keep / "rows.jsonl"
    rows = [r for r in read_rows(file) if r["seed"] == options.seed] if file.is_file() else []
    done = {r["index"] for r in rows}
    began = time.monotonic()
    for index in range(options.groups):
        if index in done:
            continue
        if time.monotonic() - began > 60 * options.minutes:
            break
        rows.append(run_one(options.seed, index, options.evaluations))
        with file.open("a") as out:
            out.write(json.dumps(rows[-1]) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
