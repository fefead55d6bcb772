"""The targeting experiment played by a synthetic user, straight or through the emulated bench in virtual time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from firmware_py.endoscope.app import EndoscopePlan
from firmware_py.endoscope.config import EndoscopeConfig, load_endoscope_config
from firmware_py.endoscope.report import experiment
from firmware_py.endoscope.targets import GameConfig, GameState, TargetGame
from firmware_py.endoscope.wiring import is_endoscope
from firmware_py.run.session import run_plan
from firmware_py.run_request import RunRequest, open_requested
from hal.bench import OpenBench, load_bench
from hal.clock import VirtualClock
from tools.errors import InputError
from tools.research.endoscope.user import SyntheticUser, Task, UserConfig

STEP_S = 0.01
LIMIT_S = 600.0


def task_of(game: GameConfig) -> Task:
    """Return the user's knowledge of the device after a trial."""
    control = game.control
    return Task(control.mapping, control.gain, control.response_s, game.tolerance_px)


def play(user: UserConfig, game: GameConfig, limit_s: float = LIMIT_S) -> dict[str, Any]:
    """The user's angles and button straight into the state machine, 100 times a second; the experiment's report."""
    machine = TargetGame(game)
    person = SyntheticUser(user, task_of(game))
    state, k = machine.state(), 0
    while not state.done and k * STEP_S < limit_s:
        t = k * STEP_S
        hand = person.step(state, t)
        state = machine.step(hand.angles_deg, hand.pressed, t)
        k += 1
    return experiment(machine)


def play_on_bench(
    bench_file: Path,
    user: UserConfig,
    game: GameConfig | None = None,
    *,
    seed: int | None = None,
    record: Path | None = None,
    limit_s: float = LIMIT_S,
) -> dict[str, Any]:
    """The user turns the emulated card and presses its button; lines, driver, filter and control do the rest.

    ``InputError`` for a bench that has no emulated motion card.
    """
    bench = load_bench(bench_file)
    if not is_endoscope(bench.description):
        raise InputError(f"{bench_file}: no endoscope bench (a motion card, and no DAQ or amplifier)")
    config = load_endoscope_config(bench)
    config = EndoscopeConfig(**{**config.model_dump(), "game": (game or config.game).model_dump()})
    request = RunRequest(bench_file, limit_s, pace="virtual", record=record, seed=seed)
    cards = bench.description.devices_with("motion_card")
    if not cards:
        raise InputError(f"{bench_file}: [device] declares no motion_card that a user could hold")
    emulation = dict(bench.description.emulation)
    emulation["endoscope"] = {**emulation.get("endoscope", {}), "scenario": "led", "presses": ()}
    described = bench.description.model_copy(update={"emulation": emulation})
    led = replace(bench, description=described)
    with open_requested(request, led, None) as opened:
        hands = _HandsOn(opened, next(iter(cards)), SyntheticUser(user, task_of(config.game)))
        plan = EndoscopePlan(led, config, hands.see, until_done=True)
        return run_plan(request, plan, opened, None)[1]


class _HandsOn:
    """The user's hand on the truth face of the emulated card: 100 times a second, whatever the firmware does."""

    def __init__(self, opened: OpenBench, card: str, user: SyntheticUser) -> None:
        assert isinstance(opened.clock, VirtualClock)
        assert opened.world is not None
        world = opened.world.world  # type: ignore[attr-defined]  # LockstepWorld
        self._clock, self._plant, self._card = opened.clock, world.plant, world.devices[card]
        self._epoch_ns = world.epoch_ns
        self._user = user
        self._state: GameState | None = None
        self._since_ns = self._clock.now_ns()
        self._clock.at(self._since_ns + round(STEP_S * 1e9), self._move)

    def see(self, state: GameState, t_ns: int) -> None:
        """Store the state that the firmware displays."""
        self._state = state

    def _move(self, t_ns: int) -> None:
        self._clock.at(t_ns + round(STEP_S * 1e9), self._move)
        if self._state is None:
            return
        hand = self._user.step(self._state, (t_ns - self._since_ns) * 1e-9)
        parts = (hand.angles_deg, hand.rates_deg_s, hand.accelerations_deg_s2)
        angles, rates, accelerations = (np.radians([*part, 0.0]) for part in parts)
        self._plant.lead(t_ns - self._epoch_ns, angles, rates, accelerations)
        if hand.pressed:
            self._card.press()
        else:
            self._card.release()
