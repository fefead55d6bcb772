"""The channel tables of made-up recordings."""

from __future__ import annotations


def channel(column: str, role: str, signal: str, unit: str, noise_rms: float | None = None) -> str:
    """Return the table of one column for ``recording.toml``; ``noise_rms`` is in ``unit``, where it is stated."""
    text = f'[[channels]]\ncolumn = "{column}"\nrole = "{role}"\nsignal = "{signal}"\nunit = "{unit}"\n'
    return text if noise_rms is None else f"{text}noise_rms = {noise_rms}\n"


def stack_channels(command: str, displacement: str, noise_rms: float | None = None) -> str:
    """Return the tables of a stack: a column with the command in V and one with the displacement in um."""
    return channel(command, "input", "command", "V") + channel(displacement, "output", "displacement", "um", noise_rms)
