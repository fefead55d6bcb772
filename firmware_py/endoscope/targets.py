"""The targeting experiment (Erat 2018, section 6.3) as a pure state machine: no clock, no screen, no device.

Five random squares, one after the other, are to be covered by the field of view; the next one appears when centre and
side of the view are within the tolerance. Drive it with a pointer and a button, from a mouse, a web page or a hand::

    game = TargetGame(GameConfig(seed=1))
    state = game.step(pointer=(psi_deg, theta_deg), button=pressed, t=seconds)
    page.draw(state.as_dict())

or with what a motion card says (it turns its button into a status itself): ``game.step_card(pointer, status, t)``.
The same calls in the same order give the same states: ``t`` is whatever the caller counts in, only differences matter.
"""

from __future__ import annotations

import math
import random
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import Field, model_validator

from drivers.motion_card_protocol import ActivationButton, SpikeFilter
from firmware_py.endoscope.control import INACTIVE, ControlConfig, EndoscopeControl, View
from hal.validation import StrictTable

LONGEST_STEP_S = 0.1
"""Longest time step that is used: a page that was hidden must not move the view by what it missed."""


class GameConfig(StrictTable):
    """The experiment of section 6.3: K = 8, tau = 0.25 s, tolerance 9 pixels, five targets. Screen and sizes are ours.

    ``apart_px``: a target is at least so far from the last one (0 where nobody cares).
    """

    control: ControlConfig = ControlConfig()
    targets: int = Field(default=5, ge=1, le=1000)
    tolerance_px: float = Field(default=9.0, gt=0.0)
    seed: int = Field(default=1, ge=0)
    target_sizes_px: tuple[float, float] = (70.0, 180.0)
    apart_px: float = Field(default=80.0, ge=0.0)

    @model_validator(mode="after")
    def _possible(self) -> GameConfig:
        low, high = self.target_sizes_px
        c = self.control
        if not c.smallest_px <= low <= high <= c.largest_px:
            raise ValueError(f"target_sizes_px {low:g}, {high:g} must lie within {c.smallest_px:g}, {c.largest_px:g}")
        if high + self.apart_px > min(c.width_px, c.height_px):
            raise ValueError("the screen is too small for targets of target_sizes_px that are apart_px apart")
        return self


@dataclass(frozen=True, slots=True)
class TargetResult:
    """Records how one target was reached. Rotations are the extremes of psi and theta within activations, degrees."""

    elapsed_s: float
    clicks: int
    psi_deg: tuple[float, float]
    theta_deg: tuple[float, float]
    rotations_deg: tuple[tuple[float, float], ...]
    """Largest |psi| and |theta| of every activation since its start, degrees."""


@dataclass(frozen=True, slots=True)
class GameState:
    """Holds all that a screen needs. ``elapsed_s`` counts from the first activation; ``target`` is None when done."""

    view: View
    target: View | None
    status: int
    reached: int
    of: int
    clicks: int
    elapsed_s: float
    turn_deg: tuple[float, float]
    off_px: tuple[float, float, float]
    """View minus target: x, y, size; zero when done."""
    done: bool

    def as_dict(self) -> dict[str, Any]:
        """Return the state as JSON values."""
        return asdict(self)


class TargetGame:
    """Runs the experiment once. ``results`` has one entry per target reached."""

    def __init__(self, config: GameConfig | None = None) -> None:
        self.config = config or GameConfig()
        self.control = EndoscopeControl(self.config.control)
        self.results: list[TargetResult] = []
        self.clicks = 0
        self._random = random.Random(self.config.seed)
        self._button, self._spikes = ActivationButton(), SpikeFilter()
        self._was_pressed = False
        self._status = INACTIVE
        self._target: View | None = self._next_target(self.control.view)
        self._t: float | None = None
        self._used_t: float | None = None
        self._first_t: float | None = None
        self._elapsed_s = 0.0
        self._begin_target(0.0)

    @property
    def done(self) -> bool:
        return self._target is None

    @property
    def target(self) -> View | None:
        return self._target

    def step(self, pointer: tuple[float, float], button: bool, t: float) -> GameState:
        """``pointer``: psi, theta in degrees; ``button``: is it down; ``t``: seconds, never backwards.

        While the button is down and for 20 ms after its release the pointer is not used (section 6.2.3).
        ``ValueError`` for what is no number or runs backwards.
        """
        self._check(pointer, t)
        t_ns = round(t * 1e9)
        status = self._button.update(button, t_ns)
        self.clicks += button and not self._was_pressed
        self._was_pressed = button
        return self._go(pointer, status, t, use=self._spikes.admit(button, t_ns))

    def step_card(self, pointer: tuple[float, float], status: int, t: float, *, use: bool = True) -> GameState:
        """The same with the status of a motion card; ``use`` is false for samples that its spike filter held back."""
        self._check(pointer, t)
        self.clicks += status != self._status
        return self._go(pointer, status, t, use=use)

    def state(self) -> GameState:
        """Return the state after the last step."""
        view, target = self.control.view, self._target
        off = (0.0, 0.0, 0.0)
        if target is not None:
            off = (view.x - target.x, view.y - target.y, view.size - target.size)
        return GameState(
            view=view,
            target=target,
            status=self._status,
            reached=len(self.results),
            of=self.config.targets,
            clicks=self.clicks,
            elapsed_s=self._elapsed_s,
            turn_deg=self.control.turn_deg,
            off_px=off,
            done=target is None,
        )

    # ------------------------------------------------------------------ inside

    def _check(self, pointer: tuple[float, float], t: float) -> None:
        if not all(math.isfinite(v) for v in (*pointer, t)):
            raise ValueError(f"pointer {pointer} and time {t} must be finite numbers")
        if self._t is not None and t < self._t:
            raise ValueError(f"time ran backwards from {self._t:.3f} to {t:.3f} s")

    def _go(self, pointer: tuple[float, float], status: int, t: float, *, use: bool) -> GameState:
        self._t = t
        if self.done:
            return self.state()
        if status != self._status:
            self._status = status
            self._new_activation = status != INACTIVE
        if self._first_t is None and status != INACTIVE:
            self._first_t = self._used_t = t
        if self._first_t is not None:
            self._elapsed_s = t - self._first_t
        if use:
            dt_s = 0.0 if self._used_t is None else min(t - self._used_t, LONGEST_STEP_S)
            self._used_t = t
            self.control.step(pointer[0], pointer[1], status, dt_s)
            self._note_rotation()
            self._match()
        return self.state()

    def _note_rotation(self) -> None:
        if self._status == INACTIVE:
            return
        if self._new_activation:
            self._rotations.append((0.0, 0.0))
            self._new_activation = False
        psi, theta = self.control.turn_deg
        self._psi = (min(self._psi[0], psi), max(self._psi[1], psi))
        self._theta = (min(self._theta[0], theta), max(self._theta[1], theta))
        last = self._rotations[-1]
        self._rotations[-1] = (max(last[0], abs(psi)), max(last[1], abs(theta)))

    def _match(self) -> None:
        target, view, tolerance = self._target, self.control.view, self.config.tolerance_px
        if target is None or self._status == INACTIVE:
            return
        off = (view.x - target.x, view.y - target.y, view.size - target.size)
        if max(abs(v) for v in off) > tolerance:
            return
        self.results.append(
            TargetResult(
                self._elapsed_s - self._target_since_s,
                self.clicks - self._clicks_before,
                self._psi,
                self._theta,
                tuple(self._rotations),
            )
        )
        self._target = self._next_target(view) if len(self.results) < self.config.targets else None
        self._begin_target(self._elapsed_s)

    def _begin_target(self, since_s: float) -> None:
        self._target_since_s = since_s
        self._clicks_before = self.clicks
        self._psi = self._theta = (0.0, 0.0)
        self._rotations: list[tuple[float, float]] = []
        # an activation that goes on counts for the next target too
        self._new_activation = self._status != INACTIVE

    def _next_target(self, last: View) -> View:
        c = self.config
        while True:
            size = self._random.uniform(*c.target_sizes_px)
            x = self._random.uniform(0.5 * size, c.control.width_px - 0.5 * size)
            y = self._random.uniform(0.5 * size, c.control.height_px - 0.5 * size)
            if math.hypot(x - last.x, y - last.y) >= c.apart_px:
                return View(x, y, size)
