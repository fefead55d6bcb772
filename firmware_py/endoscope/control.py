"""Maps the motion card's angles to the camera's field of view: Erat 2018 (Erat 2018), section 6.2.

The field of view is a square on the screen: centre (x, y) and side ``size``, pixels, y downwards. Angles are the card's
roll psi and pitch theta in degrees. Status 0: nothing moves; 1: psi and theta move x and y; 2: psi changes the size.
Each activation takes the angles of its first sample as zero (psi[0], theta[0]) and the field of view of that moment
as the place to start from, and the response filter starts there (errata no. 120).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from hal.validation import StrictTable

INACTIVE, MOVE, ZOOM = 0, 1, 2
Mapping = Literal["position", "speed"]


class ControlConfig(StrictTable):
    """``gain``: pixels per degree (mapping "position") or pixels per second and degree ("speed"), K of (6.5)-(6.10)."""

    mapping: Mapping = "position"
    gain: float = Field(default=8.0, gt=0.0, le=1000.0)
    response_s: float = Field(default=0.25, ge=0.0, le=60.0)
    """Time constant tau of the first-order response filter (6.1); 0 switches it off."""
    width_px: float = Field(default=640.0, ge=100.0)
    height_px: float = Field(default=480.0, ge=100.0)
    smallest_px: float = Field(default=40.0, ge=1.0)
    largest_px: float = Field(default=240.0, ge=2.0)
    start_size_px: float = Field(default=120.0, ge=1.0)


@dataclass(frozen=True, slots=True)
class View:
    """A square on the screen, pixels."""

    x: float
    y: float
    size: float


def filter_weight(response_s: float, dt_s: float) -> float:
    """a of (6.4): 0 without a filter."""
    return response_s / (response_s + dt_s) if response_s > 0.0 else 0.0


class EndoscopeControl:
    """Maps one card to one field of view. ``activations`` counts changes away from 0 or between 1 and 2."""

    def __init__(self, config: ControlConfig | None = None) -> None:
        self.config = config or ControlConfig()
        c = self.config
        self.view = View(0.5 * c.width_px, 0.5 * c.height_px, c.start_size_px)
        self.activations = 0
        self.turn_deg = (0.0, 0.0)
        """psi and theta since the start of this activation; 0 while inactive."""
        self._status = INACTIVE
        self._zero = (0.0, 0.0)
        self._delayed = (0.0, 0.0)
        self._moved = (0.0, 0.0)
        self._from = self.view
        self._resumes = False

    @property
    def status(self) -> int:
        return self._status

    def step(self, psi_deg: float, theta_deg: float, status: int, dt_s: float) -> View:
        """Process one sample that the spike filter let through, ``dt_s`` after the last one, and return the view.
        Raises ``ValueError`` for bad input."""
        if status not in (INACTIVE, MOVE, ZOOM):
            raise ValueError(f"card status {status} is not 0, 1 or 2")
        if not (math.isfinite(psi_deg) and math.isfinite(theta_deg) and dt_s >= 0.0):
            raise ValueError(f"angles {psi_deg}, {theta_deg} deg and step {dt_s} s must be numbers, dt >= 0")
        if status != self._status:
            self._begin(psi_deg, theta_deg, status)
        elif self._resumes:
            self._start_from(psi_deg, theta_deg)
        if status == INACTIVE:
            return self.view
        c = self.config
        self.turn_deg = (psi_deg - self._zero[0], theta_deg - self._zero[1])
        a = filter_weight(c.response_s, dt_s)
        x, y = (a * old + (1.0 - a) * new for old, new in zip(self._delayed, (psi_deg, theta_deg), strict=True))
        self._delayed = (x, y)
        dx, dy = (x - self._zero[0]) * c.gain, (y - self._zero[1]) * c.gain  # (6.5)-(6.10)
        if c.mapping == "speed":  # (6.11)-(6.13)
            dx, dy = self._moved[0] + dt_s * dx, self._moved[1] + dt_s * dy
        self.view, self._moved = self._place(dx, dy)
        return self.view

    def resume(self) -> None:
        """Let the view go on from where a hold has kept it: the angles of the next sample count as zero."""
        self._resumes = True

    def _begin(self, psi_deg: float, theta_deg: float, status: int) -> None:
        self._status = status
        self._start_from(psi_deg, theta_deg)
        self.activations += status != INACTIVE

    def _start_from(self, psi_deg: float, theta_deg: float) -> None:
        self._resumes = False
        self._zero = self._delayed = (psi_deg, theta_deg)
        self._moved = (0.0, 0.0)
        self.turn_deg = (0.0, 0.0)
        self._from = self.view

    def _place(self, dx: float, dy: float) -> tuple[View, tuple[float, float]]:
        """Return the view after a displacement, kept inside the screen, and the part of the displacement that took
        effect."""
        c, start = self.config, self._from
        if self._status == ZOOM:
            size = min(max(start.size + dx, c.smallest_px), c.largest_px)
            return View(start.x, start.y, size), (size - start.size, 0.0)
        x = min(max(start.x + dx, 0.0), c.width_px)
        y = min(max(start.y + dy, 0.0), c.height_px)
        return View(x, y, start.size), (x - start.x, y - start.y)
