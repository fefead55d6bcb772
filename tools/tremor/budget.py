"""What each source of error costs at the tip: the closed loop on the emulated instrument with one source taken away.

Sources that a calibration file describes (biases, scales, hysteresis) stay: without them the file would be wrong. Costs
are rms um in 8 to 12 Hz on the physical truth; cost = sqrt(with^2 - without^2), negative where it helps by
chance.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from firmware_py.app import run_in_process
from firmware_py.run_request import RunRequest
from tools.reports.tremor_figures import tremor_figures
from tools.tremor.bench_variant import write_variant

SETTLE_S = 5.0
SOURCES: dict[str, dict[str, dict[str, float]]] = {
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


@dataclass(frozen=True)
class BudgetRow:
    """Tip tremor with ``source`` taken away, um rms as a vector, and what it therefore costs."""

    source: str
    uncompensated_rms_um: float
    compensated_rms_um: float
    reduction_percent: float
    cost_um: float

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def budget(bench: Path, seconds: float, progress: Callable[[str], None]) -> Iterator[BudgetRow]:
    """One virtual run per source; the first row is the instrument as it is."""
    whole = math.nan
    with tempfile.TemporaryDirectory(prefix="micron-budget-") as folder:
        for n, (source, changes) in enumerate(SOURCES.items()):
            progress(f"without {source}" if n else source)
            file = write_variant(bench, {"emulation": changes}, Path(folder), f"{bench.stem}-{n}")
            outcome, truth = run_in_process(RunRequest(file, seconds, virtual=True))
            assert truth is not None  # virtual runs are emulated
            figures = tremor_figures(
                truth, from_ns=outcome["armed_ns"] + round(SETTLE_S * 1e9), to_ns=outcome["safe_ns"]
            )
            if figures is None:
                continue
            left = figures.vector.compensated_rms_um
            if n == 0:
                whole = left
            difference = whole**2 - left**2
            cost = math.copysign(math.sqrt(abs(difference)), difference)
            before, percent = figures.vector.uncompensated_rms_um, figures.vector.reduction_percent
            yield BudgetRow(source, before, left, percent, cost if n else whole)
