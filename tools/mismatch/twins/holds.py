"""Reads the hold of each input of a twin: its course between the samples."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from tools.errors import RecordingError
from tools.mismatch.recording import Recording
from tools.mismatch.twins.linear import Hold

Holds = Mapping[str, Hold]
"""The hold of each input."""
EVERY: tuple[Hold, ...] = ("zero", "linear", "smooth")
STRAIGHT_OR_HELD: tuple[Hold, ...] = ("zero", "linear")


def declared_holds(recording: Recording) -> dict[str, str]:
    """Return the hold of each input for which ``[twin.parameters]`` states one."""
    given = recording.twin.parameters.get("hold")
    if given is None:
        return {}
    return {str(s): str(v) for s, v in given.items()} if isinstance(given, Mapping) else _each(recording, str(given))


def read_holds(recording: Recording, allowed: Iterable[Hold] = EVERY) -> Holds:
    """Return the hold of every input: one for all, or a table by input; an input without one is linear.

    Raises RecordingError for another hold than the ``allowed`` ones and for a name that is no input.
    """
    where = f"{recording.path}: [twin.parameters] hold"
    known: dict[str, Hold] = {str(h): h for h in allowed}
    found: dict[str, Hold] = dict.fromkeys(recording.inputs, "linear")
    for s, h in declared_holds(recording).items():
        if s not in found:
            raise RecordingError(f"{where} names '{s}', which is no input; inputs: {', '.join(found)}")
        if h not in known:
            *most, last = (f"'{k}'" for k in known)
            raise RecordingError(f"{where} must be {', '.join(most)} or {last}, got {h!r}")
        found[s] = known[h]
    return found


def common_hold(recording: Recording, allowed: Iterable[Hold] = STRAIGHT_OR_HELD) -> Hold:
    """Return the hold of all inputs, for a simulation that can have but one. Raises RecordingError if they differ."""
    holds = read_holds(recording, allowed)
    kinds = set(holds.values())
    if len(kinds) > 1:
        raise RecordingError(
            f"{recording.path}: [twin.parameters] hold differs between inputs; a twin of kind"
            f" '{recording.twin.kind}' has one for all"
        )
    return kinds.pop() if kinds else "linear"


def holds_text(holds: Holds) -> Any:
    """Return what ``[twin.parameters] hold`` states: a word if all inputs are alike, else a table."""
    kinds = set(holds.values())
    return kinds.pop() if len(kinds) == 1 else dict(holds)


def _each(recording: Recording, hold: str) -> dict[str, str]:
    return dict.fromkeys(recording.inputs, hold)
