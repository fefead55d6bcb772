"""Attitude without gyroscopes: angular acceleration integrated twice, held by gravity and the magnetic field.

The instrument at rest is aligned by TRIAD; then one of ``FILTERS`` follows, which the records are made for.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from firmware_py.records import Array, Records, new
from firmware_py.sensing.attitude_filter import AttitudeFilter, AttitudeParams, AttitudeState, Motion
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.error_state import ERROR_STATE_FILTER
from firmware_py.sensing.observer import OBSERVER
from firmware_py.sensing.quaternion import from_matrix, to_matrix
from firmware_py.sensing.quaternion_kalman import QUATERNION_KALMAN_FILTER
from firmware_py.sensing.triad import triad
from hal.compiled import inlined_kernel, kernel
from hal.kernel_calls import ChosenKernel

FILTERS: Mapping[str, AttitudeFilter] = {
    "observer": OBSERVER,
    "error_state": ERROR_STATE_FILTER,
    "quaternion_kalman": QUATERNION_KALMAN_FILTER,
}
"""Filters by the name of their records."""
_begin = ChosenKernel(FILTERS, "begin")
_step = ChosenKernel(FILTERS, "step")


def chosen_filter(config: SensingConfig) -> str:
    """Return the name of the configured filter's records."""
    return config.attitude_method.replace("-", "_")


def attitude_params(config: SensingConfig) -> Records[AttitudeParams]:
    """Return the parameters of alignment and of the configured filter."""
    name = chosen_filter(config)
    own: dict[str, Any] = {name: FILTERS[name].new_params(config)}
    return new(
        FILTERS[name].params,
        align_samples=max(1.0, round(config.align_s * config.tick_hz)),
        dt_s=1.0 / config.tick_hz,
        **own,
    )


def attitude_state(config: SensingConfig) -> Records[AttitudeState]:
    """Return the state before the first sample."""
    state = new(FILTERS[chosen_filter(config)].state)
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
