"""Attitude without gyroscopes: angular acceleration integrated twice, held by gravity and the magnetic field.

The instrument at rest is aligned by TRIAD; then ``error-state`` follows, or a filter that a package offers in the group
``micron.attitude`` (``AttitudeFilter``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from firmware_py.records import Records, new
from firmware_py.sensing.attitude_filter import AttitudeFilter, AttitudeParams, AttitudeState, Motion, OwnNumbers
from firmware_py.sensing.config import DEFAULT_METHOD, SensingConfig
from firmware_py.sensing.error_state import ERROR_STATE_FILTER
from firmware_py.sensing.quaternion import from_matrix, to_matrix
from firmware_py.sensing.triad import triad
from hal.arrays import Array
from hal.compiled import inlined_kernel, kernel
from hal.errors import BenchError
from hal.kernel_calls import ChosenKernel, call_entry, entry
from hal.plugins import ATTITUDE, load


@kernel
def _begin_own(north: Array, state: AttitudeState, params: OwnNumbers) -> None:
    call_entry(params.own.begin, north, state, params)


@kernel
def _step_own(motion: Motion, state: AttitudeState, params: OwnNumbers) -> None:
    call_entry(params.own.step, motion, state, params)


class _Own(NamedTuple):
    """The kernels of a package's filter, called by address: it compiles itself, and nothing of ours."""

    begin: Any = _begin_own
    step: Any = _step_own


_KERNELS = {"error_state": ERROR_STATE_FILTER, "own": _Own()}
"""Kernels by the name of the filter's own records."""
_begin = ChosenKernel(_KERNELS, "begin")
_step = ChosenKernel(_KERNELS, "step")


def _filter_of(config: SensingConfig) -> tuple[str, AttitudeFilter]:
    """Return the configured filter and the name of its own records."""
    if config.attitude_method == DEFAULT_METHOD:
        return "error_state", ERROR_STATE_FILTER
    other = load(ATTITUDE, config.attitude_method, AttitudeFilter)
    if other is None:
        raise BenchError(f"'{config.attitude_method}' is no attitude filter; see the key attitude_method of the bench")
    return "own", other


def attitude_params(config: SensingConfig) -> Records[AttitudeParams]:
    """Return the parameters of alignment and of the configured filter."""
    name, chosen = _filter_of(config)
    own: dict[str, Any] = {name: chosen.new_params(config)}
    params = new(
        chosen.params,
        align_samples=max(1.0, round(config.align_s * config.tick_hz)),
        dt_s=1.0 / config.tick_hz,
        **own,
    )
    if name == "own":
        state = new(chosen.state)
        motion = Motion(np.zeros(3), np.zeros(3), True, 1.0)
        params["own"]["begin"] = entry(chosen.begin, np.zeros(3), state[0], params[0])
        params["own"]["step"] = entry(chosen.step, motion, state[0], params[0])
    return params


def attitude_state(config: SensingConfig) -> Records[AttitudeState]:
    """Return the state before the first sample."""
    state = new(_filter_of(config)[1].state)
    restart(state[0])
    return state


@kernel
def restart(state: AttitudeState) -> None:
    """Forget everything; the next samples align anew."""
    state.quaternion[:] = 0.0
    state.quaternion[0] = 1.0
    state.rate[:] = 0.0
    state.bias[:] = 0.0
    state.previous[:] = 0.0
    state.field[:] = 0.0
    state.time_s = 0.0
    state.aligned = 0
    state.samples = 0.0
    state.sums[:, :] = 0.0
    to_matrix(state.quaternion, state.matrix)


@inlined_kernel
def align(
    state: AttitudeState,
    params: AttitudeParams,
    motion: Array,
    field: Array,
    fresh: bool,
) -> bool:
    """Average (f, alpha) and the field; after enough samples start from TRIAD. True once started."""
    for i in range(3):
        state.sums[0, i] += motion[i]
        state.sums[1, i] += motion[3 + i]
        if fresh:
            state.sums[2, i] += field[i]
    state.samples += 1.0
    if state.samples < params.align_samples:
        return False
    found = triad(state.sums[0], state.sums[2], state.matrix)
    from_matrix(state.matrix, state.quaternion)
    for i in range(3):
        state.field[i] = state.sums[2, i] if found else state.matrix[0, i]
    for i in range(3):
        # at rest on average, so the mean angular acceleration is bias
        state.bias[i] = state.sums[1, i] / state.samples
        state.previous[i] = motion[3 + i] - state.bias[i]
    _begin(state.field, state, params)
    state.aligned = 1
    state.time_s = state.samples * params.dt_s
    return True


@inlined_kernel
def step_attitude(
    state: AttitudeState,
    params: AttitudeParams,
    motion: Array,
    field: Array,
    fresh: bool,
    steps: int,
) -> None:
    """Compute one tick (``steps`` > 1 after lost scans) from (f, alpha) and, where ``fresh``, the field."""
    if fresh:
        for i in range(3):
            state.field[i] = field[i]
    dt = params.dt_s * steps
    state.time_s += dt
    _step(Motion(motion[:3], motion[3:6], fresh, dt), state, params)
