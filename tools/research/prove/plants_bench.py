"""The prover's own run of the emulated bench: its plant stepped once a millisecond, without noise.

The bench is the instrument's base physics by definition, so both sides have it in common; only what the generator adds
to commands and readings is new. What is written here a second time is the stepping, the hand and the reading.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.interpolate import make_interp_spline

from hal.arrays import Array
from sim_devices.config import EmulationConfig
from sim_devices.plant.hand import holding_frame
from sim_devices.plant.instrument import Instrument

MILLISECOND_NS = 1_000_000


class _Guided:
    """A handle that goes where ``path_x`` says, smoothly through its samples, and nowhere else."""

    def __init__(self, config: EmulationConfig, t_s: Array, path_x_m: Array) -> None:
        self.frame = holding_frame(config.hand)
        at = make_interp_spline(t_s, path_x_m, k=3)
        until = np.minimum(1e-3 * np.arange(t_s.size + 2), t_s[-1])
        self._moves = np.zeros((until.size, 18))  # place, rate and acceleration of three paths and three angles
        for first, times in ((0, 0), (6, 1), (12, 2)):
            self._moves[:, first] = at(until, times)
        self._next = 1

    def start(self, pose: Array, parts: Array) -> None:
        """See ``sim_devices.plant.hand.Hand``."""
        pose[:], parts[:] = self._moves[0], 0.0

    def fill(self, pose: Array, parts: Array) -> None:
        """See ``sim_devices.plant.hand.Hand``."""
        rows = np.minimum(self._next + np.arange(len(pose)), len(self._moves) - 1)
        pose[:], parts[:] = self._moves[rows], 0.0
        self._next += len(pose)


def run_bench(unit: int, t_s: Array, drive: Mapping[str, Array], outputs: Sequence[str]) -> dict[str, Array]:
    """``volts_*`` (V) and ``tip_*`` (m), (n,) each, at ``t_s`` (n,) one millisecond apart; ``drive``: ``command_1`` (V)
    and perhaps ``path_x`` (m)."""
    config = EmulationConfig(provider="sim_devices.register:provider", unit=unit, seed=unit)
    start_s = t_s - t_s[0]
    hand = _Guided(config, start_s, drive.get("path_x", np.zeros(t_s.size)))
    plant = Instrument(config, unit, hand, unit=unit, quiet=True)
    volts, tip = np.empty((t_s.size, 8)), np.empty((t_s.size, 3))
    last_V = float("nan")
    for k, command_V in enumerate(drive["command_1"].tolist()):
        now_ns = k * MILLISECOND_NS
        plant.advance_to(now_ns)
        volts[k], tip[k] = plant.analog_V, plant.truth_row()["tip_m"]
        if command_V != last_V:
            plant.set_demand_V(0, command_V, now_ns)
            last_V = command_V
    found = {f"volts_{i}": volts[:, i] for i in range(8)} | {f"tip_{a}": tip[:, i] for i, a in enumerate("xyz")}
    return {name: found[name] for name in outputs}
