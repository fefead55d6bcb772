"""Analog inputs that stand still until a test sets them."""

from __future__ import annotations

import numpy as np

from sim_devices.faces import Volts


class HeldVoltages:
    """Truth face of ``n`` analog inputs, in V."""

    def __init__(self, n: int) -> None:
        self.volts_V = np.zeros(n)

    def set_V(self, channel: int, volts: float) -> None:
        self.volts_V[channel] = volts

    def __call__(self, t_ns: int) -> Volts:
        return self.volts_V
