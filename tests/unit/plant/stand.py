"""What the plant's tests stand on: perfect sensors and a fixture that holds the instrument still."""

import numpy as np

from sim_devices.config import EmulationConfig, SensorConfig

PERFECT = {
    "rc_spread": 0.0,
    "bias_spread_V": 0.0,
    "scale_spread": 0.0,
    "misalignment_deg": 0.0,
    "cross_quadratic_V_per_g2": 0.0,
    "cross_linear_V_per_g": 0.0,
    "scale_variation_per_g": 0.0,
    "cross_fold_V": 0.0,
    "cross_product_V_per_g2": 0.0,
    "spring_per_g2": 0.0,
    "bias_temperature_mg_per_K": 0.0,
    "scale_temperature_per_K": 0.0,
    "supply_spread": 0.0,
    "supply_wander_mV": 0.0,
    "divider_spread": 0.0,
    "temperature_offset_K": 0.0,
    "magnetometer_noise_uG": 0.0,
    "magnetometer_offset_V": 0.0,
    "magnetometer_scale_spread": 0.0,
    "magnetometer_misalignment_deg": 0.0,
    "hard_iron_mG": 0.0,
    "soft_iron": 0.0,
    "piezo_coupling_G_per_A": 0.0,
    "daq_noise_uV": 0.0,
    "daq_offset_uV": 0.0,
    "daq_gain_spread": 0.0,
}


class Still:
    """A fixture that holds the instrument at one attitude."""

    def __init__(self, frame=None):
        self.frame = np.eye(3) if frame is None else np.asarray(frame, dtype=float)

    def start(self, pose, parts):
        pose[:], parts[:] = 0.0, 0.0

    def fill(self, pose, parts):
        pose[:], parts[:] = 0.0, 0.0


def perfect(**change):
    return EmulationConfig(sensors=SensorConfig(**{**PERFECT, **change}))
