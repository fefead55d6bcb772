"""Defines the signals and units of each twin kind (contract, section 2)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from hal import plugins

Role = Literal["input", "output", "context"]


@dataclass(frozen=True)
class Vocabulary:
    """Maps patterns (full match) to the allowed contract units; ``open_ended`` kinds take any signal."""

    inputs: tuple[tuple[str, tuple[str, ...]], ...] = ()
    outputs: tuple[tuple[str, tuple[str, ...]], ...] = ()
    open_ended: bool = False

    def units(self, role: Role, signal: str) -> tuple[str, ...] | None:
        """Return the allowed contract units; () means any unit, kept as declared; None: no such signal."""
        if role == "context":
            return CONTEXT_UNITS.get(signal, ())
        if self.open_ended:
            return ()
        for pattern, units in self.inputs if role == "input" else self.outputs:
            if re.fullmatch(pattern, signal):
                return units
        return None

    def known(self, role: Role) -> str:
        """Return the signals of a role, for messages."""
        return ", ".join(p for p, _ in (self.inputs if role == "input" else self.outputs))


NO_STATE = "no_state"
"""Name of the one state, which stays at zero, of equations that are a curve."""
CONTEXT_UNITS = MappingProxyType(
    {
        "temperature": ("degC",),
        "supply": ("V",),
        "load": ("N",),
        "actuator_current": ("A",),
        "current": ("A",),
    }
)

KINDS = MappingProxyType(
    {
        "piezo_stack": Vocabulary((("command", ("V",)),), (("displacement", ("um",)),)),
        "accelerometer": Vocabulary((("specific_force_[xyz]", ("g",)),), (("voltage_[xyz]", ("V",)),)),
        "magnetometer": Vocabulary((("field_[xyz]", ("uT",)),), (("voltage_[xyz]", ("V",)),)),
        "accelerometer_cluster": Vocabulary(
            (("specific_force_[xyz]", ("m/s^2",)), ("angular_rate_[xyz]", ("rad/s",))),
            ((r"accel_\w*[xyz]", ("m/s^2",)),),
        ),
        "mechanical_axis": Vocabulary(
            (("force", ("N",)), ("torque", ("N m",))),
            (("position", ("m", "rad")), ("velocity", ("m/s", "rad/s"))),
        ),
        "state_space": Vocabulary(open_ended=True),
        "instrument": Vocabulary(open_ended=True),
        "fmu": Vocabulary(open_ended=True),
        "ode": Vocabulary(open_ended=True),
        "columns": Vocabulary(open_ended=True),
    }
)


def user_kinds() -> Mapping[str, object]:
    """Return the twins that installed packages offer: kind -> entry point (not loaded)."""
    return plugins.offered(plugins.TWINS)


def find_user_kind(kind: str) -> object | None:
    """Return the entry point of the twin ``kind`` of an installed package, not loaded. Raises ``BenchError`` when two
    packages offer it."""
    return plugins.find_entry(plugins.TWINS, kind)


def vocabulary(kind: str) -> Vocabulary | None:
    """Return the vocabulary of a kind, None for an unknown one."""
    if kind in KINDS:
        return KINDS[kind]
    return Vocabulary(open_ended=True) if kind in user_kinds() else None
