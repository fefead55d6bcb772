"""Recordings made in memory, for tests of twins and models."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hal.arrays import Array
from tools.mismatch.recording import Recording, Split, TwinText


def recording(
    kind: str,
    dt: float,
    inputs: dict[str, Array],
    outputs: dict[str, Array],
    units: dict[str, str],
    parameters: dict[str, Any] | None = None,
    context: dict[str, Array] | None = None,
    effects: tuple[dict[str, Any], ...] = (),
) -> Recording:
    n = next(iter(inputs.values())).size
    names = [*inputs, *outputs, *(context or {})]
    return Recording(
        Path("made.toml"),
        "made",
        np.arange(n) * dt,
        dt,
        inputs,
        outputs,
        context or {},
        dict.fromkeys(outputs),
        {s: units.get(s, "1") for s in names},
        {s: s for s in names},
        TwinText(kind, parameters or {}, effects),
        Split(),
    )
