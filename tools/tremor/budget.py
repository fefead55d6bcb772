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

from firmware_py.app import RunRequest, run_in_process
from tools.reports.tremor_figures import tremor_figures

SETTLE_S = 5.0
SOURCES: dict[str, str] = {
    "everything on": "",
    "accelerometer noise": "[emulation.sensors]\nnoise_ug_per_rtHz = 0.0\n",
    "converter noise": "[emulation.sensors]\ndaq_noise_uV = 0.0\n",
    "supply and magnetometer noise": "[emulation.sensors]\nsupply_wander_mV = 0.0\nmagnetometer_noise_uG = 0.0\n",
    "creep of the stacks": "[emulation.stack]\ncreep_per_decade = 0.0\n",
    "warm-up and room temperature": "[emulation.environment]\nambient_wander_K = 0.0\nwarm_up_K = 0.0\n",
    "jerks of the hand": "[emulation.hand]\njerk_um = 0.0\n",
    "unsteadiness of the hand": "[emulation.hand]\nunsteadiness_rms_um = 0.0\n",
    "reaches and drift of the hand": "[emulation.hand]\nvoluntary_range_um = 0.0\nvoluntary_angle_deg = 0.0\n",
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
    text = bench.read_text(encoding="utf-8").replace('"calibration/', f'"{bench.parent.resolve() / "calibration"}/')
    whole = math.nan
    with tempfile.TemporaryDirectory(prefix="micron-budget-") as folder:
        for n, (source, override) in enumerate(SOURCES.items()):
            progress(f"without {source}" if n else source)
            file = Path(folder) / f"{bench.stem}-{n}.toml"
            file.write_text(f"{text}\n{override}", encoding="utf-8")
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
