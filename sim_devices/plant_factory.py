"""Makes the plant that a bench description asks for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hal.errors import BenchError
from sim_devices.config import EmulationConfig, emulation_config
from sim_devices.plant.instrument import Instrument
from sim_devices.plant.recorded_hand import make_hand
from sim_devices.plant.scanner import Scanner
from sim_devices.plant.stack_twin import StackTwins
from sim_devices.plant.unit import start_temperature_C
from sim_devices.world import Plant


def make_plant(description: Mapping[str, Any], hand_file: str | None, hand_scale: float | None) -> Plant:
    """An ``Instrument`` in somebody's hand: synthetic, or recorded in ``hand_file``; or the endoscope bench's scanner.

    Raises ``BenchError`` (``HandFileError``) for a hand that cannot be used.
    """
    config = emulation_config(description)
    if config.endoscope is not None:
        return Scanner(config)
    hand = make_hand(config.hand, config.seed, hand_file, hand_scale)
    return Instrument(config, config.seed, hand, unit=config.unit, twins=stack_twins(config, description))


def stack_twins(config: EmulationConfig, description: Mapping[str, Any]) -> StackTwins | None:
    """The corrected twins that ``[emulation] twin`` names, relative to ``description["folder"]``; BenchError if bad."""
    if config.twin is None:
        return None
    for name, device in description.get("device", {}).items():
        if device.get("driver") == "e727":
            raise BenchError(
                f"[emulation] twin: device '{name}' (e727) measures the stacks while it runs, a corrected twin runs on "
                "whole records; use a bench with an amplifier without sensor"
            )
    from sim_devices.twin_file import load_twin  # brings the whole catalogue of effects; most benches have no twin

    folder = Path(description.get("folder", "."))
    files = (config.twin,) * 3 if isinstance(config.twin, str) else config.twin
    twins = [load_twin((folder / file).resolve()) for file in files]
    return StackTwins(twins, config.amplifier.neutral_V, start_temperature_C(config))
