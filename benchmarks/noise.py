"""(e) Overlapping Allan deviation at octaves: 1.8 M samples against allantools, and growth with length."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks.row import Row, cpu_us, exponent, side_by_side
from tools.noise.allan import allan_curve, octave_factors

N = 1_800_000
LENGTHS = (120_000, 480_000, N)
RATE_HZ = 1000.0


def rows() -> Iterator[Row]:
    import allantools

    signal = np.random.default_rng(1).standard_normal(N)
    taus = octave_factors(N) / RATE_HZ

    def ours() -> object:
        return allan_curve(signal, RATE_HZ)

    def peer() -> object:
        return allantools.oadev(signal, rate=RATE_HZ, data_type="freq", taus=taus)

    mine = allan_curve(signal, RATE_HZ)
    theirs = allantools.oadev(signal, rate=RATE_HZ, data_type="freq", taus=taus)[1]
    np.testing.assert_allclose(mine.deviation, theirs, rtol=1e-7)
    a, b = side_by_side((ours, peer), repeats=3)
    yield Row(
        "Allan deviation, 1.8 M samples", "octaves; ours with intervals; same figures to 1e-7", a * 1e-6, b * 1e-6,
        "allantools", "s", b / a, ">= 1 x", a <= b, must=True,
    )  # fmt: skip
    costs = [cpu_us(lambda n=n: allan_curve(signal[:n], RATE_HZ), repeats=3) for n in LENGTHS]
    grows = exponent(LENGTHS, costs)
    yield Row("Allan deviation, growth", "exponent of CPU, 0.12 to 1.8 M samples", grows, 1.0, "linear", "1", grows)
