"""The engineer's twin of the motor as a Python object: no friction, no play, no delay."""

from collections.abc import Mapping

import numpy as np
from scipy.signal import lfilter


class Motor:
    """Speed follows the command with one time constant; the angle is its integral."""

    def simulate(self, inputs: Mapping[str, np.ndarray], parameters: Mapping[str, float]) -> dict[str, np.ndarray]:
        t, volts = inputs["t"], inputs["command"]
        h = t[1] - t[0]
        gain, tau = parameters["speed_per_V"], parameters["time_constant_s"]
        decay = np.exp(-h / tau)
        # exact for a command that runs linearly between samples
        ramp = 1.0 - tau / h * (1.0 - decay)
        held = (1.0 - decay) - ramp
        speed = lfilter([gain * ramp, gain * held], [1.0, -decay], volts, zi=[0.0 - gain * ramp * volts[0]])[0]
        # angle: integral of tau*speed' = gain*u - speed over each step
        area = np.concatenate([[0.0], np.cumsum(0.5 * h * (volts[1:] + volts[:-1]))])
        return {"angle": gain * area - tau * (speed - speed[0])}
