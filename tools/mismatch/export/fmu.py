"""Builds a corrected twin as an FMI 2.0 co-simulation FMU, with PythonFMU around the exported Python module."""

from __future__ import annotations

import hashlib
import importlib.util
import re
import shutil
import tempfile
from pathlib import Path

from tools.errors import InputError
from tools.mismatch.apply import Corrected
from tools.mismatch.twins.opaque import OpaqueTwin

_SLAVE = '''

# --- co-simulation ---------------------------------------------------------------------------------

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real  # noqa: E402

INPUTS, OUTPUTS, DT = {inputs!r}, {outputs!r}, {dt!r}
SCALARS = [k for k, v in PARAMETERS.items() if isinstance(v, float)]


class {name}(Fmi2Slave):
    """Inputs are held over a communication step, which is cut into whole internal steps of about {dt:g} s.

    Outputs at the end of a step have seen the inputs that were set before it: set what they are at its end, and the
    FMU gives what the module gives.
    """

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        for s in INPUTS:
            setattr(self, s, 0.0)
            self.register_variable(Real(s, causality=Fmi2Causality.input))
        for o in OUTPUTS:
            setattr(self, o, 0.0)
            self.register_variable(Real(o, causality=Fmi2Causality.output))
        self.values = {{k: PARAMETERS[k] for k in SCALARS}}
        for k in SCALARS:
            tunable = Real(
                k,
                causality=Fmi2Causality.parameter,
                variability=Fmi2Variability.tunable,
                getter=lambda k=k: self.values[k],
                setter=lambda v, k=k: self.values.update({{k: v}}),
            )
            self.register_variable(tunable, nested=False)
        self.running, self.step_s = None, DT

    def begin(self, step_s):
        """The state at the first sample, which has seen the first inputs."""
        parameters = {{**PARAMETERS, **self.values}}
        self.running, self.step_s = twin(parameters, step_s), step_s
        self.advance(0.0)

    def advance(self, t):
        found = self.running(np.array([t]), {{s: np.array([getattr(self, s)]) for s in INPUTS}})
        for o in OUTPUTS:
            setattr(self, o, float(found[o][0]))

    def exit_initialization_mode(self):
        self.begin(DT)

    def do_step(self, current_time, step_size):
        count = max(1, round(step_size / DT))
        if abs(step_size / count - self.step_s) > 1e-9 * DT:
            if current_time > 1e-12:
                return False  # steps of another length than at the beginning
            self.begin(step_size / count)
        for k in range(1, count + 1):
            self.advance(current_time + k * step_size / count)
        return True
'''


def check_pythonfmu() -> None:
    """Raise InputError if PythonFMU is not installed."""
    if importlib.util.find_spec("pythonfmu") is None:
        raise InputError("an FMU is built with PythonFMU, which is not installed; install it, or use --out FILE.py")


def write_fmu(twin: Corrected, module: str, out: Path) -> None:
    """Build the FMU at ``out`` around the Python ``module`` of the twin.

    Units are the twin's own (contract). Raises InputError for a twin that is a foreign program, or for a name that
    Python does not allow.
    """
    if isinstance(twin.model.twin, OpaqueTwin):
        raise InputError(f"a {twin.kind} twin is a program of its own; use --out FILE.py, FILE.toml or FILE.csv")
    if "smooth" in getattr(twin.model.twin, "holds", {}).values():
        raise InputError(
            "a smooth input (hold) depends on samples that an FMU has not seen yet; use --out FILE.py, FILE.toml or"
            " FILE.csv"
        )
    rec = twin.recording
    contexts = [s for s in rec.context if f'u["{s}"]' in module]
    for s in (*twin.model.twin.inputs, *contexts, *twin.model.twin.outputs):
        if not s.isidentifier():
            raise InputError(f"signal '{s}' is no name that an FMU built in Python can have; rename it in {rec.path}")
    from pythonfmu.builder import FmuBuilder  # pyright: ignore[reportMissingTypeStubs]

    name = re.sub(r"\W", "_", out.stem.capitalize())
    name = name if name.isidentifier() else f"Twin_{name}"
    slave = _SLAVE.format(
        inputs=(*twin.model.twin.inputs, *contexts), outputs=twin.model.twin.outputs, dt=rec.dt, name=name
    )
    with tempfile.TemporaryDirectory(prefix="micron-fmu-") as tmp:
        # a process that runs two such FMUs caches Python modules by name
        digest = hashlib.sha256(module.encode()).hexdigest()[:12]
        source = Path(tmp) / f"{name.lower()}_{digest}.py"
        source.write_text(module + slave, encoding="utf-8")
        (Path(tmp) / "out").mkdir()
        built = FmuBuilder.build_FMU(source, dest=Path(tmp) / "out")
        shutil.move(str(built), out)
