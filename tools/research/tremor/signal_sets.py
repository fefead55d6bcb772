"""The three tremor data sets of ``../shared/data``: shaker, wrist with Parkinson's disease, hand on a mouse."""

from __future__ import annotations

import csv
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hal.arrays import Array
from hal.even_samples import evenly
from hal.types import STANDARD_GRAVITY
from tools.errors import InputError
from tools.research.tremor.clock import rate_from_known
from tools.research.tremor.signal import Reference, TremorSignal, Windows
from tools.research.tremor.spectrum import highest_line, periodogram

_AXES = ("x", "y", "z")
_DRIVEN_BAND = (0.015, 0.16)  # cycles per sample: 1.5 to 16 Hz at the stated rate


def read_set(folder: Path) -> Iterator[TremorSignal]:
    """The signals of one data set folder."""
    readers = {
        "tremor_duke_adxl345": _duke,
        "tremor_paradigma_pd": _paradigma,
        "tremor_mouse_lsm9ds1": _mouse,
    }
    return readers[folder.name](folder)


def _arrays(path: Path, names: tuple[str, ...]) -> dict[str, Array]:
    try:
        with np.load(path, allow_pickle=False) as data:
            return {k: np.asarray(data[k], dtype=np.float64) for k in names}
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: not the data set that it should be ({error}); fetch it again") from error


def _meta(folder: Path) -> dict[str, Any]:
    try:
        return tomllib.loads((folder / "meta.toml").read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{folder / 'meta.toml'}: {error}") from error


def _stack(columns: Mapping[str, Array], pattern: str, factor: float) -> Array:
    return np.stack([columns[pattern.format(a)] for a in _AXES], axis=1) * factor


def _duke(folder: Path) -> Iterator[TremorSignal]:
    """49 recordings; their rate is found from the drive frequencies of the medium and high amplitudes."""
    columns = _arrays(folder / "data.npz", ("recording_id", *(f"acc_{a}_g" for a in _AXES)))
    stated_hz = float(_meta(folder)["rate_hz"])
    try:
        with (folder / "index.csv").open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise InputError(f"{folder / 'index.csv'}: {error.strerror}") from error
    signals: list[TremorSignal] = []
    for row in rows:
        chosen = columns["recording_id"] == float(row["recording_id"])
        drive = float(row["drive_frequency_hz"]) if row["drive_frequency_hz"] else None
        still = row["name"] in ("on_table_no_movement", "arm_extended_no_tremor")
        signals.append(
            TremorSignal(
                name=f"duke/{row['name']}",
                data_set=folder.name,
                subject="shaker" if drive else "person",
                quantity="acceleration",
                unit="m/s^2",
                axes=_AXES,
                values=_stack(columns, "acc_{}_g", STANDARD_GRAVITY)[chosen],
                rate_hz=stated_hz,
                stated_rate_hz=stated_hz,
                reference=Reference(drive, row["amplitude"] or "", False if still else True if drive is None else None),
            )
        )
    known = [(s.reference.drive_hz, s.values) for s in signals if s.reference.amplitude in ("med", "high")]
    clock = rate_from_known(
        [float(drive) for drive, _ in known if drive is not None],
        [highest_line(periodogram(values, 1.0), _DRIVEN_BAND) for _, values in known],
        stated_hz,
    )
    for s in signals:
        yield replace(s, rate_hz=clock.rate_hz, notes=(clock.sentence(),)) if clock.stated_is_wrong else s


def _paradigma(folder: Path) -> Iterator[TremorSignal]:
    columns = _arrays(folder / "data.npz", ("t_s", *(f"gyro_{a}_deg_s" for a in _AXES)))
    w = _arrays(
        folder / "windows.npz",
        ("start_s", "freq_peak_hz", "tremor_checked", "arm_at_rest", "tremor_power_deg2_s2"),
    )
    t = columns["t_s"]
    windows = Windows(
        w["start_s"], 4.0, w["tremor_checked"] > 0, w["freq_peak_hz"], w["arm_at_rest"] > 0, w["tremor_power_deg2_s2"]
    )
    yield TremorSignal(
        name="paradigma/wrist",
        data_set=folder.name,
        subject="pd1",
        quantity="angular rate",
        unit="rad/s",
        axes=_AXES,
        values=_stack(columns, "gyro_{}_deg_s", np.pi / 180.0),
        rate_hz=(len(t) - 1) / float(t[-1] - t[0]),
        stated_rate_hz=float(_meta(folder)["rate_hz"]),
        start_s=float(t[0]),
        reference=Reference(tremor=True, windows=windows),
    )


def _mouse(folder: Path) -> Iterator[TremorSignal]:
    """Gyroscope, accelerometer and cursor of each person: ``mouse/23/gyro``, ``mouse/23/acc``, ``mouse/23/cursor``."""
    meta = _meta(folder)
    for entry in sorted(meta["files"], key=lambda e: e["name"]):
        if not str(entry["name"]).startswith("imu_"):
            continue
        person = str(entry["name"])[4:6]
        reference = Reference(tremor=bool(entry["essential_tremor_diagnosis"]))
        inertial = _arrays(folder / f"imu_{person}.npz", ("t_s", *(f"{s}_{a}_{u}" for s, u in _SENSORS for a in _AXES)))
        gyro = _stack(inertial, "gyro_{}_deg_s", np.pi / 180.0)
        acc = _stack(inertial, "acc_{}_g", STANDARD_GRAVITY)
        cursor = _arrays(folder / f"cursor_{person}.npz", ("t_s", "x_px", "y_px"))
        path = np.stack([cursor["x_px"], cursor["y_px"]], axis=1)
        # the sensor's clock starts with the first click (meta.toml, time_alignment)
        first_click_s = float(_arrays(folder / f"clicks_{person}.npz", ("t_s",))["t_s"][0])
        for kind, quantity, unit, axes, stamps_s, values in (
            ("gyro", "angular rate", "rad/s", _AXES, inertial["t_s"], gyro),
            ("acc", "acceleration", "m/s^2", _AXES, inertial["t_s"], acc),
            ("cursor", "screen position", "pixel", ("x", "y"), cursor["t_s"] - first_click_s, path),
        ):
            # whether the stamps are to be believed is asked of the gyroscope: it sees the fastest changes
            try:
                even, rate_hz, start_s, notes = evenly(stamps_s, values, gyro if kind != "cursor" else path)
            except ValueError as error:
                raise InputError(f"{folder}, person {person}, {kind}: {error}") from None
            yield TremorSignal(
                name=f"mouse/{person}/{kind}",
                data_set=folder.name,
                subject=f"mouse{person}",
                quantity=quantity,
                unit=unit,
                axes=axes,
                values=even,
                rate_hz=rate_hz,
                stated_rate_hz=float(meta["rate_hz"]) if kind != "cursor" else float(entry["cursor_rate_hz"]),
                start_s=start_s,
                reference=reference,
                notes=notes,
            )


_SENSORS = (("acc", "g"), ("gyro", "deg_s"))
