"""Runs an estimator of another package (entry point group ``micron.estimators``) inside the compiled step.

The step calls it through an address that lies in the parameters, so that a new estimator compiles itself and nothing
of ours. It gets one axis at a time: the sample as configured, or none in a tick that coasts, and room for its memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, cast

import numba
import numpy as np
from llvmlite import ir  # pyright: ignore[reportMissingTypeStubs]
from numba import types
from numba.core import cgutils
from numba.core.errors import NumbaError
from numba.extending import intrinsic
from numba.np.numpy_support import carray

from firmware_py.records import Records, field, new, record
from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.family import AXES, EstimatorParams, EstimatorState, Family, Samples
from hal.arrays import Array
from hal.compiled import kernel
from hal.errors import BenchError
from hal.plugins import ESTIMATORS, load

STATE = 256
"""Default length of an estimator's memory, per axis."""
NUMBERS = 64
"""Default length of an estimator's parameters."""


@record
class OwnParams:
    """Holds the arguments of an estimator of another package."""

    address: int = field("1")  # of its step
    numbers: Array = field("as its design says", "numbers")


@record
class OwnState:
    """Holds the memory and the results of an estimator of another package."""

    memory: Array = field("as its step says", AXES, "memory")
    out: Array = field("m", AXES, 2)  # tremor now, tremor a loop delay later


@record
class ForeignEstimator(EstimatorState):
    """The estimator's state with that of another package's."""

    own: OwnState = field("")


@record
class ForeignNumbers(EstimatorParams):
    """The estimator's parameters with those of another package's."""

    own: OwnParams = field("")


@dataclass(frozen=True)
class OwnEstimator:
    """Describes an estimator of another package, which the entry point names.

    ``design(config)`` returns up to ``most_numbers`` finite numbers; the bench's options for it are ``config.own``.
    ``step(memory, numbers, sample, have, out)`` runs one tick of one axis and is written for numba. ``memory``
    (most_memory,) is zero at the start and kept. ``sample`` is in m/s^2 or m, as ``config.sees`` says, behind the RC
    filter; with ``have`` False there is none, on all axes of that tick, and the model coasts. ``step`` fills ``out``
    (2,), the tremor (m) at the sample and ``config.loop_delay_s`` later, and must not raise.
    Other sizes than the defaults compile the whole step of the instrument anew.
    """

    design: Callable[[TremorConfig], Sequence[float] | Array]
    step: Callable[..., None]
    most_memory: int = STATE
    most_numbers: int = NUMBERS


def _estimator(config: TremorConfig) -> OwnEstimator:
    estimator = load(ESTIMATORS, config.method, OwnEstimator)
    if estimator is None:
        raise BenchError(f"'{config.method}' is no estimator")
    return estimator


def own_params(config: TremorConfig) -> Records[OwnParams]:
    """Return the address and the numbers of the method's step. Raises ``BenchError`` if the design does not return
    finite numbers or the step cannot be compiled."""
    estimator = _estimator(config)
    most = estimator.most_numbers
    given = np.asarray(estimator.design(config), dtype=np.float64)
    if given.ndim != 1 or len(given) > most or not np.isfinite(given).all():
        raise BenchError(f"estimator '{config.method}': its design must be up to {most} finite numbers")
    numbers = np.zeros(most)
    numbers[: len(given)] = given
    return new(OwnParams, {"numbers": most}, address=_compiled(estimator).address, numbers=numbers)


@cache  # keeps the machine code alive as long as the process may use its address
def _compiled(estimator: OwnEstimator) -> Any:
    step, most_memory, most_numbers = estimator.step, estimator.most_memory, estimator.most_numbers
    inner: Any = step if hasattr(step, "py_func") else numba.njit(error_model="numpy")(step)
    floats = types.CPointer(types.float64)

    def call(memory: Any, numbers: Any, sample: float, have: int, out: Any) -> None:
        inner(carray(memory, most_memory), carray(numbers, most_numbers), sample, have != 0, carray(out, 2))

    signature: Any = types.void(floats, floats, types.float64, types.int64, floats)
    try:
        return numba.cfunc(signature, error_model="numpy")(call)
    except NumbaError as error:
        raise BenchError(f"step {step.__module__}.{step.__qualname__} cannot be compiled: {error}") from error


def _own_step(typing: Any, address: Any, where: Any, sample: Any, have: Any) -> Any:
    i8, f8 = types.int64, types.float64

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        floats = ir.DoubleType().as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [floats, floats, ir.DoubleType(), ir.IntType(64), floats])
        function = builder.inttoptr(given[0], kind.as_pointer())
        places = cast(Any, cgutils).unpack_tuple(builder, given[1], 3)
        memory, numbers, out = (builder.inttoptr(place, floats) for place in places)
        builder.call(function, [memory, numbers, given[2], given[3], out])
        return context.get_dummy_value()

    return types.void(i8, types.UniTuple(i8, 3), f8, i8), generate


own_step: Callable[..., None] = intrinsic(_own_step)
"""Lets kernels call the function at an address with (memory, numbers, out) as addresses, sample, have."""


@kernel
def _run(i: int, have: bool, sample: float, state: ForeignEstimator, params: ForeignNumbers) -> None:
    memory, numbers, out = state.own.memory[i], params.own.numbers, state.own.out[i]
    own_step(params.own.address, (memory.ctypes.data, numbers.ctypes.data, out.ctypes.data), sample, int(have))


@kernel
def _tick(coasts: bool, state: ForeignEstimator, params: ForeignNumbers) -> None:
    if coasts:
        for i in range(AXES):
            _run(i, False, 0.0, state, params)


@kernel
def _sample(samples: Samples, state: ForeignEstimator, params: ForeignNumbers) -> None:
    for i in range(AXES):
        _run(i, True, samples.tip[i], state, params)


@kernel
def _output(axis: int, state: ForeignEstimator, params: ForeignNumbers) -> tuple[float, float, float]:
    out = state.own.out[axis]
    return out[0], out[1], out[1]


def _state(config: TremorConfig) -> Records[OwnState]:
    return new(OwnState, {"memory": _estimator(config).most_memory})


FOREIGN = Family(ForeignNumbers, ForeignEstimator, own_params, _state, _tick, _sample, _output)
