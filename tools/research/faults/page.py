"""The campaign as a page: docs/results/reliability.json is made by ``micron faults --out``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tools.research.faults.campaign import FaultRow, moved_unseen, totals
from tools.research.faults.drift_bound import FALSE_PER_HOUR, SEEN, DriftBound
from tools.research.faults.phases import PHASES, START

HEAD = """# Reliability: what breaks, what the instrument does

Made by `{command}`, firmware revision {revision}. The emulated bench in virtual time: {faults} kinds of fault at
{points} operating points ({names}), {runs} runs. Each fault strikes at a random instant of five phases of a run:
self-test, learning (0.8 to 2 s), steady (2 to 12 s), in a hold, in the ramp of a run that ends; or it is there when
the bench is opened ("at start"). Beside them {pairs} pairs: the second fault strikes up to 0.1 s after the first.

| figure | goal | measured |
|---|---|---|
| runs that moved the tip more than 5 um and were known of within 20 ms of that | - | {known} of {moving} |
| of these, faults that this bench cannot tell in time ("cannot be seen", "slow") | - | {known_blind} of {blind} |
| of these, faults that it can | all | {known_ours} of {ours} |
| unsafe outputs | 0 | {unsafe_outputs} |
| jumps of outputs that the fault itself makes (restarted DAC, bits flipped on I2C) | - | {jumps_of_the_fault} |
| samples that nobody counted | 0 | {uncounted_samples} |
| messages that do not name the cause | 0 | {wrong_messages} |
| answers as expected below | all | {as_expected} of {runs} |
| of these, runs in which a fault that strikes at random did not (the answer must be none) | - | {did_not_strike} |

| phase | runs | as expected | moved 5 um, known within 20 ms | unsafe |
|---|---|---|---|---|
{phases}

How it is measured. Known: the firmware tripped, held, or counted it under a name (`noticed` in the run's JSON), or
refused to start; within 20 ms of the instant at which the tip is 5 um astray. The tip's error is its distance from the
same run without the fault (same hand, same noise, bit for bit the same until the strike), until the decision. Faults
that also shift when samples are taken would meet other noise: their tip is that of two more runs, both without noise
from the strike on. Unsafe: a demand that arrives at the amplifier beyond 0..100 V or faster than 20 V/ms; a channel
that is not neutral 21 ms after the decision although the report says that it is (one that says "neutral NOT confirmed"
makes no such claim); or anything but the ramp and neutral from the begin to the end of a hold. A demand that the fault
itself makes is counted apart; a report of neutral that is none is never excused. The tip is judged where the outputs
work when the fault strikes (learning, steady). In self-test, hold and ramp a latching fault must not end in outputs
that work (`tools/research/faults/phases.py`). Uncounted: scans that the device took and that are neither received,
nor reported lost, nor unread at the end. Of a pair on one bus both faults act.

How the grading changed after a look at campaigns before this one (seeds 77, 133569468, 46657867, 103200270, 35582166):
faults in self-test and hold are watched until outputs work; a fault that strikes at random and has not is answered
rightly by nothing; "cannot be seen" may be seen by the self-test; a wrong bit in one command of ten is "slow" on a
bench that does not read commands back, and not counted among what it can tell within 20 ms; the second fault of a pair
on one bus no longer replaces the first; neutral may come later than 21 ms where the hold's report says so and when.

## Answers that were not as expected

{unexpected}

## What is not seen, or too late

{unseen}

{bound}{beside}## What says so, and what then

Over all hands. "Names the part": runs in which what was said names the broken part (input, output, device), so that it
is isolated and not only noticed. A safe state is latched: it ends the run, and a new one begins only when somebody
starts it. A hold ends by itself when its cause has passed, or latches: [findings](findings.md) has the table. "Holds"
in the answers: the run was watched no longer, or the fault would not pass.

| fault | said first | names the part | then | scans lost, most |
|---|---|---|---|---|
{matrix}

## All faults

Times in ms; error in um; "hand" is the operating point.

| fault | hand | answer | known after p50 / max | neutral after max | tip error max | as expected |
|---|---|---|---|---|---|---|
{rows}
"""


@dataclass(frozen=True)
class Beside:
    """The same on another bench: ``chosen`` is the text that its faults have in their names."""

    bench: str
    chosen: str
    rows: Sequence[FaultRow]


def markdown(
    rows: Sequence[FaultRow],
    command: str,
    revision: str,
    bounds: Sequence[DriftBound] = (),
    beside: Sequence[Beside] = (),
) -> str:
    """The whole page. ``beside``: other benches, told by their totals and by what is otherwise than on the first."""
    total = totals(rows)
    single = [row for row in rows if not row.fault.is_pair]
    return HEAD.format(
        bound=_bound(bounds),
        beside="".join(_beside(other, rows) for other in beside),
        matrix="\n".join(_matrix(single)),
        command=command,
        revision=revision,
        names=", ".join(dict.fromkeys(row.point for row in rows)),
        phases="\n".join(_phases(rows)),
        unexpected="\n".join(_unexpected(rows)) or "None.",
        known=total["of_these_known_within_20_ms"],
        known_ours=total["ours_known_within_20_ms"],
        ours=total["ours_moving_the_tip_5_um"],
        known_blind=total["of_these_known_within_20_ms"] - total["ours_known_within_20_ms"],
        blind=total["moving_the_tip_5_um"] - total["ours_moving_the_tip_5_um"],
        moving=total["moving_the_tip_5_um"],
        unseen="\n".join(_unseen(single)) or "Nothing.",
        rows="\n".join(_line(row) for row in single),
        **{key: value for key, value in total.items() if f"{{{key}}}" in HEAD},
    )


def _phases(rows: Sequence[FaultRow]) -> list[str]:
    lines: list[str] = []
    every = [(row, o) for row in rows for o in row.observations]
    for is_pair in (False, True):
        for phase in (START, *PHASES):
            here = [(row, o) for row, o in every if o.phase == phase.name and row.fault.is_pair == is_pair]
            if not here:
                continue
            good = sum(row.is_as_expected(o) for row, o in here)
            unsafe = sum(o.false_neutral or (o.rough > 0 and not row.fault.own_output) for row, o in here)
            moving = [o for _, o in here if o.moved_ms is not None] if not is_pair else []
            known = f"{sum(not moved_unseen(o) for o in moving)} of {len(moving)}" if moving else "-"
            lines.append(f"| {'pairs, ' * is_pair}{phase.name} | {len(here)} | {good} | {known} | {unsafe} |")
    return lines


def _unexpected(rows: Sequence[FaultRow]) -> list[str]:
    lines: list[str] = []
    for row in rows:
        for phase in (START, *PHASES):
            wrong = [o for o in row.observations if o.phase == phase.name and not row.is_as_expected(o)]
            misnamed = [o for o in row.observations if o.phase == phase.name and row.is_misnamed(o)]
            if misnamed:
                lines.append(
                    f"- {row.fault.name}, {row.point} hand, {phase.name}: the message does not name the cause: "
                    f'"{_short(misnamed[0].message)}" ({len(misnamed)})'
                )
            if wrong:
                answers = ", ".join(sorted({o.answer for o in wrong}))
                lines.append(
                    f"- {row.fault.name}, {row.point} hand, {phase.name}: {answers} instead of {row.fault.expected} "
                    f"({len(wrong)} of {sum(o.phase == phase.name for o in row.observations)})"
                )
    return lines


def _unseen(rows: Sequence[FaultRow]) -> list[str]:
    lines: list[str] = []
    for name in dict.fromkeys(row.fault.name for row in rows):
        own_rows = [row for row in rows if row.fault.name == name]
        late, unsafe = sum(row.late for row in own_rows), sum(o.rough for row in own_rows for o in row.observations)
        blind = not own_rows[0].fault.is_told_in_time
        if not (late or blind or unsafe):
            continue
        runs = sum(row.seeds for row in own_rows)
        detected = sum(row.detected for row in own_rows)
        worst_um = max(o.astray_um for row in own_rows for o in row.observations)
        slow = " (slow)" if own_rows[0].fault.slow else ""
        text = f"- **{name}**{slow}: known in {detected} of {runs} runs, in {late} later than 20 ms after 5 um; "
        text += f"tip error up to {worst_um:.0f} um"
        text += (
            f"; {unsafe} {'jumps of its own' if own_rows[0].fault.own_output else 'unsafe demands'}" if unsafe else ""
        )
        lines.append(text + (f". {own_rows[0].fault.why}." if own_rows[0].fault.why else "."))
    return lines


def _line(row: FaultRow) -> str:
    table = row.as_dict()
    detect, answer = table["detect_ms"], table["answer_ms"]
    known = "-" if detect["p50"] is None else f"{detect['p50']:.1f} / {detect['max']:.1f}"
    neutral = "-" if answer["max"] is None else f"{answer['max']:.1f}"
    if table["not_confirmed"]:
        neutral = f"NOT confirmed ({table['not_confirmed']} of {row.seeds})"
    return (
        f"| {row.fault.name} | {row.point} | {row.answer} | {known} | {neutral} | {table['tip_error_um_max']:.1f} | "
        f"{row.as_expected}/{row.seeds} |"
    )


THEN = {
    "refused": "does not start: mend, start again",
    "safe state": "latched: mend, start again",
    "holds": "holds at neutral until it passes; latches after 3 s",
    "resumes": "holds at neutral, goes on by itself",
    "noticed": "goes on, counted",
    "none": "goes on",
}


def _matrix(rows: Sequence[FaultRow]) -> list[str]:
    lines: list[str] = []
    for name in dict.fromkeys(row.fault.name for row in rows):
        own_rows = [row for row in rows if row.fault.name == name]
        first_message = next((row.known_by for row in own_rows if row.known_by), "-")
        reported = sum(1 for row in own_rows for o in row.observations if o.known_by)
        named = f"{sum(row.isolated for row in own_rows)} of {reported}" if reported else "-"
        answers = [row.answer for row in own_rows]
        then = THEN[max(sorted(set(answers)), key=answers.count)]
        if any(not o.confirmed for row in own_rows for o in row.observations):
            then = "latched: switch the amplifier off"
        lost = max(o.lost for row in own_rows for o in row.observations)
        lines.append(f"| {name} | {_short(first_message)} | {named} | {then} | {lost} |")
    return lines


def _short(text: str, most: int = 90) -> str:
    text = text.replace("|", "/").replace("\n", " ")
    return text if len(text) <= most else text[: most - 2].rsplit(" ", 1)[0] + " .."


def _bound(bounds: Sequence[DriftBound]) -> str:
    if not bounds:
        return ""
    lines = "\n".join(
        f"| {b.rate_V_per_s:g} V/s | {b.point} | {b.moved_ms:.0f} | {100.0 * b.seen_part:.1f} % | "
        f"{b.least_V_per_s:.3f} V/s |"
        for b in bounds
    )
    return f"""### What any detector could know of a drift

A detector that is given the spectra of hand and noise, the axis, the instant and the rate of the drift is a matched
filter, and none sees it more often (`tools/research/faults/drift_bound.py`, Neyman-Pearson). With {FALSE_PER_HOUR:g}
false alarms an hour, each of which ends a run, within 20 ms of 5 um:

| drift | hand | 5 um after ms | seen at best | seen in {100.0 * SEEN:.0f} % from |
|---|---|---|---|---|
{lines}

A real detector knows none of that. Below the last column "all within 20 ms" cannot be reached with six axes.

"""


def _beside(other: Beside, first: Sequence[FaultRow]) -> str:
    total = totals(other.rows)
    usual = {(row.fault.name, row.point): row.answer for row in first}
    differs = [row for row in other.rows if usual.get((row.fault.name, row.point)) != row.answer]
    table = "\n".join(_line(row) for row in differs)
    chosen = f' (faults with "{other.chosen}" in their names)' if other.chosen else ""
    return f"""### Beside it: `{other.bench}`{chosen}

{total["faults"]} kinds of fault, {total["runs"]} runs: {total["as_expected"]} answered as expected;
{total["of_these_known_within_20_ms"]} of {total["moving_the_tip_5_um"]} that moved the tip more than 5 um were known
within 20 ms; {total["unsafe_outputs"]} unsafe outputs, {total["uncounted_samples"]} uncounted samples,
{total["wrong_messages"]} wrong messages. Not seen or too late:

{chr(10).join(_unseen(other.rows)) or "Nothing."}

Answered otherwise than on the first bench:

| fault | hand | answer | known after p50 / max | neutral after max | tip error max | as expected |
|---|---|---|---|---|---|---|
{table}

"""
