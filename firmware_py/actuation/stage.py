"""The actuation stage: predicted tremor -> wanted tip displacement -> strokes -> voltages."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.actuation.config import ActuationConfig
from firmware_py.actuation.hysteresis import (
    drive,
    extension,
    follow_drive,
    inverse_states,
    operator_dtype,
    operator_params,
    plays_after_rise,
)
from firmware_py.actuation.limits import limit_slew, limit_voltage, reach_scale
from firmware_py.actuation.manipulator import strokes_from_tip
from firmware_py.frame import (
    ALIGNING,
    CLIP,
    CLIP_SLEW,
    CLIP_VOLTAGE,
    CLIP_WORKSPACE,
    COMMAND,
    CONFIDENCE,
    DESIRED_TIP,
    SETTLING,
    STATUS,
    STROKE,
    TREMOR_AHEAD,
)
from firmware_py.records import Record, attributes, copy_record, new_record
from hal.compiled import kernel

# strokes are not quite linear in the displacement: each pass leaves about a hundredth of the excess
REACH_PASSES = 4


def _sizes(config: ActuationConfig) -> tuple[int, int]:
    return (
        max(len(stack.play_thresholds_V) for stack in config.stacks),
        max(len(stack.dead_zone_thresholds_um) for stack in config.stacks),
    )


def actuate_dtype(n_plays: int, n_zones: int) -> np.dtype[Any]:
    return np.dtype(
        [
            ("gain", "f8"),
            ("ramp_step", "f8"),
            ("min_confidence", "f8"),
            ("mounting", "f8", (3, 3)),
            ("ball_circle_m", "f8"),
            ("shaft_m", "f8"),
            ("lever_gain", "f8"),
            ("low_V", "f8"),
            ("high_V", "f8"),
            ("neutral_V", "f8"),
            ("slew_step_V", "f8"),
            ("stroke_low", "f8", (3,)),  # m from neutral
            ("stroke_high", "f8", (3,)),
            ("neutral_extension", "f8", (3,)),  # m
            ("stacks", operator_dtype(n_plays, n_zones), (3,)),
        ]
    )


def actuate_state_dtype(n_plays: int) -> np.dtype[Any]:
    return np.dtype(
        [
            ("on", "f8", (3,)),  # 0 .. 1, how far compensation of each axis is switched on
            ("command_V", "f8", (3,)),
            ("plays", "f8", (3, n_plays)),  # of the inverse operators
            ("trial", "f8", (n_plays,)),
        ]
    )


def _padded(config: ActuationConfig) -> list[Record]:
    """All stacks with the same numbers of operators: extra ones have weight zero beyond every other threshold."""
    plays, zones = _sizes(config)
    records: list[Record] = []
    for stack in config.stacks:
        r, w = list(stack.play_thresholds_V), list(stack.play_weights_um_per_V)
        d, s = list(stack.dead_zone_thresholds_um), list(stack.dead_zone_weights)
        while len(r) < plays:
            r, w = [*r, r[-1] + 1.0], [*w, 0.0]
        while len(d) < zones:
            d, s = [*d, d[-1] + 1.0], [*s, 0.0]
        records.append(
            operator_params(
                stack.model_copy(
                    update={
                        "play_thresholds_V": tuple(r),
                        "play_weights_um_per_V": tuple(w),
                        "dead_zone_thresholds_um": tuple(d),
                        "dead_zone_weights": tuple(s),
                    }
                )
            )
        )
    return records


def actuate_params(config: ActuationConfig) -> Record:
    """All numbers of the stage."""
    plays, zones = _sizes(config)
    params = new_record(
        actuate_dtype(plays, zones),
        gain=config.gain,
        ramp_step=1.0 / (config.ramp_s * config.tick_hz),
        min_confidence=config.min_confidence,
        mounting=config.mounting,
        ball_circle_m=config.ball_circle_m,
        shaft_m=config.shaft_m,
        lever_gain=config.lever_gain,
        low_V=config.low_V,
        high_V=config.high_V,
        neutral_V=config.neutral_V,
        slew_step_V=config.slew_V_per_s / config.tick_hz,
    )
    param = attributes(params)[0]
    for i, stack in enumerate(_padded(config)):
        param.stacks[i] = stack[0]
        at = attributes(stack)[0]
        risen = plays_after_rise(at.r, config.neutral_V)
        param.neutral_extension[i] = extension(config.neutral_V, risen, at)
        # what is reached whatever came before: the top erases all memory, the bottom is worst right after the top
        param.stroke_high[i] = extension(config.high_V, risen, at) - param.neutral_extension[i]
        param.stroke_low[i] = extension(config.low_V, risen, at) - param.neutral_extension[i]
    return params


def actuate_state(config: ActuationConfig, params: Record) -> Record:
    """At neutral, as after the amplifier's first rise from 0 V."""
    state = new_record(actuate_state_dtype(_sizes(config)[0]), command_V=config.neutral_V)
    for i in range(3):
        stack = attributes(params)[0].stacks[i]
        state["plays"][0, i] = inverse_states(stack.w, plays_after_rise(stack.r, config.neutral_V))
    return state


@kernel
def actuate_kernel(frame: NDArray[np.float64], states: Record, params: Record) -> None:
    """Fill the columns ``desired_tip`` to ``clip`` from ``tremor_ahead``, ``confidence`` and ``status``.

    Compensation of an axis fades in while its estimate is trusted and out while it is not. A wish that is not
    finite counts as zero.
    """
    state = states[0]
    param = params[0]
    status = int(frame[STATUS])
    ready = status & (ALIGNING | SETTLING) == 0
    wish = np.empty(3)
    for i in range(3):
        ahead = frame[TREMOR_AHEAD + i]
        trusted = ready and frame[CONFIDENCE + i] >= param.min_confidence and np.isfinite(ahead)
        step = param.ramp_step if trusted else -param.ramp_step
        state.on[i] = max(0.0, min(1.0, state.on[i] + step))
        wish[i] = -param.gain * state.on[i] * ahead if np.isfinite(ahead) else 0.0
    tip = frame[DESIRED_TIP : DESIRED_TIP + 3]
    stroke = frame[STROKE : STROKE + 3]
    for i in range(3):
        tip[i] = param.mounting[i, 0] * wish[0] + param.mounting[i, 1] * wish[1] + param.mounting[i, 2] * wish[2]
    clip = 0
    strokes_from_tip(tip, param.ball_circle_m, param.shaft_m, param.lever_gain, stroke)
    for _ in range(REACH_PASSES):
        scale = reach_scale(stroke, param.stroke_low, param.stroke_high)
        if scale == 1.0:
            break
        clip = CLIP_WORKSPACE
        for i in range(3):
            tip[i] *= scale
        strokes_from_tip(tip, param.ball_circle_m, param.shaft_m, param.lever_gain, stroke)
    for i in range(3):
        stack = param.stacks[i]
        plays = state.plays[i]
        state.trial[:] = plays
        wanted = drive(param.neutral_extension[i] + stroke[i], state.trial, stack)
        inside = limit_voltage(wanted, param.low_V, param.high_V)
        if inside != wanted:
            clip |= CLIP_VOLTAGE
        command = limit_slew(inside, state.command_V[i], param.slew_step_V)
        if command != inside:
            clip |= CLIP_SLEW
        if command == wanted:
            plays[:] = state.trial
        else:
            follow_drive(command, plays, stack)
        state.command_V[i] = command
        frame[COMMAND + i] = command
    frame[CLIP] = clip


class Actuation:
    """The actuation stage with its state; ``step`` works on one frame."""

    def __init__(self, config: ActuationConfig) -> None:
        self.config = config
        self.params = actuate_params(config)
        self.state = actuate_state(config, self.params)

    def step(self, frame: NDArray[np.float64]) -> None:
        actuate_kernel(frame, self.state, self.params)

    def reset(self) -> None:
        """At neutral, compensation off; to be called after the amplifier itself has gone to neutral."""
        copy_record(self.state, actuate_state(self.config, self.params))
