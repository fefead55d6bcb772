"""Reads and writes the weights of a cascade network as versioned JSON, which is checked when read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hal.errors import BenchError
from hal.validation import Positive, describe_validation_error
from tools.research.tremor.cascade import CascadeNetwork


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    format: Literal[1]
    what: Literal["micron cascade network"]
    target: Literal["voluntary", "error"]
    rate_hz: Positive
    window: Annotated[int, Field(ge=1, le=2000)]
    spacing: Annotated[int, Field(ge=1, le=100)]
    scale_m: Positive
    centred: bool
    kinds: tuple[str, ...]
    hidden: tuple[tuple[float, ...], ...]
    output: tuple[float, ...]
    note: str = ""


def network_text(network: CascadeNetwork) -> str:
    """Return the file's text. Hidden weights are stored as triangles: each unit's own inputs only."""
    first = 1 + network.window
    table: dict[str, Any] = {
        "format": 1,
        "what": "micron cascade network",
        "note": network.note,
        "target": network.target,
        "rate_hz": network.rate_hz,
        "window": network.window,
        "spacing": network.spacing,
        "scale_m": network.scale,
        "centred": network.centred,
        "kinds": list(network.kinds),
        "hidden": [row[: first + h].tolist() for h, row in enumerate(network.hidden)],
        "output": network.output.tolist(),
    }
    return json.dumps(table) + "\n"


def load_network(path: Path) -> CascadeNetwork:
    """Return the network of a weights file. Raises ``BenchError``: what, where, what to do."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BenchError(f"{path}: weights cannot be read ({error}); make them with 'micron tremor train'") from error
    try:
        file = _File.model_validate_json(text)
    except ValidationError as error:
        wrong = describe_validation_error(error, str(path))
        raise BenchError(f"{wrong}\nmake it again with 'micron tremor train'") from None
    wide = 1 + file.window + len(file.kinds)
    hidden = np.zeros((len(file.kinds), wide))
    if len(file.hidden) != len(file.kinds):
        raise BenchError(f"{path}: {len(file.kinds)} kinds but {len(file.hidden)} rows of hidden weights")
    for h, row in enumerate(file.hidden):
        if len(row) != 1 + file.window + h:
            raise BenchError(f"{path}: hidden unit {h} has {len(row)} weights, needs {1 + file.window + h}")
        hidden[h, : len(row)] = row
    try:
        return CascadeNetwork(
            file.window,
            file.spacing,
            file.rate_hz,
            file.target,
            file.scale_m,
            file.centred,
            file.kinds,
            hidden,
            np.asarray(file.output, dtype=np.float64),
            file.note,
        )
    except ValueError as error:
        raise BenchError(f"{path}: {error}") from None
