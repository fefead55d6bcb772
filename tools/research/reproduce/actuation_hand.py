"""Recorded tremor as paths to track; the recordings lie beside the project (``real_sensors``)."""

from __future__ import annotations

import numpy as np

from hal.arrays import Array
from sim_devices.config import HandConfig
from sim_devices.plant.hand_file import load_hand
from sim_devices.plant.recorded_hand import RecordedHand
from tools.research.reproduce.actuation_lab import LOW_UM, SCORED
from tools.research.reproduce.real_sensors import data_folder

HANDS = {
    "stretched arm": "tremor_duke_adxl345/data.npz#arm_extended_no_tremor",
    "hand on a mouse, essential tremor": "tremor_mouse_lsm9ds1/imu_23.npz#20:80",
}


def present() -> dict[str, str]:
    """Hands whose recording is there."""
    folder = data_folder()
    return {name: str(folder / file) for name, file in HANDS.items() if (folder / file.split("#")[0]).is_file()}


def missing_notes() -> tuple[str, ...]:
    """Why rows are missing, if they are."""
    gone = [name for name in HANDS if name not in present()]
    return (f"no recording of {', '.join(gone)} in {data_folder()}: those rows are left out",) if gone else ()


def recorded_tip_m(source: str, ticks: int) -> Array:
    """(ticks, 3) tremor of the tip in the body frame, m, of a recorded hand, 1 kHz."""
    calm = HandConfig(tremor_pp_um=50.0)
    hand = RecordedHand(calm, 1, load_hand(source))
    pose, parts = np.zeros((ticks, 18)), np.zeros((ticks, 6))
    hand.fill(pose, parts)
    return parts[:, 3:] @ hand.frame


def tremor_paths(windows: int = 7) -> dict[str, list[Array]]:
    """Windows of 5 s of the liveliest axis of each hand, each scaled to 12.5 um p-p."""
    paths: dict[str, list[Array]] = {}
    for name, source in present().items():
        tip = recorded_tip_m(source, windows * SCORED)
        axis = int(np.argmax(np.var(tip, axis=0)))
        cuts = [tip[k * SCORED : (k + 1) * SCORED, axis] for k in range(windows)]
        paths[name] = [LOW_UM + 12.5 * (x - x.min()) / np.ptp(x) for x in cuts]
    return paths
