"""What the checked entries of a bench file are made of."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import AfterValidator, BaseModel, ConfigDict, Field


class Options(BaseModel):
    """A driver's own keys; unknown ones are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class DaqOptions(Options):
    """What every DAQ's entry says; a driver may narrow it. ``channels`` in the order of a scan."""

    rate_hz: float = Field(gt=0)
    channels: tuple[int, ...] = Field(min_length=1)
    range_V: float = Field(gt=0)


def one_of(*allowed: float) -> AfterValidator:
    """A number that must be one of ``allowed``."""

    def check(value: float) -> float:
        if value not in allowed:
            raise ValueError(f"{value:g} is not one of {', '.join(f'{a:g}' for a in allowed)}")
        return value

    return AfterValidator(check)


@dataclass(frozen=True)
class BusLoad:
    """Seconds of bus time per second that one device asks for, and how that comes about."""

    bus: str
    device: str
    share: float
    arithmetic: str
