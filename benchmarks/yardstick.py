"""The C version of the step: compiled with whatever compiler the machine has, run on the firmware's own records."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_py import frame
from firmware_py.control.chain import COMMANDED, GIVEN_BITS
from firmware_py.control.stages import Stages

SOURCE = Path(__file__).with_suffix(".c")
FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fPIC", "-shared", "-std=gnu11")
STAGES = ("sense", "estimate", "detect", "actuate")
CONSTANTS = """
TICK COUNTS MAGNETOMETER_RAW MAGNETOMETER_FRESH VOLTS SUPPLY TEMPERATURE ACCELEROMETER MAGNETOMETER SPECIFIC_FORCE
ANGULAR_ACCELERATION RATE QUATERNION TIP_ACCELERATION TIP_DISPLACEMENT TREMOR TREMOR_AHEAD TREMOR_CORE TREMOR_FREQUENCY
TREMOR_AMPLITUDE CONFIDENCE DESIRED_TIP STROKE COMMAND CLIP STATUS SIZE SATURATED ALIGNING SETTLING JERK DRIFT
CLIP_VOLTAGE CLIP_SLEW CLIP_SINGULAR
""".split()  # noqa: SIM905, forty names read better as text


def compiler() -> str | None:
    """The first C compiler on the path."""
    return next((path for name in ("cc", "gcc", "clang") if (path := shutil.which(name))), None)


def _struct(name: str, dtype: np.dtype, done: dict[str, str]) -> None:
    """C structs of a record dtype and of what is nested in it, innermost first; nothing needs padding."""
    lines = []
    for field in dtype.names or ():
        kind, shape = dtype[field].base, dtype[field].shape
        if kind.names:
            _struct(f"{name}_{field}", kind, done)
            kind_name = f"{name}_{field}"
        else:
            kind_name = {"f8": "double", "i8": "int64_t", "c16": "double _Complex"}[kind.str[1:]]
        lines.append(f"    {kind_name} {field}{''.join(f'[{n}]' for n in shape)};")
    check = f'_Static_assert(sizeof({name}) == {dtype.itemsize}, "{name}");'
    done[name] = "typedef struct {\n" + "\n".join(lines) + f"\n}} {name};\n{check}\n"


def layout(stages: Stages) -> str:
    """``layout.h``: the records of ``stages`` and the columns of the frame."""
    done: dict[str, str] = {}
    names = [f"{stage}_{part}" for stage in STAGES for part in ("state", "params")]
    for name, record in zip(names, stages.arguments, strict=True):
        _struct(name, record.dtype, done)
    columns = [f"#define {name} {getattr(frame, name)}" for name in CONSTANTS]
    bits = [f"#define COMMANDED {COMMANDED}", f"#define GIVEN_BITS {GIVEN_BITS}"]
    return "\n".join(["#include <stdint.h>", *columns, *bits, *done.values()])


class Yardstick:
    """The compiled C step on the records of ``stages``. ``FileNotFoundError`` without a compiler."""

    def __init__(self, stages: Stages, flags: tuple[str, ...] = FLAGS) -> None:
        found = compiler()
        if found is None:
            raise FileNotFoundError("no C compiler (cc, gcc, clang) on the path")
        self.stages = stages
        with tempfile.TemporaryDirectory(prefix="micron-") as folder:
            (Path(folder) / "layout.h").write_text(layout(stages))
            library = Path(folder) / "yardstick.so"
            command = [found, *flags, f"-I{folder}", str(SOURCE), "-o", str(library), "-lm"]
            subprocess.run(command, check=True, capture_output=True, text=True)
            self._library = ctypes.CDLL(str(library))
        self._records = tuple(ctypes.c_void_p(record.ctypes.data) for record in stages.arguments)
        self._frame = ctypes.c_void_p(stages.frame.ctypes.data)
        self._step = self._library.instrument_step

    def step(self) -> int:
        """One tick on ``stages.frame``; nonzero when it would leave the regular way."""
        return self._step(self._frame, *self._records)

    def run(self, rows: NDArray[np.float64]) -> int:
        """As ``Stages.run``; how many rows were done."""
        return self._library.instrument_run(ctypes.c_void_p(rows.ctypes.data), len(rows), self._frame, *self._records)

    def run_stage(self, stage: str, rows: NDArray[np.float64]) -> int:
        """One stage over finished rows; how many were done."""
        at = ctypes.c_void_p(rows.ctypes.data)
        return self._library.instrument_run_stage(STAGES.index(stage), at, len(rows), *self._records)
