"""Madgwick and Mahony on the BROAD trials: the errors that the set's authors published, with their parameters."""

from __future__ import annotations

import tomllib

import numpy as np

from firmware_py.sensing.fusion import Fusion, FusionConfig
from firmware_py.sensing.quaternion import from_matrix
from tools.reproduce.orientation_error import Array, east_north_up, rms_errors_deg
from tools.reproduce.real_sensors import BROAD_HZ, data_folder
from tools.reproduce.rows import Row

FILTERS = {
    # the authors' C code: its predicted field is half as long as the measured one
    "madgwick": FusionConfig(method="madgwick", beta=0.12, field_scale=0.5),
    "mahony": FusionConfig(method="mahony", kp=0.74, ki=0.0012),
}


def start_of_the_authors(force: Array, field: Array) -> Array:
    """(4,): their start is the inverse of the first sample's attitude with the heading turned round (a slip of theirs).

    It dies away within seconds but for Mahony's integral, which keeps 0.1 degrees of it.
    """
    columns = (
        np.cross(np.cross(force, -field), force),
        np.cross(force, np.cross(np.cross(force, -field), force)),
        force,
    )
    start = np.zeros(4)
    from_matrix(np.column_stack([v / np.linalg.norm(v) for v in columns]), start)
    return start


def broad() -> list[Row]:
    """Total error of each trial and filter beside the published one."""
    folder = data_folder() / "broad"
    if not folder.is_dir():
        return []
    rows: list[Row] = []
    for entry in tomllib.loads((folder / "meta.toml").read_text())["files"]:
        with np.load(folder / entry["name"]) as data:
            rate, force, field, truth = (
                np.stack([data[f"{stem}_{axis}{unit}"] for axis in axes], axis=1).astype(np.float64)
                for stem, axes, unit in (
                    ("gyro", "xyz", "_rad_s"),
                    ("acc", "xyz", "_m_s2"),
                    ("mag", "xyz", "_uT"),
                    ("opt_quat", "wxyz", ""),
                )
            )
            counts = data["movement"].astype(bool)
        for method, config in FILTERS.items():
            fusion = Fusion(config, BROAD_HZ)
            fusion.restart(start_of_the_authors(force[0], field[0]))
            total, _, _ = rms_errors_deg(east_north_up(fusion.run(rate, force, field)), truth, counts)
            settings = "beta 0.12" if method == "madgwick" else "Kp 0.74, Ki 0.0012"
            rows.append(
                Row(
                    "BROAD, authors' Madgwick and Mahony (2021)",
                    f"{method} total error, trial {entry['name'][:2]}",
                    "deg",
                    f"{settings}, start and field scale as in their code",
                    float(entry[f"{method}_rmse_deg"]),
                    total,
                    "equal",
                    "recording",
                    tolerance=0.1,
                )
            )
    return rows
