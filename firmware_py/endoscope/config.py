"""``[firmware]`` of an endoscope bench: filter, control, experiment, limits."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import Field

from firmware_py.endoscope.targets import GameConfig
from firmware_py.run.safety import SafetyLimits
from firmware_py.sensing.fusion import FusionConfig
from hal.bench import BenchFile
from hal.errors import BenchError
from hal.validation import StrictTable, validate_table


class EndoscopeConfig(StrictTable):
    """Holds the checked [firmware] table of an endoscope bench. ``steered_by`` names the device whose turning moves the
    view; empty: the motion card, else the first sensor.

    ``initial_s``: the start attitude of every activation is the mean over this time (Erat 2018, section 6.2: less than
    0.1 s). ``silent_ms``: after this time without a sample the view is held. ``safety``: when a hold ends, and when it
    ends the run. ``budget_us``: budgets of tasks, by name; a sensor's task has the name of its device.
    """

    fusion: FusionConfig = FusionConfig(method="error-state")
    """Mahony, which Erat 2018 chose, follows every acceleration; see docs/endoscope.md."""
    game: GameConfig = GameConfig()
    steered_by: str = ""
    safety: SafetyLimits = SafetyLimits()
    silent_ms: float = Field(default=500.0, ge=20.0, le=60_000.0)
    budget_us: dict[str, float] = Field(default_factory=dict[str, float])


def load_endoscope_config(bench: BenchFile) -> EndoscopeConfig:
    """Return the checked configuration of the bench. Raises ``BenchError`` naming file and key."""
    return validate_table(EndoscopeConfig, bench.description.firmware, f"{bench.path}: firmware")


def choose_steering(config: EndoscopeConfig, kinds: Mapping[str, bool]) -> str:
    """Return the name of the sensor that moves the view. ``kinds``: name of each sensor, and whether it is a card.

    Raises ``BenchError`` if ``steered_by`` is none of them."""
    if config.steered_by:
        if config.steered_by not in kinds:
            raise BenchError(f"[firmware.steered_by] '{config.steered_by}' is none of {', '.join(kinds)}")
        return config.steered_by
    return next((name for name, is_card in kinds.items() if is_card), next(iter(kinds)))
