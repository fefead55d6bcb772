"""Groups of equivalent effects: how many a planned recording splits, and how many a random multisine of equal energy.

``python -m tools.research.prove.plan_measure --keep FOLDER --groups 100 --seed 1 --minutes 8`` goes on where it ended.
A group is drawn: a twin, an effect at a drawn place, size and parameters, and a slow first recording that splits it
from a rival of another name by less than ``ENOUGH``. The plan knows the two fits of that recording and not the truth.
Both are then fitted to one planned and one random recording of the true system. The truth has the form of the
vocabulary: a measure of plans, not of the vocabulary.

A recording splits a group if its waveform does: the log likelihood of the true effect, re-fitted, exceeds that of its
re-fitted rival by ``ENOUGH`` without any price of parameters (``evidence``). The first measure counted Schwarz's price
in: a rival with two parameters more lost by 7.6 on an input that moved neither model. It was changed after a miss with
it (seed 2626: planned 6 of 10, random 5), and so was the plan's energy (below). Seeds 0, 26, 27, 41 and 2626 were
looked at while the measure was made.

With much energy every input splits every group. A group's energy is therefore the least at which its plan is predicted
to split nine recordings of ten. The plan is made twice: at an rms of ``RMS``, then at the least energy of the first
waveform, because an input that is only made smaller is not the best small one. The random multisine has the energy of
the second and no limit of peak or rate. Where the plan says that it will not split a group with all that the limits
allow, both inputs get that. Groups that none of some inputs splits with all that the limits allow (one model contains
the other, or the rival imitates the effect on all of them) are counted and not planned for.
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
from threadpoolctl import threadpool_limits

from sim_devices.physics.catalogue import EFFECTS
from tools.mismatch.plan.design import FULL, Plan, design, random_inputs
from tools.mismatch.plan.limits import Wish, settle_limits
from tools.mismatch.plan.models import Rival, best_rival, distance, evidence, refit, squares
from tools.mismatch.plan.responses import ground
from tools.mismatch.plan.separable import separable
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
from tools.research.results.artefact import write_result
from tools.research.stamp import revision_and_day

ENOUGH = math.log(100.0)
"""Log likelihood ratio from which a group counts as split."""
FITTED = 1.05
"""Largest residual of the true effect, re-fitted to the first recording, in noise rms."""
GOALS = (0.8, 0.4)
"""Share that a plan should split at least, and a random multisine of equal energy at most."""
RATE_HZ, SAMPLES = 500.0, 2000
RELIABLE = 1.2816
"""Standard deviations of the log likelihood ratio (its variance is the squared distance) that the prediction is below
its mean: nine recordings of ten exceed it."""
HALVINGS, BISECTIONS = 12, 3
REACH = 20.0
"""Largest input of the first recording, and of the plan: the default of the command."""
RMS = REACH / 3.0
"""Rms of every input while the plan is designed: one that the multisines reach within ``REACH``, too."""
WISH = Wish(amplitude=REACH, centre=0.0, duration_s=SAMPLES / RATE_HZ, rms=RMS)
"""Limits of the plan."""
LEAST_NOISE = 1e-3
"""Smallest noise, as a share of the rms of the output of the twin: 60 dB."""
DRAWS = 400
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


def draw_group(seed: int, index: int) -> tuple[Group | None, list[Group]]:
    """Return the first group of ``DRAWS`` systems that some input splits (None: there is none), and those before it
    that no input splits.
    """
    rng = np.random.default_rng([seed, index])
    alike: list[Group] = []
    for _ in range(DRAWS):
        names = list(PAIRS[int(rng.integers(len(PAIRS)))])
        rng.shuffle(names)
        found = _try_group(rng, str(rng.choice(list(TWINS))), names[0], names[1])
        if found is None:
            continue
        if is_splittable(found, rng):
            return found, alike
        alike.append(found)
    return None, alike


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
    if kept / severity < LEAST_NOISE * float(np.mean([np.std(y) for y in plain.values()])):
        return None
    recorded = with_outputs(first, noisy(truth, sigma, rng))
    problem = problem_of(recorded, sigma)
    rest = Model(problem.twin)
    begin = problem.twin.start(recorded)
    fits = [best_rival(problem, rest, rest, begin, n) for n in (name, other)]
    if fits[0] is None or fits[1] is None:
        return None
    if fits[0].name == fits[1].name or _rms(recorded, fits[0], sigma) > FITTED:
        return None
    if max(evidence(recorded, fits[0], fits[1], sigma)) >= ENOUGH:
        return None  # split by the first recording already
    return Group(twin, where, Rival(name, (placed,), theta), (fits[0], fits[1]), sigma, severity)


def is_splittable(group: Group, rng: np.random.Generator) -> bool:
    """Return True if one of some inputs with all that the limits allow, none of them planned, would split the true
    system from the rival: no plan can split what is alike on every input.
    """
    signal = next(iter(group.where.template.inputs))
    box = settle_limits(WISH, group.where.template.unit[signal], 1 / RATE_HZ, None, "", None)
    inputs = [draw(family, np.asarray(z), box, 1 / RATE_HZ) for family, z in LIBRARY.values()]
    inputs += [draw("multisine", rng.random(SIZE["multisine"]), box, 1 / RATE_HZ) for _ in range(2)]
    pair = (group.truth, group.rivals[1])
    return any(predicted(group.where.course({signal: u}), pair, group.sigma) >= ENOUGH for u in inputs)


def _rms(recorded: Any, rival: Rival, sigma: dict[str, float]) -> float:
    found = refit(recorded, rival, sigma)
    return float(np.sqrt(np.mean([np.mean((r / sigma[o]) ** 2) for o, r in found.residual.items()])))


def best_fit(recorded: Recording, rivals: Sequence[Rival], sigma: dict[str, float]) -> Rival:
    """Return the best fit of a model to a new recording: from each of ``rivals``, and by a search that begins anew as
    the engine would. An old fit may lie in another valley.
    """
    problem = problem_of(recorded, sigma)
    rest = Model(problem.twin)
    fresh = best_rival(problem, rest, rest, problem.twin.start(recorded), rivals[0].name)
    begins = [r for r in (fresh, *rivals) if r is not None]
    fits = [(refit(recorded, r, sigma, iterations=FULL), r) for r in begins]
    found, best = min(fits, key=lambda f: squares(f[0], sigma))
    return replace(best, theta=found.theta)


def predicted(course: Recording, rivals: tuple[Rival, Rival], sigma: dict[str, float]) -> float:
    """Return the evidence that nine recordings of ten exceed when the first rival is true, or an upper bound that is
    below ``ENOUGH``.
    """
    spare = 0.5 * max(0, rivals[1].theta.size - rivals[0].theta.size)
    value, d = np.inf, np.inf
    for careful in (False, True):
        d = min(d, distance(course, *rivals, sigma, FULL, thorough=careful))
        value = 0.5 * d * d - RELIABLE * d - spare
        if value < ENOUGH:
            break
    return value


def says_alike(group: Group) -> bool:
    """Return True if the analysis of ``micron mismatch plan`` says that the rival imitates the effect everywhere."""
    signal = next(iter(group.where.template.inputs))
    box = {signal: settle_limits(WISH, group.where.template.unit[signal], 1 / RATE_HZ, None, group.twin, None)}
    name, other = (r.name for r in group.rivals)
    found = separable(group.where, box, group.sigma, size=group.severity, effects=[EFFECTS[name], EFFECTS[other]])
    return (name, other) in found.imitated


def least_waves(group: Group, waves: Mapping[str, Array]) -> tuple[dict[str, Array], float]:
    """Return the planned ``waves`` (about zero) as small as the prediction that they split the group allows, and the
    prediction.
    """

    def scaled(share: float) -> dict[str, Array]:
        return {s: share * x for s, x in waves.items()}

    def promise(share: float) -> float:
        return predicted(group.where.course(scaled(share)), group.rivals, group.sigma)

    best = promise(1.0)
    if best < ENOUGH:
        return scaled(1.0), best
    high, low = 1.0, 0.5
    for _ in range(HALVINGS):
        if (now := promise(low)) < ENOUGH:
            break
        high, low, best = low, 0.5 * low, now
    for _ in range(BISECTIONS):
        middle = math.sqrt(low * high)
        if (now := promise(middle)) >= ENOUGH:
            high, best = middle, now
        else:
            low = middle
    return scaled(high), best


def rms_of(waves: Mapping[str, Array]) -> float:
    """Return the rms of the only input of a plan."""
    (x,) = waves.values()
    return float(np.sqrt(np.mean(x**2)))


def recorded_on(group: Group, waves: Mapping[str, Array], rng: np.random.Generator) -> dict[str, float]:
    """Record ``waves`` on the true system and return what the recording says of the group.

    ``evidence`` is for the true effect, ``against`` for the rival. The re-fits also begin at the true system, and at
    the rival's re-fit to the recording without noise: a search that misses an optimum is no evidence. ``true_sd`` is
    the distance of the rival from the true system, which the plan does not know.
    """
    course, sigma = group.where.course(waves), group.sigma
    truth = simulated(course, Model(problem_of(course, sigma).twin, group.truth.placed), group.truth.theta)
    near = refit(with_outputs(course, truth), group.rivals[1], sigma, FULL, thorough=True)
    shadow = Rival(group.rivals[1].name, near.model.placed, near.theta)
    recorded = with_outputs(course, noisy(truth, sigma, rng))
    fits = [best_fit(recorded, pair, sigma) for pair in zip(group.rivals, (group.truth, shadow), strict=True)]
    gains = evidence(recorded, fits[0], fits[1], sigma)
    return {"evidence": gains[0], "against": gains[1], "true_sd": math.sqrt(squares(near, sigma))}


def run_one(seed: int, index: int, evaluations: int) -> dict[str, Any]:
    """Draw a group, plan, record both inputs, and compare; the outcome as a row. Linear algebra runs on one thread."""
    began = time.process_time()
    with threadpool_limits(1):
        group, alike = draw_group(seed, index)
        row: dict[str, Any] = {"seed": seed, "index": index, "revision": revision_and_day(), "drawn": group is not None}
        row["alike"] = [[g.twin, g.truth.name, g.rivals[1].name, says_alike(g)] for g in alike]
        if group is not None:
            row |= compare(group, seed, index, evaluations)
    return {**row, "cpu_s": round(time.process_time() - began, 1)}


def compare(group: Group, seed: int, index: int, evaluations: int) -> dict[str, Any]:
    """Return the entries of a row that compare a planned with a random recording of equal energy."""
    signal = next(iter(group.where.template.inputs))

    def made(rms: float, count: int) -> tuple[Plan, dict[str, Array], float]:
        unit = group.where.template.unit[signal]
        box = {signal: settle_limits(replace(WISH, rms=rms), unit, 1 / RATE_HZ, None, group.twin, None)}
        plan = design(group.where, group.rivals, box, group.sigma, evaluations=count, seed=index, compared=0)
        return plan, *least_waves(group, plan.waves)

    plan, least, promise = made(RMS, 0)
    second = made(rms_of(least), evaluations)
    if second[2] >= ENOUGH or promise < ENOUGH:
        plan, least, promise = second
    rng = np.random.default_rng([seed, index, 1])
    return {
        "twin": group.twin,
        "effect": group.truth.name,
        "rival": group.rivals[1].name,
        "parameters": [r.theta.size for r in group.rivals],
        "severity": group.severity,
        "says_alike": says_alike(group),
        "input": plan.description,
        "rms": rms_of(least),
        "predicted": promise,
        "planned": recorded_on(group, least, rng),
        "random": recorded_on(group, random_inputs(least, plan.limits, 1 / RATE_HZ, rng), rng),
    }


def reason(row: Mapping[str, Any]) -> str:
    """Return why the planned recording of a row does not split its group."""
    if row["predicted"] < ENOUGH:
        return "no input that was tried within the limits is predicted to split it"
    if 0.5 * row["planned"]["true_sd"] ** 2 < ENOUGH:
        return "the rival is nearer to the true system than to its fit to the first recording"
    return "noise, or a better re-fit of the rival than the plan's"


def counted(rows: Sequence[dict[str, Any]], key: str, which: str) -> int:
    """Return how many rows have ``ENOUGH`` ``evidence`` or ``against`` in the ``planned`` or ``random`` recording."""
    return sum(r[which][key] >= ENOUGH for r in rows)


def share(k: int, n: int) -> str:
    """Return a count with its exact 95 % interval (Clopper and Pearson 1934)."""
    low, high = clopper_pearson(k, n) if n else (0.0, 1.0)
    return f"{k} of {n} ({100 * low:.0f} to {100 * high:.0f} %)"


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of counts beside their goals."""
    drawn, alike = [r for r in rows if r["drawn"]], [a for r in rows for a in r["alike"]]
    promised = [r for r in drawn if r["predicted"] >= ENOUGH]
    n, whole = len(drawn), len(drawn) + len(alike)
    k, other = counted(drawn, "evidence", "planned"), counted(drawn, "evidence", "random")
    lines = [
        ("the planned recording splits, of groups that some input splits", f"{100 * GOALS[0]:.0f} %", share(k, n)),
        ("a random multisine of equal energy splits", f"at most {100 * GOALS[1]:.0f} %", share(other, n)),
        ("the planned recording splits, of all groups that were drawn", "-", share(k, whole)),
        (
            "the planned recording splits, of groups that the plan says it splits",
            "90 %",
            share(counted(promised, "evidence", "planned"), len(promised)),
        ),
        ("the planned recording names the wrong effect", "0", share(counted(drawn, "against", "planned"), n)),
        ("the random multisine names the wrong effect", "-", share(counted(drawn, "against", "random"), n)),
        (
            "`plan` without a report says so, of groups that no input splits",
            "all",
            share(sum(bool(a[3]) for a in alike), len(alike)),
        ),
        (
            "`plan` without a report says so, of groups that some input splits",
            "0",
            share(sum(r["says_alike"] for r in drawn), n),
        ),
    ]
    return "\n".join(["| figure | goal | measured |", "|---|---|---|", *("| " + " | ".join(x) + " |" for x in lines)])


def page(rows: Sequence[dict[str, Any]]) -> str:
    """Return the result's page."""
    drawn, seed = [r for r in rows if r["drawn"]], rows[0]["seed"]
    revisions = "; ".join(dict.fromkeys(r["revision"] for r in rows))
    missed = [r for r in drawn if r["planned"]["evidence"] < ENOUGH]
    why = [f"- {sum(reason(r) == w for r in missed)}: {w}" for w in sorted({reason(r) for r in missed})]
    pairs = sorted({tuple(sorted((r["effect"], r["rival"]))) for r in drawn})
    lines: list[str] = []
    for pair in pairs:
        some = [r for r in drawn if {r["effect"], r["rival"]} == set(pair)]
        counts = [str(counted(some, "evidence", w)) for w in ("planned", "random")]
        lines.append(f"| {' / '.join(pair).replace('_', ' ')} | {len(some)} | {' | '.join(counts)} |")
    alike = [tuple(sorted(a[1:3])) for r in rows for a in r["alike"]]
    never = [f"- {' / '.join(p).replace('_', ' ')}: {alike.count(p)}" for p in sorted(set(alike))]
    return f"""# Planned recordings

Made by `python -m tools.research.prove.plan_measure --seed {seed} --keep FOLDER --out docs/results/plan.json`,
revision {revisions}; do not edit.

A group is an effect and a rival that a slow first recording does not tell apart. A
recording splits it if its waveform favours the true effect over the rival by a likelihood ratio of
{math.exp(ENOUGH):.0f}, both re-fitted, with no price of parameters. The energy is the least at which the plan is
predicted to split nine recordings of ten; the random multisine has the same energy and no limit of peak or rate.

{table(rows)}

- The measure was changed after a miss: the first one counted the price of parameters (Schwarz 1978) as evidence, so
  that a pair whose sizes differ was split by any input. By that measure seed 2626 had planned 6 of 10 and random 5.
  With it changed the energy, which was that of a plan for all that the limits allow, made smaller.
- Groups that none of eight inputs splits with all that the limits allow are not planned for. Often the
  rival contains the effect, so that no waveform speaks for the effect.
- {len(rows) - len(drawn)} of {len(rows)} draws held no group that some input splits. The goals are for 100 groups.
- CPU: {sum(r["cpu_s"] for r in rows):.0f} s.

## Why a planned recording did not split

{chr(10).join(why) or "- none"}

## By pair

| pair | groups | planned splits | random splits |
|---|---|---|---|
{chr(10).join(lines)}

## Pairs that no input splits

{chr(10).join(never) or "- none"}
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is not done yet and print the table."""
    parser = argparse.ArgumentParser(description="Measure how many groups a planned recording splits.")
    parser.add_argument("--keep", type=Path, required=True, help="rows.jsonl there; a stopped run goes on")
    parser.add_argument("--groups", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--evaluations", type=int, default=100)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no group after these")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the result there (.json or .md)")
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
    if not rows:
        return
    print(table(rows))
    if options.out is not None:
        write_result(options.out, page(rows))


if __name__ == "__main__":
    main()
