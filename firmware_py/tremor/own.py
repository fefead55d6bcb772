"""An estimator from another package (entry point group ``micron.estimators``) inside the compiled step.

The step calls it through an address that lies in the parameters, so that a new estimator compiles itself and nothing
of ours. It sees one axis at a time: the sample as configured, or none, and room for its memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numba
import numpy as np
from llvmlite import ir  # pyright: ignore[reportMissingTypeStubs]
from numba import types
from numba.core.errors import NumbaError
from numba.extending import intrinsic
from numba.np.numpy_support import carray

from firmware_py.records import Record, new_record
from firmware_py.tremor.config import METHODS, TremorConfig
from hal.errors import BenchError
from hal.plugins import ESTIMATORS, load

STATE = 256  # numbers of memory for each axis
NUMBERS = 64  # of the design
AXES = 3
OWN = np.dtype([("address", "i8"), ("numbers", "f8", (NUMBERS,))])
OWN_STATE = np.dtype([("memory", "f8", (AXES, STATE)), ("out", "f8", (AXES, 2))])


@dataclass(frozen=True)
class OwnEstimator:
    """Describes an estimator of another package, which the entry point names.

    ``design(config)``: up to ``NUMBERS`` numbers from the configuration, its own options are ``config.own``.
    ``step(memory, numbers, sample, have, out)``: one tick of one axis, written for numba. ``memory`` (STATE,) is
    zero at the start and kept; ``sample`` m/s^2 or m as ``config.sees``, behind the RC filter, counts only if ``have``;
    ``out`` (2,): tremor in m at the sample and ``config.loop_delay_s`` later. It must not raise.
    """

    design: Callable[[TremorConfig], Sequence[float]]
    step: Callable[..., None]


def own_params(config: TremorConfig) -> Record:
    """``address`` 0 for the methods that are built in. ``BenchError`` for a package that does not keep to the rules."""
    estimator = None if config.method in METHODS else load(ESTIMATORS, config.method, OwnEstimator)
    if estimator is None:
        return new_record(OWN)
    given = np.asarray(estimator.design(config), dtype=np.float64)
    if given.ndim != 1 or len(given) > NUMBERS or not np.isfinite(given).all():
        raise BenchError(f"estimator '{config.method}': its design must be up to {NUMBERS} finite numbers")
    numbers = np.zeros(NUMBERS)
    numbers[: len(given)] = given
    return new_record(OWN, address=_compiled(estimator.step).address, numbers=numbers)


@cache  # keeps the machine code alive as long as the process may use its address
def _compiled(step: Callable[..., None]) -> Any:
    inner: Any = step if hasattr(step, "py_func") else numba.njit(error_model="numpy")(step)
    floats = types.CPointer(types.float64)

    def call(memory: Any, numbers: Any, sample: float, have: int, out: Any) -> None:
        inner(carray(memory, STATE), carray(numbers, NUMBERS), sample, have != 0, carray(out, 2))

    signature: Any = types.void(floats, floats, types.float64, types.int64, floats)
    try:
        return numba.cfunc(signature, error_model="numpy")(call)
    except NumbaError as error:
        raise BenchError(f"step {step.__module__}.{step.__qualname__} cannot be compiled: {error}") from error


def _own_step(typing: Any, address: Any, memory: Any, numbers: Any, sample: Any, have: Any, out: Any) -> Any:
    i8, f8 = types.int64, types.float64

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        floats = ir.DoubleType().as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [floats, floats, ir.DoubleType(), ir.IntType(64), floats])
        function = builder.inttoptr(given[0], kind.as_pointer())
        place = [builder.inttoptr(given[i], floats) for i in (1, 2, 5)]
        builder.call(function, [place[0], place[1], given[3], given[4], place[2]])
        return context.get_dummy_value()

    return types.void(i8, i8, i8, f8, i8, i8), generate


own_step: Callable[..., None] = intrinsic(_own_step)
"""Lets kernels call the function at an address with memory, numbers, sample, have, out; arrays as addresses."""
