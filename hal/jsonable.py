"""Values of the program as values of JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np


def to_jsonable(value: Any) -> Any:
    """Return ``value`` as plain JSON values.

    Arrays and numpy scalars are unpacked, NaN and infinities are null, models are dumped, and the rest is text.
    """
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): to_jsonable(v) for k, v in cast(Mapping[Any, Any], value).items()}
    if isinstance(value, list | tuple):
        return [to_jsonable(v) for v in cast(Sequence[Any], value)]
    if isinstance(value, np.generic | np.ndarray):
        return to_jsonable(cast(Any, value).tolist())
    if hasattr(value, "model_dump"):  # pydantic
        return value.model_dump(mode="json")
    return str(value)
