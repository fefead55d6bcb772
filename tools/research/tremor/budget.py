"""Measures the cost of each error source at the tip: the closed loop is run with one source removed.

Sources that a calibration file describes are taken away together with that file, the firmware told the part as it is:
their cost is what calibration leaves. Costs are rms um of the tip's error against the intended path in each of four
bands, on the physical truth; cost = sqrt(with^2 - without^2), negative where it helps by chance. The last two rows take
all away: what is left there is the estimator's.
"""

from __future__ import annotations

import math
import tempfile
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hal.bench import load_bench
from tools.closed_loop.simulate import simulate
from tools.reports.figures import FOUR_BANDS_HZ, TREMOR_BAND_HZ, tremor_figures
from tools.research.tremor.bench_variant import write_variant
from tools.research.tremor.ideal import LINE, LOOP_DELAY_S, PERFECT_EMULATION, POSITIONS_M, ideal_changes

SETTLE_S = 5.0
Changes = Mapping[str, Any]
SOURCES: dict[str, Changes] = {
    "everything on": {},
    "accelerometer noise": {"sensors": {"noise_ug_per_rtHz": 0.0}},
    "converter noise": {"sensors": {"daq_noise_uV": 0.0}},
    "supply and magnetometer noise": {"sensors": {"supply_wander_mV": 0.0, "magnetometer_noise_uG": 0.0}},
    "creep of the stacks": {"stack": {"creep_per_decade": 0.0}},
    "warm-up and room temperature": {"environment": {"ambient_wander_K": 0.0, "warm_up_K": 0.0}},
    "jerks of the hand": {"hand": {"jerk_um": 0.0}},
    "unsteadiness of the hand": {"hand": {"unsteadiness_rms_um": 0.0}},
    "reaches and drift of the hand": {"hand": {"voluntary_range_um": 0.0, "voluntary_angle_deg": 0.0}},
}
"""Changes of [emulation]."""
_NOISES = ("daq_noise_uV", "supply_wander_mV", "magnetometer_noise_uG")
MADE: dict[str, tuple[str, Changes, Changes]] = {
    "what calibration leaves of the sensors": (
        "sensors",
        {
            "instrument": PERFECT_EMULATION["instrument"],
            "sensors": {k: v for k, v in PERFECT_EMULATION["sensors"].items() if k not in _NOISES},
        },
        {"sensing": {"positions_m": POSITIONS_M}},
    ),
    "what calibration leaves of the stacks": (
        "piezo",
        {"stack": PERFECT_EMULATION["stack"]},
        {"actuation": {"stacks": [LINE, LINE, LINE]}, "tremor": {"loop_delay_s": LOOP_DELAY_S}},
    ),
    "what calibration leaves of the manipulator": (
        "manipulator",
        {"manipulator": PERFECT_EMULATION["manipulator"]},
        {},
    ),
}
"""The calibration file that goes, changes of [emulation] and of [firmware]."""
ALL_ERRORS = "all errors of sensors and actuators"


def sources(bench: Path) -> dict[str, Changes]:
    """Changes of the bench file for every row."""
    table = tomllib.loads(bench.read_text(encoding="utf-8")).get("firmware", {})
    files = [str(name) for name in table.get("calibration", [])]
    out: dict[str, Changes] = {name: {"emulation": changes} for name, changes in SOURCES.items()}
    for name, (stem, emulation, firmware) in MADE.items():
        kept = [file for file in files if Path(file).stem != stem]
        out[name] = {"emulation": emulation, "firmware": {"calibration": kept, **firmware}}
    for name, noise in ((f"{ALL_ERRORS} but accelerometer noise", True), (ALL_ERRORS, False)):
        out[name] = ideal_changes(noise)
        # estimator and strokes are the bench's own here: they keep still above the band
        ideal = out[name]["firmware"]
        del ideal["tremor"]["adaptive"]["quiet"], ideal["tremor"]["adaptive"]["above"]
        del ideal["actuation"]["overdrive"]
    return out


@dataclass(frozen=True)
class BandCost:
    """Error against the intended path in a band, um rms, manipulator resting and working, and a source's part of it."""

    low_Hz: float
    high_Hz: float
    without_um: float
    with_um: float
    cost_um: float


@dataclass(frozen=True)
class BudgetRow:
    """Tip tremor in 8 to 12 Hz with ``source`` taken away, um rms as a vector, and what it therefore costs by band.

    The first row takes nothing away: its costs are the whole error with compensation.
    """

    source: str
    uncompensated_rms_um: float
    compensated_rms_um: float
    reduction_percent: float
    bands: tuple[BandCost, ...]

    def as_dict(self) -> dict[str, Any]:
        """JSON values; ``cost_um`` is that of the tremor band."""
        (cost,) = (band.cost_um for band in self.bands if (band.low_Hz, band.high_Hz) == TREMOR_BAND_HZ)
        return {**asdict(self), "cost_um": cost}


def budget(bench: Path, seconds: float, progress: Callable[[str], None]) -> Iterator[BudgetRow]:
    """Run the bench in virtual time for each source; the first row is the instrument as it is."""
    whole: dict[tuple[float, float], float] = {}
    with tempfile.TemporaryDirectory(prefix="micron-budget-") as folder:
        for n, (source, changes) in enumerate(sources(bench).items()):
            progress(f"without {source}" if n else source)
            file = write_variant(bench, changes, Path(folder), f"{bench.stem}-{n}")
            run = simulate(load_bench(file), seconds)
            figures = tremor_figures(run.truth, from_ns=run.armed_ns + round(SETTLE_S * 1e9), to_ns=run.safe_ns)
            if figures is None:
                continue
            costs: list[BandCost] = []
            for band in FOUR_BANDS_HZ:
                before, left = figures.bands[band].uncompensated_rms_um, figures.bands[band].compensated_rms_um
                difference = whole[band] ** 2 - left**2 if n else left**2
                whole.setdefault(band, left)
                costs.append(BandCost(*band, before, left, math.copysign(math.sqrt(abs(difference)), difference)))
            vector = figures.vector
            yield BudgetRow(
                source, vector.uncompensated_rms_um, vector.compensated_rms_um, vector.reduction_percent, tuple(costs)
            )
