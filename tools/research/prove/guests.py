"""Twins that are not the tool's own: an FMU, a package with a user's twin, a bench for the instrument. As files only:
the tool under test meets them as it meets those of a stranger.
"""

from __future__ import annotations

import importlib.util
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hal.trust import decide, trust_program

FMU, USER, INSTRUMENT = "fmu", "lever_arm", "instrument"
PACKAGES = "packages"
"""Folder beside the recordings with what ``pip install`` would have put on the path."""

_EXPANDER = '''
import math

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Expander(Fmi2Slave):
    """A part that expands with its heater's power, which is held over a step; it lags behind it."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.um_per_W, self.time_constant_s, self.offset_um = 1.0, 1.0, 0.0
        self.power = self.warm = self.expansion = 0.0
        self.register_variable(Real("power", causality=Fmi2Causality.input))
        self.register_variable(Real("expansion", causality=Fmi2Causality.output))
        for name in ("um_per_W", "time_constant_s", "offset_um"):
            self.register_variable(Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable))

    def exit_initialization_mode(self):
        self.warm, self.expansion = 0.0, self.offset_um

    def do_step(self, current_time, step_size):
        decay = math.exp(-step_size / self.time_constant_s)
        self.warm = decay * self.warm + (1.0 - decay) * self.power
        self.expansion = self.offset_um + self.um_per_W * self.warm
        return True
'''

_LEVER = '''"""A lever that a servo turns: its end rises with the sine of the angle."""

import numpy as np


class LeverArm:
    def simulate(self, inputs, parameters):
        angle = parameters["rad_per_V"] * inputs["drive"]
        return {"lift": parameters["offset_um"] + parameters["arm_um"] * np.sin(angle)}
'''

_BENCH = """format = 1
name = "bench of the proof"

[clock]
tick_hz = 1000

[emulation]
provider = "sim_devices.register:provider"
unit = {unit}
seed = {unit}
"""


def fmu_possible() -> bool:
    """Return whether an FMU can be made and run here: the extra ``fmu``."""
    return all(importlib.util.find_spec(name) is not None for name in ("fmpy", "pythonfmu"))


def build_fmu(target: Path) -> None:
    """An FMI 2 co-simulation FMU at ``target``. ImportError without PythonFMU."""
    from pythonfmu.builder import FmuBuilder  # pyright: ignore[reportMissingTypeStubs]

    with tempfile.TemporaryDirectory(prefix="micron-fmu-") as tmp:
        source = Path(tmp) / "expander.py"
        source.write_text(_EXPANDER)
        shutil.move(str(FmuBuilder.build_FMU(source, dest=tmp)), target)
    trust_program(target)  # this program wrote it


def write_bench(target: Path, unit: int) -> None:
    """The emulated bench of one physical ``unit``."""
    target.write_text(_BENCH.format(unit=unit))


def install_user_twin(folder: Path) -> None:
    """The user's package below ``folder / PACKAGES``, with the entry point that offers its twin."""
    packages = folder.resolve() / PACKAGES
    about = packages / "lever_arm-1.0.dist-info"
    about.mkdir(parents=True, exist_ok=True)
    (packages / "lever_arm.py").write_text(_LEVER)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: lever-arm\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[micron.twins]\n{USER} = lever_arm:LeverArm\n")
    decide("run", f"package lever_arm at {packages / 'lever_arm.py'}", "lever_arm:LeverArm")  # this program wrote it


@contextmanager
def installed(recording: Path) -> Iterator[None]:
    """With the packages beside the recordings on the path, as after ``pip install``; without them nothing happens."""
    packages = str(recording.resolve().parent.parent.parent / PACKAGES)
    if not Path(packages).is_dir():
        yield
        return
    sys.path.insert(0, packages)
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path.remove(packages)
        sys.modules.pop("lever_arm", None)
