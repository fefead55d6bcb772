"""Reads the data sheets in ``data_sheets``: what a part measures or moves, in which unit and range, and how fast.

They are written from the makers' documents without a look at the drivers; ``test_sheets`` compares both.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from hal.types import ChannelInfo

FOLDER = Path(__file__).parent / "data_sheets"


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SheetChannel(_Table):
    """``name`` is the driver's channel name without the bench's device name; all numbers in ``unit``."""

    name: str
    unit: str
    lo: float
    hi: float
    epsilon: float = Field(gt=0)
    section: str

    def info(self) -> ChannelInfo:
        return ChannelInfo(self.name, self.unit, self.lo, self.hi, self.epsilon)


class SheetTimes(_Table):
    """``start_up_s`` from power to valid values, ``answer_limit_s`` what the driver waits for an answer at most,
    ``settle_s`` from a command to its effect."""

    start_up_s: float = Field(ge=0)
    answer_limit_s: float = Field(ge=0)
    settle_s: float = Field(ge=0)
    section: str


class Sheet(_Table):
    part: str
    maker: str
    source: str
    bus: str
    identity: str
    times: SheetTimes
    channels: tuple[SheetChannel, ...] = Field(min_length=1)
    notes: tuple[str, ...] = ()


def names() -> list[str]:
    """Drivers that have a sheet."""
    return sorted(file.stem for file in FOLDER.glob("*.toml"))


def load_sheet(name: str) -> Sheet:
    """The sheet of driver ``name``."""
    text = (FOLDER / f"{name}.toml").read_text(encoding="utf-8")
    return Sheet.model_validate(tomllib.loads(text))
