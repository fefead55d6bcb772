"""Joins several recordings of a system: finds them, checks them against each other, concatenates them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tools.errors import InputError, RecordingError
from tools.mismatch.batch import find, is_folder_of_recordings
from tools.mismatch.recording import Part, Recording, Split
from tools.mismatch.recording_load import load
from tools.mismatch.recording_ranges import APART
from tools.mismatch.twins.make import make

CLOSE_RATE = 1e-6
START = "x0"
"""The parameter of a twin that is the state of the first sample."""


def recordings_of(paths: Sequence[Path]) -> dict[str, Path]:
    """Return the recordings that a command line names (recordings, folders, quoted patterns), each once, by name.

    Raises InputError if a path holds no recording.
    """
    found: list[Path] = []
    for path in paths:
        if not path.exists() and any(c in str(path) for c in "*?["):
            matches = sorted(Path(path.anchor or ".").glob(str(path.relative_to(path.anchor) if path.anchor else path)))
            if not matches:
                raise InputError(f"{path}: no file or folder matches this pattern")
        else:
            matches = [path]
        for one in matches:
            if one.is_file() and one.suffix != ".toml":
                raise InputError(f"{one}: is not a recording; name its folder or its .toml file")
            found += [*find(one).values()] if is_folder_of_recordings(one) else [one]
    named = [p / "recording.toml" if p.is_dir() else p for p in found]
    # a recording with two names is one; the first name in the command stays
    files = list({p.resolve(): p for p in reversed(named)}.values())[::-1]
    whole = [p.parent if p.name == "recording.toml" else p.with_suffix("") for p in files]
    if len(whole) < 2:
        return dict(zip(map(str, whole), files, strict=True))
    above = _folder_above([w.parent for w in whole])
    return {os.path.relpath(w, above): p for w, p in zip(whole, files, strict=True)}


def _folder_above(folders: Sequence[Path]) -> Path:
    """Return the deepest folder that holds all ``folders``, relative to the current one if they all are."""
    if any(f.is_absolute() for f in folders):
        folders = [f.absolute() for f in folders]
    return Path(os.path.commonpath(folders) or ".")


def load_together(paths: Sequence[Path], per_recording: Sequence[str] = ()) -> Recording:
    """Return the recordings of a command line as one, each a part of it with its own start and conditions.

    Raises RecordingError or InputError if there is only one, if two do not match (twin, channels, units, rate), or if
    ``per_recording`` names no parameter of the twin or of an effect.
    """
    found = recordings_of(paths)
    if len(found) < 2:
        raise InputError(f"--together needs at least two recordings, and {paths[0]} is one; leave --together out")
    loaded = {name: load(path) for name, path in found.items()}
    first = next(iter(loaded.values()))
    for other in loaded.values():
        _check_alike(first, other)
    joined = join(loaded, tuple(per_recording))
    _check_names(joined)
    return joined


def _check_alike(first: Recording, other: Recording) -> None:
    """Refuse two recordings of different systems; the message names both files and the difference."""
    both = f"{first.path} and {other.path} cannot be diagnosed together"
    if first.twin.kind != other.twin.kind:
        raise RecordingError(
            f"{both}: the twin of one is {first.twin.kind}, of the other {other.twin.kind}; give both the same [twin]"
        )
    if first.twin.kind not in APART:
        raise RecordingError(f"{first.path}: a twin of kind '{first.twin.kind}' runs through; diagnose each by itself")
    for kind in ("inputs", "outputs", "context"):
        a, b = set(getattr(first, kind)), set(getattr(other, kind))
        if a != b:
            raise RecordingError(
                f"{both}: only one of them has the {kind.rstrip('s')} {', '.join(sorted(a ^ b))};"
                " give both the same channels"
            )
    for signal, unit in first.unit.items():
        if other.unit[signal] != unit:
            raise RecordingError(
                f"{both}: '{signal}' is in {unit} in one and in {other.unit[signal]} in the other; name one"
            )
        if other.file_unit[signal] != first.file_unit[signal]:
            raise RecordingError(
                f"{both}: '{signal}' is in {first.file_unit[signal]} in one file and in {other.file_unit[signal]}"
                " in the other; one of them may be wrong: bring both to one unit"
            )
    if abs(first.dt / other.dt - 1) > CLOSE_RATE:
        raise RecordingError(
            f"{both}: one has {1 / first.dt:g} samples per second, the other {1 / other.dt:g};"
            " 'micron mismatch new DATA --resample HZ' brings one to the rate of the other"
        )
    if not _is_one_twin(first, other):
        raise RecordingError(f"{both}: their [twin] tables differ; one twin holds for all, so give one file to both")


def _is_one_twin(first: Recording, other: Recording) -> bool:
    """Return True if the twins of two recordings differ at most in the state of the first sample.

    That state belongs to a recording. The value of a constant state is a parameter of the twin and has to be the same.
    """
    if first.twin.effects != other.twin.effects:
        return False
    a, b = (dict(r.twin.parameters) for r in (first, other))
    if _plain(a) == _plain(b):
        return True
    if _plain({**a, START: None}) != _plain({**b, START: None}):
        return False
    return np.array_equal(make(first).start(first), make(other).start(other))


def _plain(parameters: object) -> str:
    return repr(sorted(parameters.items())) if isinstance(parameters, dict) else repr(parameters)


def join(loaded: dict[str, Recording], per_recording: tuple[str, ...] = ()) -> Recording:
    """Return matching recordings one behind the other; each keeps its segments."""
    all_of = list(loaded.values())
    first = all_of[0]
    begins = np.cumsum([0, *(r.n for r in all_of)])
    parts = tuple(
        Part(name, int(a), int(b), r.conditions)
        for (name, r), a, b in zip(loaded.items(), begins[:-1], begins[1:], strict=True)
    )
    segments = tuple(int(a + s) for r, a in zip(all_of, begins[:-1], strict=True) for s in ((0, *r.segments)))
    signals = {
        kind: {s: np.concatenate([getattr(r, kind)[s] for r in all_of]) for s in getattr(first, kind)}
        for kind in ("inputs", "outputs", "context")
    }
    notes = [f"{name}: {note}" for name, r in loaded.items() for note in r.warnings]
    notes += [f"{name}: its [split] is not used" for name, r in loaded.items() if r.split != Split()]
    return replace(
        first,
        path=_folder_above([r.path.parent for r in all_of]),
        title=f"{len(all_of)} recordings",
        t=np.arange(int(begins[-1])) * first.dt,
        split=Split(),
        warnings=tuple(notes),
        segments=segments[1:],
        conditions={},
        parts=parts,
        per_recording=per_recording,
        **signals,
    )


def _check_names(recording: Recording) -> None:
    """Refuse a ``--per-recording`` that is neither a base parameter nor an effect with that parameter."""
    from sim_devices.physics.catalogue import EFFECTS
    from tools.mismatch.engine.many import free_names
    from tools.mismatch.simulate import Model
    from tools.mismatch.twins.make import make

    known = free_names(Model(make(recording)))
    for name in recording.per_recording:
        effect, dot, parameter = name.partition(".")
        if name in known:
            continue
        if effect not in EFFECTS:
            raise InputError(
                f"--per-recording {name}: the twin has no such parameter and there is no such effect; it has"
                f" {', '.join(known)}, and 'micron mismatch physics' lists the effects"
            )
        parts = EFFECTS[effect].parts({})
        names = [p.name for p in (*parts.nonlinear, *parts.weights)]
        if dot and parameter not in names:
            raise InputError(f"--per-recording {name}: {effect} has no such parameter; it has {', '.join(names)}")
