"""Writes the newest rows of a watched run as a recording that the engine can diagnose with the same twin."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tools.errors import InputError
from tools.mismatch.recording import Array
from tools.mismatch.watch.frame import LiveTwin
from tools.mismatch.watch.live import GAP
from tools.output import write_text_atomic
from tools.toml_text import toml_text

LEAST_S = 5.0


def write_recording(folder: Path, source: Path, twin: LiveTwin, t_s: Array, columns: Mapping[str, Array]) -> None:
    """Write ``recording.toml`` and its data to ``folder``: the part of ``t_s`` (n,) behind its last gap.

    ``source``: the twin's file; ``columns`` (n,): by name, in the units of the frame. Raises InputError if less than
    ``LEAST_S`` remain.
    """
    gaps = np.flatnonzero(np.diff(t_s) > GAP * twin.dt)
    first = int(gaps[-1]) + 1 if gaps.size else 0
    if (t_s.size - first) * twin.dt < LEAST_S:
        raise InputError(
            f"only {(t_s.size - first) * twin.dt:.1f} s without a gap are there; wait until it is {LEAST_S:g} s or more"
        )
    rec = twin.template
    parameters = dict(rec.twin.parameters)
    folder.mkdir(parents=True, exist_ok=True)
    if rec.twin.kind == "instrument":
        bench = source.parent / str(parameters["bench"])
        write_text_atomic(folder / "bench.toml", bench.read_text(encoding="utf-8"))
        parameters["bench"] = "bench.toml"
        if parameters.get("hand") == "bench":
            parameters["start_s"] = twin.start_s + float(t_s[first])
    roles = {**dict.fromkeys(rec.inputs, "input"), **dict.fromkeys(rec.outputs, "output")}
    channels = [
        {"column": c, "role": roles.get(s, "context"), "signal": s, "unit": rec.file_unit[s]}
        for s, c in rec.column.items()
    ]
    data = {c: np.asarray(x[first:], np.float64) for c, x in columns.items()}
    np.savez_compressed(folder / "data.npz", **data)  # pyright: ignore[reportArgumentType]
    head = {"format": 1, "title": f"the last {(t_s.size - first) * twin.dt:.0f} s of a watched run", "data": "data.npz"}
    table = {"kind": rec.twin.kind, "parameters": parameters, "effects": list(rec.twin.effects)}
    text = toml_text({**head, "rate_hz": 1.0 / twin.dt, "twin": table, "channels": channels})
    write_text_atomic(folder / "recording.toml", text)
