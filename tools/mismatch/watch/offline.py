"""Tests a finished recording against a twin: when and where the recorded channels depart from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tools.errors import InputError
from tools.mismatch import units
from tools.mismatch.export.run import simulate_file
from tools.mismatch.recording import Recording
from tools.mismatch.recording_load import load
from tools.mismatch.watch.detector import Alarm, State, begin, follow, interrupt
from tools.mismatch.watch.reference import Array, Reference, learn

LONGEST_REFERENCE_S = 300.0
REFERENCE_SHARE = 1 / 3
PER_HOUR = 0.01
"""Default rate of false alarms of a watch, per hour, of all channels together."""


@dataclass(frozen=True)
class Departure:
    """Describes the departure of a channel from its twin.

    It holds the times of the first and last alarm and of the onset (s of the recording), the figure of the whitened
    residual that changed, and the rms of the residual in the reference and since the onset, in ``unit``.
    """

    channel: str
    onset_s: float
    alarm_s: float
    last_s: float
    alarms: int
    figure: str
    rises: bool
    size: float
    unit: str
    reference_rms: float
    since_rms: float


@dataclass(frozen=True)
class Watched:
    """Holds the result of a watch over a recording: ``departures`` by onset, ``left_out`` channels with the reason."""

    twin: str
    recording: str
    reference_s: tuple[float, float]
    watched_s: tuple[float, float]
    block_s: float
    false_alarms_per_hour: float
    channels: tuple[str, ...]
    left_out: Mapping[str, str]
    departures: tuple[Departure, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the JSON of the command."""
        return {"format": 1, "verdict": "leaves" if self.departures else "stays", **asdict(self)}


def watch_recording(
    twin: Path, recording: Path, reference_s: float | None = None, false_alarms_per_hour: float = PER_HOUR
) -> Watched:
    """Run ``twin`` freely beside ``recording`` and test its residual after the first ``reference_s`` seconds.

    The default reference is a third of the recording, at most 300 s. Raises InputError or RecordingError for a fault of
    twin, recording or reference.
    """
    loaded = load(recording)
    found = simulate_file(twin, recording)
    residuals = {o: units.convert(loaded.outputs[o], loaded.unit[o], loaded.file_unit[o]) - y for o, y in found.items()}
    begin_s = float(loaded.t[0])
    stop = _reference_end(loaded, reference_s)
    reference = learn(
        {o: r[:stop] for o, r in residuals.items()}, loaded.dt, false_alarms_per_hour, loaded.segments_of(0, stop)
    )
    table = np.column_stack([residuals[c.name] for c in reference.channels])
    alarms = _follow_all(reference, table, stop, loaded.segments)
    return Watched(
        str(twin),
        str(recording),
        (begin_s, begin_s + stop * loaded.dt),
        (begin_s + stop * loaded.dt, begin_s + loaded.n * loaded.dt),
        reference.block * reference.dt,
        false_alarms_per_hour,
        tuple(c.name for c in reference.channels),
        dict(reference.left_out),
        _departures(loaded, reference, residuals, alarms, begin_s),
    )


def _reference_end(recording: Recording, reference_s: float | None) -> int:
    whole_s = recording.n * recording.dt
    if reference_s is None:
        return round(min(LONGEST_REFERENCE_S, REFERENCE_SHARE * whole_s) / recording.dt)
    if not 0.0 < reference_s < whole_s:
        raise InputError(
            f"--reference {reference_s:g}: {recording.path} lasts {whole_s:g} s; "
            "the reference is its first part and leaves the rest to be watched"
        )
    return round(reference_s / recording.dt)


def _follow_all(reference: Reference, table: Array, stop: int, segments: tuple[int, ...]) -> list[Alarm]:
    """Return alarms after sample ``stop``; whitening starts at the reference's end and restarts in each segment."""
    first = max(0, stop - reference.warm_up)
    inside = [s for s in segments if s > first]
    state: State = begin(reference)
    alarms: list[Alarm] = []
    for a, b in zip((first, *inside), (*inside, table.shape[0]), strict=True):
        state, more = follow(reference, interrupt(state), table[a:b])
        alarms += more
    shift_s = first * reference.dt
    return [Alarm(**{**asdict(a), "t_s": a.t_s + shift_s, "onset_s": a.onset_s + shift_s}) for a in alarms]


def _departures(
    recording: Recording, reference: Reference, residuals: Mapping[str, Array], alarms: list[Alarm], begin_s: float
) -> tuple[Departure, ...]:
    out: list[Departure] = []
    for channel in reference.channels:
        own = [a for a in alarms if a.channel == channel.name]
        if not own:
            continue
        first, last = own[0], own[-1]
        a, b = round(first.onset_s / recording.dt), round(last.t_s / recording.dt)
        since = residuals[channel.name][a:b]
        out.append(
            Departure(
                channel.name,
                begin_s + first.onset_s,
                begin_s + first.t_s,
                begin_s + last.t_s,
                len(own),
                first.figure,
                first.rises,
                first.size,
                recording.file_unit[channel.name],
                channel.rms,
                float(np.sqrt(np.nanmean(since**2))),
            )
        )
    return tuple(sorted(out, key=lambda d: (d.onset_s, d.alarm_s)))


def lines(watched: Watched) -> list[str]:
    """Return the lines that the command prints, a sentence per line."""
    (a, b), (c, d) = watched.reference_s, watched.watched_s
    count = len(watched.channels)
    where = "in one channel" if count == 1 else f"in {count} channels together"
    out = [
        f"Reference: {a:.4g} to {b:.4g} s. Watched: {c:.4g} to {d:.4g} s in blocks of {watched.block_s:.3g} s, at most "
        f"{watched.false_alarms_per_hour:g} false alarms per hour {where}."
    ]
    for departure in watched.departures:
        out.append(sentence(departure))
    stay = [name for name in watched.channels if name not in {e.channel for e in watched.departures}]
    if stay:
        out.append(f"{', '.join(stay)}: no alarm.")
    out += [f"Not watched: {name}: {why}." for name, why in watched.left_out.items()]
    if watched.departures:
        first = watched.departures[0]
        out.append(f"Reality leaves the twin at about {first.onset_s:.2f} s, first in {first.channel}.")
    else:
        out.append("Reality does not leave the twin.")
    return out


def sentence(departure: Departure) -> str:
    """Return a departure in words."""
    d, verb = departure, "rises" if departure.rises else "falls"
    return (
        f"{d.channel}: leaves the twin at about {d.onset_s:.2f} s (alarm {d.alarm_s:.2f} s, last {d.last_s:.2f} s): "
        f"the {d.figure} of its residual {verb}; rms {d.reference_rms:.3g} -> {d.since_rms:.3g} {d.unit}."
    )
