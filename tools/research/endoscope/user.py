"""A synthetic user of the targeting experiment: eyes, a delay, a plan, a hand and a thumb.

The hand follows McRuer's crossover model of the human operator (McRuer, Jex 1967; McRuer, Krendel, AGARD-AG-188,
1974): whatever the controlled element is, operator and element together behave as omega_c exp(-s tau) / s. With
position mapping behind the response filter, K / (T s + 1), the operator therefore integrates and leads with T; with
speed mapping, K / (s (T s + 1)), the operator is proportional and leads with T. People lead by about a second at most,
so from there on they become slower and ring. Where the hand's place is the view's place (position mapping), the first
movement is an aimed one that needs no eyes (Woodworth's two components, 1899): it goes where the goal is, misses by
some percent (Schmidt 1979), and correcting begins once the view has had its response time. The rest (time to decide, to
press, noise, reach of the wrist) is ordinary and not fitted to the document's tables; the aimed movement was added
after a comparison with them, see docs/endoscope.md.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from firmware_py.endoscope.control import INACTIVE, MOVE, ZOOM, View
from firmware_py.endoscope.targets import GameState
from hal.validation import StrictTable

Phase = Literal["look", "return", "press", "steer", "stop"]
Pair = tuple[float, float]
SLOPE_S = 0.15
"""A speed is not seen at an instant."""
SEE_S = 0.15
"""Beside the reaction time: to see what a press did."""
REST_LAGS = 5.0


class UserConfig(StrictTable):
    """Describes a person. Times in s, angles in deg."""

    name: str = "user"
    seed: int = Field(default=1, ge=0)
    reaction_s: float = Field(default=0.25, ge=0.0, le=2.0)
    """From the screen to the hand: tau of the crossover model with the muscles' part left out."""
    crossover_rad_s: float = Field(default=1.5, gt=0.0, le=10.0)
    """Careful pointing: half of the 3 to 4.5 rad/s of tracking at full effort, for little overshoot."""
    longest_lead_s: float = Field(default=1.0, ge=0.0)
    muscle_s: float = Field(default=0.1, gt=0.0)
    """Both lags of the arm and the wrist."""
    decide_s: float = Field(default=0.6, ge=0.0)
    short_press_s: float = Field(default=0.15, gt=0.0, lt=0.5)
    long_press_s: float = Field(default=0.7, gt=0.5)
    eye_px: float = Field(default=1.5, ge=0.0)
    """Noise of what is seen."""
    tremor_deg: float = Field(default=0.15, ge=0.0)
    reach_deg: float = Field(default=30.0, gt=1.0, le=90.0)
    """Beyond it the user stops, turns the hand back and starts again."""
    aim_spread: float = Field(default=0.08, ge=0.0, lt=0.5)
    """Of an aimed movement: standard deviation of its length, relative."""
    fastest_deg_s: float = Field(default=60.0, gt=1.0)
    content: float = Field(default=0.6, gt=0.0, lt=1.0)
    """Stops steering when the error is this part of the tolerance, and has been for ``dwell_s``."""
    dwell_s: float = Field(default=0.3, ge=0.0)


@dataclass(frozen=True)
class Task:
    """Holds the user's knowledge of the device, which is tried out before the experiment."""

    mapping: Literal["position", "speed"]
    gain: float
    response_s: float
    tolerance_px: float


@dataclass(frozen=True, slots=True)
class Hand:
    """Roll psi and pitch theta in deg with two derivatives, and the thumb."""

    angles_deg: Pair
    rates_deg_s: Pair
    accelerations_deg_s2: Pair
    pressed: bool


class SyntheticUser:
    """Call ``step`` at an even rate with the newest screen; deterministic for its seed."""

    def __init__(self, config: UserConfig, task: Task) -> None:
        self.config, self.task = config, task
        self._rng = np.random.default_rng([config.seed, 0xE7D0])
        self._noise: list[float] = []
        self._seen: deque[tuple[float, GameState]] = deque()
        self._phase: Phase = "look"
        self._goal = MOVE
        self._target: View | None = None
        self._until_s = config.decide_s
        self._pressed_since: float | None = None
        self._press_s = 0.0
        self._good_since: float | None = None
        self._end_since: float | None = None
        self._aim: Pair | None = None
        self._arrived: float | None = None
        self._command = [0.0, 0.0]
        self._error: Pair = (0.0, 0.0)
        self._slope = [0.0, 0.0]
        self._position, self._velocity = [0.0, 0.0], [0.0, 0.0]
        self._t: float | None = None
        self._tremor = [(2.0 * math.pi * self._rng.uniform(8.0, 11.0), self._rng.uniform(0.0, 6.28)) for _ in range(2)]

    def step(self, state: GameState, t: float) -> Hand:
        """The hand at ``t`` (s, growing) after having looked at ``state``."""
        dt = 0.0 if self._t is None else t - self._t
        self._t = t
        self._seen.append((t, state))
        while len(self._seen) > 1 and self._seen[1][0] <= t - self.config.reaction_s:
            self._seen.popleft()
        self._think(self._seen[0][1], t, dt)
        return self._move(t, dt)

    # ------------------------------------------------------------------ what to do

    def _think(self, seen: GameState, t: float, dt: float) -> None:
        if self._pressed_since is not None:
            if t - self._pressed_since >= self._press_s:
                self._pressed_since = None
            return
        if seen.done or t < self._until_s:
            return
        c = self.config
        if self._phase == "look":
            self._look(seen, t)
        elif self._phase == "return":
            self._press(t, c.short_press_s if self._goal == MOVE else c.long_press_s)
            self._phase = "press"
        elif self._phase == "press":  # it has been made, and its effect is on the screen by now
            self._good_since = self._end_since = None
            self._slope = [0.0, 0.0]
            self._error = self._off(seen)
            self._arrived = None
            self._aim = self._aim_at(self._error) if self.task.mapping == "position" else None
            self._phase = "steer" if seen.status == self._goal else "look"
        elif self._phase == "steer":
            if seen.status != self._goal:
                self._phase = "look"
                return
            error = self._off(seen)
            worst = max(abs(error[0]), abs(error[1]))
            stuck = self._at_the_end(t) and worst > self.task.tolerance_px
            if seen.target != self._target or stuck or self._content(worst, t):
                self._stop(t)
            elif not self._aiming(error, t, dt):
                self._steer(error, dt)
        else:
            self._phase = "look"
            self._until_s = t + (0.0 if seen.target == self._target else c.decide_s)

    def _look(self, seen: GameState, t: float) -> None:
        """Choose: place first, then size. An active card is switched off first; the hand turns back before a press."""
        if seen.status != INACTIVE:
            self._stop(t)
            return
        good_px = 0.8 * self.task.tolerance_px
        self._target = seen.target
        x, y, size = seen.off_px
        self._goal = MOVE if max(abs(x), abs(y)) > good_px or abs(size) <= good_px else ZOOM
        away = max(abs(self._command[0]), abs(self._command[1]))
        self._command = [0.0, 0.0]
        self._until_s = t + (REST_LAGS * self.config.muscle_s if away > 1.0 else 0.0)
        self._phase = "return"

    def _stop(self, t: float) -> None:
        self._press(t, self.config.short_press_s)
        self._phase = "stop"

    def _press(self, t: float, seconds: float) -> None:
        self._pressed_since, self._press_s = t, seconds
        self._until_s = t + seconds + self.config.reaction_s + SEE_S

    # ------------------------------------------------------------------ how to steer

    def _off(self, seen: GameState) -> Pair:
        """Return the error to be corrected, with the eye's noise."""
        x, y, size = seen.off_px
        eye = self.config.eye_px
        if self._goal == ZOOM:
            return size + eye * self._normal(), 0.0
        return x + eye * self._normal(), y + eye * self._normal()

    def _normal(self) -> float:
        if not self._noise:
            self._noise = self._rng.standard_normal(256).tolist()
        return self._noise.pop()

    def _at_the_end(self, t: float) -> bool:
        """The wrist cannot turn further, and the view has had the time to come as far as that takes it."""
        c, task = self.config, self.task
        if task.mapping == "speed" or max(abs(self._command[0]), abs(self._command[1])) < c.reach_deg:
            self._end_since = None
            return False
        self._end_since = t if self._end_since is None else self._end_since
        return t - self._end_since >= c.reaction_s + 3.0 * c.muscle_s + 2.0 * task.response_s

    def _content(self, worst_px: float, t: float) -> bool:
        if worst_px > self.config.content * self.task.tolerance_px:
            self._good_since = None
            return False
        self._good_since = t if self._good_since is None else self._good_since
        return t - self._good_since >= self.config.dwell_s

    def _aim_at(self, error: Pair) -> Pair:
        """Return the predicted target of the hand."""
        c = self.config
        goals = [self._command[i] - error[i] / self.task.gain * (1.0 + c.aim_spread * self._normal()) for i in range(2)]
        x, y = (min(max(goal, -c.reach_deg), c.reach_deg) for goal in goals)
        return x, y

    def _aiming(self, error: Pair, t: float, dt: float) -> bool:
        """Make a step of the aimed movement, or wait for its result; False when it is finished."""
        c = self.config
        if self._aim is None:
            return False
        self._error = error
        if self._arrived is None:
            away = 0.0
            for i in range(2):
                gap, step = self._aim[i] - self._command[i], c.fastest_deg_s * dt
                self._command[i] += min(max(gap, -step), step)
                away = max(away, abs(self._aim[i] - self._command[i]))
            self._arrived = t if away == 0.0 else None
            return True
        if t - self._arrived >= c.reaction_s + 2.0 * c.muscle_s + self.task.response_s:
            self._aim = None
        return True

    def _steer(self, error: Pair, dt: float) -> None:
        c, task = self.config, self.task
        lead = min(task.response_s, c.longest_lead_s)
        for i in range(2):
            if dt > 0.0:
                self._slope[i] += dt / (SLOPE_S + dt) * ((error[i] - self._error[i]) / dt - self._slope[i])
            push = -(error[i] + lead * self._slope[i]) * c.crossover_rad_s / task.gain
            if task.mapping == "position":
                push = self._command[i] + dt * min(max(push, -c.fastest_deg_s), c.fastest_deg_s)
            self._command[i] = min(max(push, -c.reach_deg), c.reach_deg)
        self._error = error

    # ------------------------------------------------------------------ the hand

    def _move(self, t: float, dt: float) -> Hand:
        """Two equal lags towards the command (exact for a command held over ``dt``), tremor on top."""
        stiff = 1.0 / self.config.muscle_s
        shake = self.config.tremor_deg / math.sqrt(2.0)
        fade = math.exp(-stiff * dt)
        rows: list[tuple[float, float, float]] = []
        for i, (omega, phase) in enumerate(self._tremor):
            gap = self._position[i] - self._command[i]
            slope = self._velocity[i] + stiff * gap
            x, v = (gap + slope * dt) * fade, (slope - stiff * (gap + slope * dt)) * fade
            self._position[i], self._velocity[i] = self._command[i] + x, v
            sine, cosine = math.sin(omega * t + phase), math.cos(omega * t + phase)
            rows.append(
                (
                    self._position[i] + shake * sine,
                    v + shake * omega * cosine,
                    -stiff * stiff * x - 2.0 * stiff * v - shake * omega * omega * sine,
                )
            )
        psi, theta = rows
        pressed = self._pressed_since is not None
        return Hand((psi[0], theta[0]), (psi[1], theta[1]), (psi[2], theta[2]), pressed)
