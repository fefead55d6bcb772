"""A stage that expands with its heater: a first-order lag behind the heater's power, which is held between samples."""

import numpy as np
from scipy.signal import lfilter


class HeatedStage:
    def simulate(self, inputs, parameters):
        t, power = inputs["t"], inputs["power"]
        decay = np.exp(-(t[1] - t[0]) / parameters["time_constant_s"])
        warm = lfilter([0.0, 1.0 - decay], [1.0, -decay], power)
        return {"position": parameters["um_per_W"] * warm}
