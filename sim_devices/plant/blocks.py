"""The instrument's world for a caller that is compiled itself: arrays to run on, instead of calls to advance.

``Instrument`` moves the same kernel for devices that look at it one by one; here whoever closes the loop inside
compiled code calls ``sim_devices.plant.kernel.advance`` on the arrays. Same draws in the same order, so both are the
same world, bit for bit (tested).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_devices.config import EmulationConfig
from sim_devices.plant.hand import Hand
from sim_devices.plant.instrument import BLOCK_MS
from sim_devices.plant.kernel import NOISES, SLOW_NOISES, STEPS_PER_MS, TRUTH, TRUTH_COLUMNS, begin
from sim_devices.plant.streams import stream
from sim_devices.plant.unit import build_unit, plant_arrays


class PlantBlocks:
    """Computes one run of one instrument in one hand, in blocks of ``ms`` milliseconds (a multiple of ``BLOCK_MS``).

    ``plant``, ``state``: one-row structured arrays; ``block``: the present one's ``nodes``, ``parts``, ``noise`` and
    ``slow``, as ``advance`` wants them. ``truth`` (n + 1, TRUTH_COLUMNS) has a row for each of ``total_ms``.
    """

    def __init__(self, config: EmulationConfig, hand: Hand, total_ms: int, *, ms: int = 16 * BLOCK_MS) -> None:
        if ms % BLOCK_MS:
            raise ValueError(f"a block of {ms} ms is not a multiple of {BLOCK_MS} ms")
        self.plant, self.state = plant_arrays(config, build_unit(config, config.unit), hand.frame)
        self.ms = ms
        self.nodes, self.parts = np.zeros((ms + 1, 18)), np.zeros((ms, 6))
        self.noise, self.slow = np.zeros((ms * STEPS_PER_MS, NOISES)), np.zeros((ms, SLOW_NOISES))
        self.block = self.nodes, self.parts, self.noise, self.slow
        self.truth = np.zeros((total_ms + 1, TRUTH_COLUMNS))
        self._hand = hand
        self._rng = stream(config.seed, "instrument.noise")
        part = np.zeros(6)
        hand.start(self.nodes[-1], part)
        begin(self.plant, self.state, self.nodes[-1], part, self.truth[0])

    def next_block(self) -> None:
        """The next ``ms`` milliseconds of the hand and of all noise."""
        self.nodes[0] = self.nodes[-1]
        for start in range(0, self.ms, BLOCK_MS):
            block = slice(start, start + BLOCK_MS)
            self._hand.fill(self.nodes[start + 1 : start + BLOCK_MS + 1], self.parts[block])
            self._rng.standard_normal(out=self.noise[start * STEPS_PER_MS : (start + BLOCK_MS) * STEPS_PER_MS])
            self._rng.standard_normal(out=self.slow[block])

    def truth_columns(self, rows: int) -> dict[str, NDArray]:
        """Return the first ``rows`` rows of the truth by the names and units of ``Instrument.truth``."""
        columns: dict[str, NDArray] = {"t_ns": np.arange(rows, dtype=np.int64) * 1_000_000}
        for name, at, n in TRUTH:
            columns[name] = self.truth[:rows, at] if n == 1 else self.truth[:rows, at : at + n]
        return columns
