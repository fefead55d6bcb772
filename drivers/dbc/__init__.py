"""Reads the CAN frames of the bench from ``micron.dbc`` with cantools.

What lives here: the frame table and its loading. What must not: what a frame makes a driver do (``drivers.piezo``,
``drivers.can_telemetry``); the emulated nodes read the manual, not this file.
"""

from __future__ import annotations

from importlib import import_module, resources
from typing import Protocol, cast

from hal.backends.can_package import import_can


class DbcMessage(Protocol):
    """Defines the part of a cantools message that the drivers use."""

    frame_id: int
    length: int

    def encode(self, data: dict[str, float], *, strict: bool = True) -> bytes:
        """Return the frame's bytes. Without ``strict`` the values must be within their ranges, which costs 10 us to
        check."""
        ...

    def decode(self, data: bytes) -> dict[str, float]: ...


class DbcDatabase(Protocol):
    def get_message_by_name(self, name: str) -> DbcMessage: ...


def load_database() -> DbcDatabase:
    """Return a new database object (takes about 10 ms). Decoded signals and choices are numbers."""
    import_can()  # before cantools does it
    cantools = import_module("cantools.database")
    text = resources.files("drivers.dbc").joinpath("micron.dbc").read_text(encoding="ascii")
    return cast(DbcDatabase, cantools.load_string(text, "dbc"))
