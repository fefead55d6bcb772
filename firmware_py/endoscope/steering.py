"""Turns samples of the steering sensor into the view. The live loop and replay call the same step on the same frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from firmware_py.endoscope.config import EndoscopeConfig
from firmware_py.endoscope.control import INACTIVE
from firmware_py.endoscope.frame import ACCEL, CARD_STATUS, FUSED, GYRO, HELD, OUTPUTS, QUATERNION, TIME
from firmware_py.endoscope.targets import GameState, TargetGame
from firmware_py.sensing.fusion import Fusion, angles_deg


class Steering:
    """Holds the attitude filter, the experiment and the view of one run. ``status`` is the card's after the last
    step."""

    def __init__(self, config: EndoscopeConfig, rate_hz: float) -> None:
        self.fusion = Fusion(config.fusion, rate_hz)
        self.game = TargetGame(config.game)
        self.status = INACTIVE
        self._fused_ns = -1
        self._was_held = False

    def step(self, frame: NDArray[np.float64]) -> GameState:
        """Process one sample: the frame's inputs are set, its outputs are filled. Return the state of the view.

        Times are whole nanoseconds, which float64 seconds hold exactly, so that a replay computes the same steps.
        """
        t_s, fused = float(frame[TIME]), bool(frame[FUSED])
        t_ns = round(t_s * 1e9)
        status, is_held = int(frame[CARD_STATUS]), bool(frame[HELD])
        if fused:
            dt_s = None if self._fused_ns < 0 else (t_ns - self._fused_ns) * 1e-9
            self._fused_ns = t_ns
            self.fusion.step(frame[GYRO : GYRO + 3], frame[ACCEL : ACCEL + 3], dt_s=dt_s)
        if status != INACTIVE and self.status == INACTIVE:
            # the start attitude is that of the activation, its heading zero (section 6.2); the click shook the sensor,
            # so the averaging begins with the next sample that the spike filter lets through
            self.fusion.restart()
            fused = False
        self.status = status
        if self._was_held and not is_held:  # samples may have been missing: the attitude starts again, as the view does
            self.fusion.restart()
            self.game.control.resume()
            fused = False
        self._was_held = is_held
        psi, theta, _ = angles_deg(self.fusion.quaternion)
        use = fused and self.fusion.aligned and not is_held
        state = self.game.step_card((psi, theta), status, max(t_s, 0.0), use=use)
        view = state.view
        frame[OUTPUTS:QUATERNION] = state.status, use
        frame[QUATERNION : QUATERNION + 4] = self.fusion.quaternion
        frame[QUATERNION + 4 :] = psi, theta, view.x, view.y, view.size, state.reached
        return state
