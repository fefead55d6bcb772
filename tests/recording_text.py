"""The channel table of a made-up recording of a stack: a command in V, a displacement in um."""

from __future__ import annotations


def stack_channels(command: str, displacement: str, noise_rms: float | None = None) -> str:
    """TOML for ``recording.toml``; the arguments are the columns' names and the noise in um, where it is stated."""
    noise = "" if noise_rms is None else f"noise_rms = {noise_rms}\n"
    return f"""
[[channels]]
column = "{command}"
role = "input"
signal = "command"
unit = "V"

[[channels]]
column = "{displacement}"
role = "output"
signal = "displacement"
unit = "um"
{noise}"""
