"""Checks tables of configuration files: ranges that members share, and errors that name file and key."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hal.errors import BenchError

_Model = TypeVar("_Model", bound=BaseModel)

Positive = Annotated[float, Field(gt=0.0, le=1e12)]
"""Any quantity of a configuration in its unit; beyond the limit nothing is meant, and products overflow."""
NotNegative = Annotated[float, Field(ge=0.0, le=1e12)]
"""The same with zero."""


class StrictTable(BaseModel):
    """Refuses keys that it does not know, and does not change once it is made."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def describe_validation_error(error: ValidationError, where: str) -> str:
    """Return one line per wrong key: file, key, and what is wrong with it."""
    lines: list[str] = []
    for item in error.errors():
        key = ".".join(str(part) for part in item["loc"] if part not in ("serial", "i2c", "can")) or "(top level)"
        message = item["msg"]
        if item["type"] == "extra_forbidden":
            message = "unknown key; check the spelling"
        elif item["type"] == "missing":
            message = "this key is missing"
        elif item["type"] == "value_error":
            message = message.removeprefix("Value error, ")
        lines.append(f"{where}: [{key}] {message}")
    return "\n".join(lines)


def validate_table(model: type[_Model], table: Mapping[str, Any], where: str) -> _Model:
    """Return ``table`` as ``model``. Raises a ``BenchError`` that names file and key when that is impossible."""
    try:
        return model.model_validate(dict(table))
    except ValidationError as error:
        raise BenchError(describe_validation_error(error, where)) from error
