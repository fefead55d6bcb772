"""Corrected twins in the stacks' place: what ``[emulation] twin = "FILE"`` of a bench says.

The effects of a corrected twin run on whole records, so the strokes are worked out when the truth is asked for, from
all demands since the run began. Nothing on the bench measures a stroke while it runs (a bench whose controller does,
is refused by ``plant_factory``); the current that couples into the magnetometer stays that of the stack's own model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.compiled import kernel
from hal.errors import BenchError
from sim_devices.plant.manipulator import take_up, tip_displacement

if TYPE_CHECKING:
    from sim_devices.twin_file import FileTwin

MS_S = 1e-3


class StackTwins:
    """Three corrected ``piezo_stack`` twins and the demands that they have seen, from ``neutral_V`` on."""

    def __init__(self, twins: Sequence[FileTwin], neutral_V: float, temperature_C: float) -> None:
        """Raises BenchError for a twin of another kind, or one with an effect that needs what the bench has not."""
        for twin in twins:
            if twin.kind != "piezo_stack":
                raise BenchError(f"{twin.path}: a twin of kind {twin.kind}; the bench's stacks are piezo_stack")
        self._twins = tuple(twins)
        self._times_ns: list[list[int]] = [[-1] for _ in twins]
        self._volts: list[list[float]] = [[neutral_V] for _ in twins]
        rest, room = np.full(2, neutral_V), np.full(2, temperature_C)
        self._rest_m = np.array([_stroke_m(twin, rest, room, 0.0)[0] for twin in twins])

    def demand(self, channel: int, volts: float, t_ns: int) -> None:
        """Amplifier ``channel`` is asked for ``volts`` from ``t_ns`` on."""
        self._times_ns[channel].append(t_ns)
        self._volts[channel].append(volts)

    def forget(self, before_ns: int) -> None:
        """Demands that no row of the truth needs any more; memory then begins with the first row that is left."""
        for times, volts in zip(self._times_ns, self._volts, strict=True):
            keep = int(np.searchsorted(times, before_ns, side="right")) - 1
            del times[:keep], volts[:keep]

    def strokes_m(self, t_ns: NDArray[np.int64], temperature_C: Array) -> Array:
        """Return the strokes (n, 3) in m from neutral at each millisecond ``t_ns`` (n,) of the truth."""
        out = np.empty((t_ns.size, len(self._twins)))
        for i, twin in enumerate(self._twins):
            at = np.searchsorted(self._times_ns[i], t_ns, side="right") - 1
            volts = np.array(self._volts[i])[np.maximum(at, 0)]
            out[:, i] = _stroke_m(twin, volts, temperature_C, float(t_ns[0]) * 1e-9) - self._rest_m[i]
        return out


def _stroke_m(twin: FileTwin, volts: Array, temperature_C: Array, begin_s: float) -> Array:
    response = twin.run(MS_S, {"command": volts, "temperature": np.ascontiguousarray(temperature_C)}, begin_s)
    return 1e-6 * response["displacement"]


@kernel
def move_tips(plant, strokes_m, quaternions, rigid_m, tips_m):
    """``tips_m`` (n, 3), world, m, for strokes (n, 3) beyond neutral, attitudes (n, 4) and the tip at rest (n, 3)."""
    p = plant[0]
    m, rest = p["mount"], p["rest_tip_m"]
    z, d, e, seat = np.empty(3), np.empty(3), np.empty(3), np.zeros(3)
    for n in range(strokes_m.shape[0]):
        for i in range(3):
            z[i] = p["rest_m"][i] + p["lever"][i] * strokes_m[n, i]
        tip_displacement(z, p["circle_m"], p["shaft_m"], d)
        for i in range(3):
            e[i] = m[i, 0] * (d[0] - rest[0]) + m[i, 1] * (d[1] - rest[1]) + m[i, 2] * (d[2] - rest[2])
        take_up(p["play_m"], seat, e)
        w, x, y, v = quaternions[n, 0], quaternions[n, 1], quaternions[n, 2], quaternions[n, 3]
        # e + 2 w (u x e) + 2 u x (u x e), u = (x, y, v)
        a, b, c = y * e[2] - v * e[1], v * e[0] - x * e[2], x * e[1] - y * e[0]
        tips_m[n, 0] = rigid_m[n, 0] + e[0] + 2.0 * (w * a + y * c - v * b)
        tips_m[n, 1] = rigid_m[n, 1] + e[1] + 2.0 * (w * b + v * a - x * c)
        tips_m[n, 2] = rigid_m[n, 2] + e[2] + 2.0 * (w * c + x * b - y * a)
