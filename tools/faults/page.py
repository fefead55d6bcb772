"""The campaign as a page: docs/reliability.md is made by ``micron faults --out``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tools.faults.campaign import FaultRow, moved_unseen, totals
from tools.faults.drift_bound import FALSE_PER_HOUR, SEEN, DriftBound
from tools.faults.phases import PHASES, START

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
that work (`tools/faults/phases.py`). Uncounted: scans that the device took and that are neither received, nor reported
lost, nor unread at the end. Of a pair on one bus both faults act.

How the grading changed after a look at campaigns before this one (seeds 77, 133569468, 46657867, 103200270, 35582166):
faults in self-test and hold are watched until outputs work; a fault that strikes at random and has not is answered
rightly by nothing; "cannot be seen" may be seen by the self-test; a wrong bit in one command of ten is "slow" on a
bench that does not read commands back, and not counted among what it can tell within 20 ms; the second fault of a pair
on one bus no longer replaces the first; neutral may come later than 21 ms where the hold's report says so and when.

## Answers that were not as expected

{unexpected}

## What is not seen, or too late

{unseen}

{bound}{beside}## When the firmware is gone: the guardian

A DAC has no watchdog. A second process (`firmware_py/guardian`) holds a heartbeat in shared memory, a mark there that
the kernel sets when the firmware's loop dies (a robust mutex), and a connection of its own to the amplifier's bus. It
starts with every `micron run` on a bench whose output is a `dac_amplifier` (`[firmware.safety] guardian = false`
leaves it out). Death: the guardian looks at the mark every millisecond and ramps at once, 16 steps of a millisecond,
reads back, and watches for 50 ms for a command that was still under way. The mark does not wait for the memory of the
dead to be freed, as a pipe does: on a machine where neutral came 62 to 78 ms after `kill -9` with a pipe, it comes
after 17 ms. Silence: noticed after 8 ms, taken over after 41 ms.

The outputs belong to one of the two at any time. Every command of the firmware renews a lease of 40 ms; immediately
before a transfer the firmware writes the command into shared memory, then looks whether the guardian has the outputs or
its lease is over, and only then sends. A lease that is over stays over: the firmware goes to its safe state, says so,
and sends nothing more. The guardian waits until the lease has certainly expired, takes the outputs, and a step later
looks whether a command was going out: none, or one that the DAC holds already, and it ramps; one that is still to come
(the firmware stands still between its look and the wire), and it ends the firmware's process first and waits for the
kernel to confirm that. Where it may not end it (firmware inside another program) it waits 100 ms, and its report says
that a command may have come afterwards. The other way round the firmware ends a guardian that has not reached neutral
22 ms after it took the outputs, and then ramps itself. Heartbeats go both ways: a guardian whose process has ended
(known within 10 ms) or that is not heard for 100 ms is a finding. The outputs ramp to neutral and hold there, a new
guardian is started, and they move again once it watches; one that does not come up within 10 s latches. Nothing is
armed without a sign of life of the guardian. `tests/unit/guardian/test_exclusive.py` tries stalls of twelve lengths at
seven phases of a tick, in virtual time, exactly.

When the bus or the amplifier does not answer, firmware and guardian try again for `[firmware.safety] neutral_retry_s`
(10 s), every millisecond at first and then every 10 ms, and open a connection anew that failed. While the bus answers
nobody, neither ends the other: a command that waits there is no command that stands still, and a guardian that cannot
ramp is no guardian that does not come. A hold whose ramp fails for 40 ms becomes the end of the run; what comes back
within the time is ramped and read back, and the report says after how many milliseconds (`late_ms`). What does not is
called "neutral NOT confirmed"; an interrupt ends the tries. A run waits for its guardian before it ends the emulated
world, and the world outlives a killed firmware until its guardian has done.

`tests/unit/guardian` asserts neutral within 20 ms of death in virtual time, also with half of the transfers lost;
`tests/hil/test_guardian_process.py` kills and stops the real processes (firmware, guardian, emulated world), and
compares the time to neutral by the devices' own record with the time that a bare pipe needs on the same machine.
Limits: it runs on the same host, so it does not help when the host or the bus adapter loses power or the kernel stops;
that needs a watchdog at the amplifier (the CAN node has one, 10 ms). E-727 and NI outputs have no guardian. On a
machine without real-time priority, or with more work than processors, the ramp begins when the guardian is given the
processor.

## What measures the amplifier

`[device.monitor]` reads the voltages at the stacks through an ADS1115, each output every 7.5 ms, and compares with
the mean of the commands that may have been in force during the conversion: within `tolerance_V`, and within
`change_V` of what is usual for that output (`drivers/amplifier_monitor.py`). A bench without it does not see open,
shorted, stuck, slow or weak amplifiers.

## Recording

Every finished block survives `kill -9`, truncation at any byte and flipped bits elsewhere; `fdatasync` once a second,
so a power failure takes about a second (simulated by dropping pages that were not synced). A full disk ends the
recording, not the run; a slow one fills a ring of 8 s, and every row that finds no room is counted: see
`docs/recording-format.md`.

## Long runs

Half an hour on all buses and eight hours without wires, by eighths: [long runs](long-runs.md), made by `micron soak`.

## Hostile input

`tests/fuzz` damages sound inputs of every parser (bench files, recordings, csv, npz, mcap, descriptors, hands, FMU
archives, DI-4108 streams, motion card lines, GCS replies, CAN frames, page orders, WebSocket messages, reports) in the
default tests, and replays the corpus in `tests/fuzz/corpus`, which coverage-guided runs have collected; CI goes on from
it with atheris (`make fuzz`, 60 s per parser). Recordings are also changed behind their CRCs (taken apart, changed, put
together with right lengths and CRCs), in both. No declared size is believed: what is unpacked, searched and listed of a
recording is bounded ([the bounds](recording-format.md)) and linear in the size of the file. npz files are read without
pickle, sized before allocation, and unpack to 64 MiB and 200 times their size at most; FMU archives are checked for
paths outside and for size.

## Where else

| what | where it is tried |
|---|---|
| kill -9 of the firmware, of the guardian, SIGSTOP; real processes | `tests/hil/test_guardian_process.py` |
| kill -9 of the emulated world | `tests/hil/test_real_time.py` |
| kill -9 of the recorder | `tests/unit/recording/test_recorder_process.py` |
| slow disk, full disk under a running instrument | `tests/hil/test_disk_faults.py`, `tests/unit/recording` |
| full disk under the results of a run | `tests/unit/reports/test_run_report.py`, `tests/unit/cli/test_output.py` |
| a recording deleted, replaced, cut or moved under the recorder | `tests/unit/recording/test_disturbed.py` |
| recordings copied by other programs, or made to hurt | `tests/unit/recording/test_copies.py`, `test_hostile.py` |
| clocks and counters that wrap: 2^31, 2^32, 2^53 ns | `tests/hil/test_time_marks.py`, [long runs](long-runs.md) |
| bit flips in frames with a checksum | `tests/wire/drivers/test_can_drivers_wire.py`, `test_e727_wire.py` |
| real benches: `micron run --inject`, refused without `--max-effect` | `tests/unit/faults/test_inject.py` |
| secrets in output, logs, recordings | `tests/bench/test_secrets.py` |

## What says so, and what then

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
        mine = [row for row in rows if row.fault.name == name]
        late, unsafe = sum(row.late for row in mine), sum(o.rough for row in mine for o in row.observations)
        blind = not mine[0].fault.is_told_in_time
        if not (late or blind or unsafe):
            continue
        runs = sum(row.seeds for row in mine)
        detected = sum(row.detected for row in mine)
        worst_um = max(o.astray_um for row in mine for o in row.observations)
        slow = " (slow)" if mine[0].fault.slow else ""
        text = f"- **{name}**{slow}: known in {detected} of {runs} runs, in {late} later than 20 ms after 5 um; "
        text += f"tip error up to {worst_um:.0f} um"
        text += f"; {unsafe} {'jumps of its own' if mine[0].fault.own_output else 'unsafe demands'}" if unsafe else ""
        lines.append(text + (f". {mine[0].fault.why}." if mine[0].fault.why else "."))
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
        mine = [row for row in rows if row.fault.name == name]
        said = next((row.known_by for row in mine if row.known_by), "-")
        told = sum(1 for row in mine for o in row.observations if o.known_by)
        named = f"{sum(row.isolated for row in mine)} of {told}" if told else "-"
        answers = [row.answer for row in mine]
        then = THEN[max(sorted(set(answers)), key=answers.count)]
        if any(not o.confirmed for row in mine for o in row.observations):
            then = "latched: switch the amplifier off"
        lost = max(o.lost for row in mine for o in row.observations)
        lines.append(f"| {name} | {_short(said)} | {named} | {then} | {lost} |")
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
filter, and none sees it more often (`tools/faults/drift_bound.py`, Neyman-Pearson). With {FALSE_PER_HOUR:g} false
alarms an hour, each of which ends a run, within 20 ms of 5 um:

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
