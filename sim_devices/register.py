"""Provides the emulation that bench files name: ``provider = "sim_devices.register:provider"``.

With a virtual clock the world lives in this process and moves in lockstep with whoever waits; without one it is a
process of its own in real time (``sim_devices.process``), reached through the ordinary adapters of ``hal``. Either is
imported when it is asked for: a command that only talks to a bench does not load the physics behind it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hal.clock import PacedClock, VirtualClock
from sim_devices.config import emulation_config

if TYPE_CHECKING:
    from sim_devices.lockstep_world import LockstepWorld
    from sim_devices.process_world import ProcessWorld

PLANT = "sim_devices.plant_factory:make_plant"


def provider(
    description: dict[str, Any],
    *,
    clock: VirtualClock | None,
    runtime_dir: Path,
    hand_file: Path | None,
    hand_scale: float | None,
) -> LockstepWorld | ProcessWorld:
    """Return the emulated side of a bench.

    Raises ``BenchError`` for a wrong ``[emulation]`` table or a device that cannot be emulated.
    """
    emulation_config(description)
    file = None if hand_file is None else str(Path(hand_file).resolve())
    if clock is not None:
        from sim_devices.lockstep_world import LockstepWorld

        world = LockstepWorld(description, clock, file, hand_scale, PLANT)
        if isinstance(clock, PacedClock):  # somebody may be watching, and want to break something
            world.obey(Path(runtime_dir))
        return world
    from sim_devices.process_world import ProcessWorld

    return ProcessWorld(description, Path(runtime_dir), file, hand_scale, PLANT)
