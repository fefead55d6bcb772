"""The BROAD trials as arrays (D. Laidig et al., Data 6 (7), 2021): every file that the set's ``meta.toml`` names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tools.research.reproduce.orientation_error import Array, east_north_up, rms_errors_deg
from tools.research.reproduce.recordings import data_folder, meta

BROAD_HZ = 1.0 / 0.0035
START_S = 5.0
"""Time after the first row with a true attitude that counts as the start of a trial; the body rests there."""


@dataclass(frozen=True)
class Trial:
    """``rate`` rad/s, ``force`` m/s^2, ``field`` uT (n, 3); ``truth`` (n, 4) east-north-up; ``published`` figures."""

    name: str
    rate: Array
    force: Array
    field: Array
    truth: Array
    counts: NDArray[np.bool_]
    published: dict[str, Any]

    @property
    def disturbed(self) -> bool:
        """Return whether the set's authors disturbed it (taps or magnets)."""
        return "_disturbed_" in str(self.published["name"])

    def errors_deg(self, attitude: Array) -> tuple[float, float, float]:
        """Total, heading, inclination rms of quaternions (n, 4) whose world has x to magnetic north."""
        return rms_errors_deg(east_north_up(attitude), self.truth, self.counts)

    def field_heading_deg(self) -> tuple[float, float]:
        """Angle in deg between north and the horizontal part of the field that the true attitude puts into the world:
        size of its median over ``START_S`` of rest, and median of its size over the rows that count.

        A filter that begins with the field begins with the first, and the second is what its magnetometer tells it.
        """
        seen = np.all(np.isfinite(self.truth), axis=1) & np.all(np.isfinite(self.field), axis=1)
        attitude = Rotation.from_quat(np.roll(self.truth[seen], -1, axis=1))
        east, north, _ = attitude.apply(self.field[seen]).T
        off = np.degrees(np.arctan2(east, north))
        start = np.flatnonzero(seen) < START_S * BROAD_HZ + int(np.argmax(seen))
        return abs(float(np.median(off[start]))), float(np.median(np.abs(off[self.counts[seen]])))


def trials() -> list[Trial]:
    """Return all trials that exist."""
    found = []
    for entry in meta("broad")["files"]:
        found.append(read_trial(data_folder() / "broad" / entry["name"], entry))
    return found


def read_trial(path: Path, entry: dict[str, Any]) -> Trial:
    """Read a file of the set; ``entry`` is its entry in meta.toml."""
    with np.load(path) as data:
        rate, force, field, truth = (
            np.ascontiguousarray(np.stack([data[f"{stem}_{axis}{unit}"] for axis in axes], axis=1).astype(np.float64))
            for stem, axes, unit in (
                ("gyro", "xyz", "_rad_s"),
                ("acc", "xyz", "_m_s2"),
                ("mag", "xyz", "_uT"),
                ("opt_quat", "wxyz", ""),
            )
        )
        return Trial(path.name[:2], rate, force, field, truth, data["movement"].astype(bool), entry)


def trials_not_given(folder: Path) -> list[Trial]:
    """Return the trials of the public repository's ``data_mat`` in ``folder`` that are not in the set ``broad``."""
    from scipy.io import loadmat

    given = {entry["name"][:2] for entry in meta("broad")["files"]}
    found = []
    for path in sorted(folder.glob("*.mat")):
        if path.name[:2] in given:
            continue
        data = loadmat(path, variable_names=("imu_gyr", "imu_acc", "imu_mag", "opt_quat", "movement"))
        rate, force, field, truth = (
            np.ascontiguousarray(data[name], dtype=np.float64) for name in ("imu_gyr", "imu_acc", "imu_mag", "opt_quat")
        )
        counts = np.ravel(data["movement"]).astype(bool)
        found.append(Trial(path.name[:2], rate, force, field, truth, counts, {"name": path.stem}))
    return found


def vqf_errors_deg(trial: Trial) -> tuple[float, float, float] | None:
    """The vqf package (its defaults) on the same samples; None when it is not installed (development extra)."""
    try:
        from vqf import VQF  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    found = np.asarray(VQF(1.0 / BROAD_HZ).updateBatch(trial.rate, trial.force, trial.field)["quat9D"])
    return rms_errors_deg(found, trial.truth, trial.counts)
