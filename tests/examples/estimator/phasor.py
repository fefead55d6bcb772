"""A tremor estimator: one phasor that turns at a fixed frequency and follows the samples.

Source: G. Peceli, A common structure for recursive discrete transforms, IEEE Trans. Circuits Syst. 33 (1986), for one
channel.
"""

from cmath import exp, pi

import numba

from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.own import OwnEstimator


def design(config: TremorConfig) -> list[float]:
    """Turn of a tick, gain, factors from the sample's phasor to displacement now and ``loop_delay_s`` later."""
    w = 2.0 * pi * config.own.get("frequency_hz", 10.0)
    turn = exp(1j * w / config.tick_hz)
    gain = 1.0 / (config.own.get("memory_s", 0.1) * config.tick_hz)
    now = 1.0 + 1j * w / config.filter_cutoff_rad_s  # undoes the sensor's RC filter
    if config.sees == "acceleration":
        now /= -(w**2)
    ahead = now * exp(1j * w * config.loop_delay_s)
    return [turn.real, turn.imag, gain, now.real, now.imag, ahead.real, ahead.imag]


@numba.njit
def step(memory, numbers, sample, have, out):
    z = complex(memory[0], memory[1]) * complex(numbers[0], numbers[1])
    if have:
        z += numbers[2] * (sample - z.real)
    memory[0], memory[1] = z.real, z.imag
    out[0] = z.real * numbers[3] - z.imag * numbers[4]
    out[1] = z.real * numbers[5] - z.imag * numbers[6]


PHASOR = OwnEstimator(design, step)
