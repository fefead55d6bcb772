"""A tone of the design's frequency is found exactly, now and ahead; where samples are missing the phasor turns on."""

import numpy as np
import pytest

from firmware_py.tremor.config import TremorConfig
from firmware_py.tremor.estimator import Estimator
from hal.errors import BenchError

T_S = np.arange(4000) / 1000.0
W = 2 * np.pi * 9.0


def config(**own: float) -> TremorConfig:
    return TremorConfig(method="phasor", loop_delay_s=0.003, own={"frequency_hz": 9.0, **own})


def samples(size_m: float, cutoff_rad_s: float) -> np.ndarray:
    """Acceleration of a tip at size_m cos(W t) behind an RC filter, in closed form."""
    return np.real(-(W**2) * size_m / (1.0 + 1j * W / cutoff_rad_s) * np.exp(1j * W * T_S))[:, None]


def test_a_tone_is_found_now_and_ahead():
    found = Estimator(config(), axes=1).run(samples(20e-6, config().filter_cutoff_rad_s))
    settled = slice(3000, None)
    assert found.now_m[settled, 0] == pytest.approx(20e-6 * np.cos(W * T_S[settled]), abs=1e-10)
    assert found.ahead_m[settled, 0] == pytest.approx(20e-6 * np.cos(W * (T_S[settled] + 0.003)), abs=1e-10)


def test_it_turns_on_over_a_hole():
    seen = samples(20e-6, config().filter_cutoff_rad_s)
    seen[3500:3600] = np.nan
    found = Estimator(config(), axes=1).run(seen)
    assert found.now_m[3599, 0] == pytest.approx(20e-6 * np.cos(W * T_S[3599]), abs=1e-10)


def test_a_name_that_nobody_offers_is_refused():
    with pytest.raises(BenchError, match=r"'fazor' is no estimator; there are: .*phasor"):
        TremorConfig.from_dict({"method": "fazor"})
