"""Runs the actuation stage: predicted tremor -> wanted tip displacement -> strokes -> amplifier output voltages."""

from __future__ import annotations

from math import exp

import numpy as np
from numpy.typing import NDArray

from firmware_py.actuation.config import ActuationConfig
from firmware_py.actuation.hysteresis import (
    Operator,
    drive,
    operator_params,
    plays_at,
    sizes_of,
    slopes_at,
    stack_stroke,
)
from firmware_py.actuation.limits import limit_slew, limit_voltage
from firmware_py.actuation.manipulator import Geometry, star_tip, strokes_from_tip, tip_from_strokes
from firmware_py.actuation.reach import inside, nearest_reachable
from firmware_py.actuation.yielding import Swing, YieldLimits, YieldState, shrink_core, yield_rest
from firmware_py.frame import (
    ALIGNING,
    CLIP,
    CLIP_SINGULAR,
    CLIP_SLEW,
    CLIP_VOLTAGE,
    CLIP_WORKSPACE,
    CLIP_YIELD,
    COMMAND,
    CONFIDENCE,
    DESIRED_TIP,
    SETTLING,
    STATUS,
    STROKE,
    TREMOR_AHEAD,
    TREMOR_CORE,
)
from firmware_py.records import Records, attributes, copy_record, field, new, record
from hal.arrays import Array, IntArray
from hal.compiled import kernel
from hal.scratch import scratch

LIMITS = ("workspace", "voltage", "slew", "singular", "yield")  # the bits of Clip in order
TAPS = 16  # the most that a configuration may have; one size, one compilation


@record
class ActuateParams:
    """Holds the parameters of the stage."""

    gain: float = field("1")
    ramp_step: float = field("1")
    rest_keep: float = field("1")
    min_confidence: float = field("1")
    tick_hz: float = field("Hz")
    yield_keep: float = field("1")
    overdrive: float = field("1")
    tilts: int = field("1")
    overdrive_tilt: float = field("1")
    yield_attack: float = field("1")
    centre: float = field("m")  # of every stroke, where compensation works about
    mounting: Array = field("1", 3, 3)
    geometry: Geometry = field("")
    low_V: float = field("V")
    high_V: float = field("V")
    neutral_V: float = field("V")
    slew_step_V: float = field("V")
    stroke_low: Array = field("m", 3)  # from neutral
    stroke_high: Array = field("m", 3)
    swing_low: Array = field("m", 3)  # from ``centre``
    swing_high: Array = field("m", 3)
    neutral_stroke: Array = field("m", 3)
    taps: Array = field("1", 3, TAPS)
    stacks: Records[Operator] = field("", 3)


@record
class ActuateState:
    """Holds the state of the stage."""

    on: Array = field("1", 3)  # 0 .. 1, how far compensation of each axis is switched on
    tilt: Array = field("rad", 2)  # of the shaft, where the next inverse kinematics starts
    yielding: YieldState = field("")
    strokes: Array = field("m", 3, TAPS)  # wanted ones, newest first
    target: Array = field("m", 3)  # stroke from neutral that was asked of the stack
    rest: Array = field("m", 3)  # what hysteresis had left of the stroke when a hold ended; fades
    command_V: Array = field("V", 3)
    plays: Array = field("V", 3, "plays")
    creep: Array = field("m", 3, "creep")
    slopes: Array = field("m/V", "plays")
    limited: IntArray = field("1", len(LIMITS))  # ticks in which each limit took


def geometry_of(config: ActuationConfig) -> Records[Geometry]:
    """Return the kinematics' parameters."""
    geometry = new(
        Geometry,
        circle_m=config.ball_circle_m,
        shaft_m=config.shaft_m,
        lever=config.lever_gain,
        rest_m=config.rest_heights_m,
    )
    star_tip(geometry["rest_m"][0], config.ball_circle_m, config.shaft_m, geometry["rest_tip"][0])
    return geometry


def actuate_params(config: ActuationConfig) -> Records[ActuateParams]:
    """Return all parameters of the stage."""
    sizes = sizes_of(*config.stacks)
    params = new(
        ActuateParams,
        dict(zip(("plays", "zones", "creep"), sizes, strict=True)),
        gain=config.gain,
        ramp_step=1.0 / (config.ramp_s * config.tick_hz),
        rest_keep=exp(-1.0 / (config.ramp_s * config.tick_hz)),
        min_confidence=config.min_confidence,
        tick_hz=config.tick_hz,
        yield_keep=exp(-1.0 / (config.yield_s * config.tick_hz)),
        overdrive=config.overdrive,
        tilts=config.overdrive_tilts,
        overdrive_tilt=config.overdrive_tilt,
        yield_attack=1.0 - exp(-1.0 / (config.yield_attack_s * config.tick_hz)) if config.yield_attack_s > 0.0 else 1.0,
        mounting=config.mounting,
        geometry=geometry_of(config),
        low_V=config.low_V,
        high_V=config.high_V,
        neutral_V=config.neutral_V,
        slew_step_V=config.slew_V_per_s / config.tick_hz,
        taps=np.array([taps + (0.0,) * (TAPS - len(taps)) for taps in config.feedforward]),
    )
    param = attributes(params)[0]
    slopes = np.empty(sizes[0])
    for i, stack in enumerate(config.stacks):
        record = operator_params(stack, config.tick_hz, sizes)
        # without creep: the range must be there at once
        quick = stack.model_copy(update={"creep_times_s": (), "creep_shares": ()})
        at = attributes(operator_params(quick, config.tick_hz, sizes))[0]
        slopes_at(0.0, at, slopes)
        plays, creep = plays_at(at, config.neutral_V, config.high_V), np.zeros(sizes[2])
        volts = (config.neutral_V, config.high_V, config.low_V)
        rest, high, low = (stack_stroke(v, slopes, plays, creep, at) for v in volts)
        # what is reached whatever came before: the top erases all memory, the bottom is worst right after the top
        param.neutral_stroke[i] = rest
        param.stroke_high[i] = high - rest
        param.stroke_low[i] = low - rest
        record["creep_reference"] = rest
        param.stacks[i] = record[0]
    # the same for all stacks: it moves the tip along the shaft alone
    param.centre = config.centring * 0.5 * float(np.max(param.stroke_low) + np.min(param.stroke_high))
    param.swing_low[:] = param.stroke_low - param.centre
    param.swing_high[:] = param.stroke_high - param.centre
    return params


def actuate_state(config: ActuationConfig, params: Records[ActuateParams]) -> Records[ActuateState]:
    """Return the state at neutral, as it is after the amplifier's first rise from 0 V."""
    plays, _, creep = sizes_of(*config.stacks)
    state = new(ActuateState, {"plays": plays, "creep": creep}, command_V=config.neutral_V)
    for i in range(3):
        state["plays"][0, i] = plays_at(attributes(params)[0].stacks[i], config.neutral_V, config.high_V)
    return state


@kernel
def command_stack(target: float, i: int, state: ActuateState, param: ActuateParams) -> tuple[float, int]:
    """Return the limited drive V of stack ``i`` for the stroke ``target`` (m from neutral), and the Clip bits of the
    limits that acted.

    Moves the model's plays and creep by what is commanded, so that after a limit it still knows the stack.
    """
    stack, plays, creep, slopes = param.stacks[i], state.plays[i], state.creep[i], state.slopes
    clip = 0
    if slopes_at(abs(target - state.target[i]) * param.tick_hz, stack, slopes):
        clip |= CLIP_SINGULAR
    wanted = drive(param.neutral_stroke[i] + target, slopes, plays, creep, stack)
    inside_V = limit_voltage(wanted, param.low_V, param.high_V)
    if inside_V != wanted:
        clip |= CLIP_VOLTAGE
    command = limit_slew(inside_V, state.command_V[i], param.slew_step_V)
    if command != inside_V:
        clip |= CLIP_SLEW
    stack_stroke(command, slopes, plays, creep, stack)
    return command, clip


@kernel
def actuate_kernel(frame: Array, states: Records[ActuateState], params: Records[ActuateParams]) -> None:
    """Fill the columns ``desired_tip`` to ``clip`` from ``tremor_ahead``, ``confidence`` and ``status``.

    Compensation of an axis fades in while its estimate is trusted and out while it is not. A wish that is not
    finite counts as zero. What is not ``tremor_core`` yields before a stroke ends, and a core beyond it is shrunk
    (``yielding``).
    """
    state = states[0]
    param = params[0]
    status = int(frame[STATUS])
    ready = status & (ALIGNING | SETTLING) == 0
    wish, least = scratch(3), scratch(3)
    for i in range(3):
        ahead, core = frame[TREMOR_AHEAD + i], frame[TREMOR_CORE + i]
        trusted = ready and frame[CONFIDENCE + i] >= param.min_confidence and np.isfinite(ahead)
        step = param.ramp_step if trusted else -param.ramp_step
        state.on[i] = max(0.0, min(1.0, state.on[i] + step))
        wish[i] = -param.gain * state.on[i] * ahead if np.isfinite(ahead) else 0.0
        least[i] = -param.gain * state.on[i] * core if np.isfinite(ahead) and np.isfinite(core) else 0.0
    core_tip, core_stroke = scratch(3), scratch(3)
    tip = frame[DESIRED_TIP : DESIRED_TIP + 3]
    stroke = frame[STROKE : STROKE + 3]
    for i in range(3):
        row = param.mounting[i]
        tip[i] = row[0] * wish[0] + row[1] * wish[1] + row[2] * wish[2]
        core_tip[i] = row[0] * least[0] + row[1] * least[1] + row[2] * least[2]
    clip = 0
    strokes_from_tip(tip, param.geometry, state.tilt, stroke)
    strokes_from_tip(core_tip, param.geometry, state.yielding.tilt, core_stroke)
    low, high = param.swing_low, param.swing_high
    swing = Swing(stroke, core_stroke)
    limits = YieldLimits(
        low, high, param.yield_keep, param.overdrive, param.tilts, param.overdrive_tilt, param.yield_attack
    )
    shrunk = shrink_core(swing, state.yielding, limits)
    if yield_rest(swing, state.yielding, limits) or shrunk:
        clip |= CLIP_YIELD
        tip_from_strokes(stroke, param.geometry, tip)
    if not inside(stroke, low, high):
        clip |= CLIP_WORKSPACE
        nearest_reachable(tip, param.geometry, low, high, stroke)
    if param.centre != 0.0:
        on = min(state.on[0], state.on[1], state.on[2])
        share = on * on * (3.0 - 2.0 * on)  # the way to the middle and back has no corners
        for i in range(3):
            stroke[i] += share * param.centre
        tip_from_strokes(stroke, param.geometry, tip)
    for i in range(3):
        past = state.strokes[i]
        for k in range(len(past) - 1, 0, -1):
            past[k] = past[k - 1]
        past[0] = stroke[i]
        target = 0.0
        for k in range(len(past)):
            target += param.taps[i, k] * past[k]
        target += state.rest[i]
        state.rest[i] *= param.rest_keep
        command, limited = command_stack(target, i, state, param)
        clip |= limited
        state.target[i] = target
        state.command_V[i] = command
        frame[COMMAND + i] = command
    frame[CLIP] = clip
    for bit in range(len(state.limited)):
        state.limited[bit] += (clip >> bit) & 1


@kernel
def rest_kernel(states: Records[ActuateState]) -> None:
    """Keep, after ``follow_kernel``, the stroke that hysteresis has left at neutral. It fades as compensation fades
    in, so that the first command after a hold is neutral itself."""
    state = states[0]
    for i in range(3):
        state.rest[i] = state.target[i]
        state.strokes[i, :] = 0.0


class Actuation:
    """Holds the actuation stage with its state; ``step`` works on one frame."""

    def __init__(self, config: ActuationConfig) -> None:
        self.config = config
        self.params = actuate_params(config)
        self.state = actuate_state(config, self.params)

    def step(self, frame: NDArray[np.float64]) -> None:
        actuate_kernel(frame, self.state, self.params)

    @property
    def limited(self) -> dict[str, int]:
        """Return the number of ticks since the last reset in which the command ran into each limit."""
        return dict(zip(LIMITS, map(int, self.state["limited"][0]), strict=True))

    def reset(self) -> None:
        """Restore the state at neutral: compensation off, counts at zero. The amplifier must be at neutral already."""
        copy_record(self.state, actuate_state(self.config, self.params))
