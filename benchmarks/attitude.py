"""(d) Attitude filters with a gyroscope: per sample called one by one and in batch, against ahrs, imufusion and vqf."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.row import Row, cpu_us, side_by_side
from firmware_py.sensing.fusion import Fusion, FusionConfig
from hal.arrays import Array

RATE_HZ = 286.0
N = 20_000
SLOW_N = 1000
"""ahrs is a Python loop."""


def signals(n: int) -> tuple[Array, Array, Array]:
    """Rate rad/s, specific force m/s^2 and field uT (n, 3) of a body that sways, with sensor noise."""
    rng = np.random.default_rng(1)
    t = np.arange(n)[:, None] / RATE_HZ
    rate = 0.8 * np.sin(2 * np.pi * np.array([0.3, 0.5, 0.2]) * t) + 0.01 * rng.standard_normal((n, 3))
    force = np.array([0.0, 0.0, 9.81]) + 0.5 * np.sin(3.0 * t) + 0.1 * rng.standard_normal((n, 3))
    field = np.array([20.0, 0.0, -40.0]) + 0.5 * rng.standard_normal((n, 3))
    return rate, force, field


def rows() -> Iterator[Row]:
    import ahrs
    import imufusion
    import vqf

    rate, force, field = signals(N)
    short = tuple(x[:SLOW_N] for x in (rate, force, field))

    def ours(method: str, n: int) -> Callable[[], object]:
        return lambda: Fusion(FusionConfig(method=method), RATE_HZ).run(rate[:n], force[:n], field[:n])

    def python(name: str) -> Callable[[], object]:
        return lambda: getattr(ahrs.filters, name)(gyr=short[0], acc=short[1], mag=short[2], frequency=RATE_HZ)

    for method, name in (("madgwick", "Madgwick"), ("mahony", "Mahony")):
        ours(method, 10)()
        mine = cpu_us(ours(method, N), N)
        theirs = cpu_us(python(name), SLOW_N, 3)
        yield Row(
            f"attitude, {method}, batch", "per sample, magnetometer included", mine, theirs, "ahrs", "us",
            theirs / mine, ">= 20 x", theirs >= 20.0 * mine, must=True,
        )  # fmt: skip

    def compiled_vqf() -> object:
        return vqf.VQF(1.0 / RATE_HZ).updateBatch(rate, force, field)

    degrees = np.degrees(rate)
    in_g = force / 9.81

    def compiled_fusion() -> object:
        filter_ = imufusion.Ahrs()
        update = filter_.update
        for k in range(N):
            update(degrees[k], in_g[k], field[k])
        return filter_.get_quaternion()

    mine, theirs = side_by_side((ours("mahony", N), compiled_vqf), N)
    yield Row(
        "attitude, batch, compiled peer", "per sample: Mahony against VQF (C++), which does more per sample", mine,
        theirs, "vqf", "us", mine / theirs, "<= 1.5 x", mine <= 1.5 * theirs, must=True,
    )  # fmt: skip
    one = Fusion(FusionConfig(method="mahony"), RATE_HZ)

    def by_call() -> None:
        step = one.step
        for k in range(N):
            step(rate[k], force[k], field[k])

    by_call()
    mine, theirs = side_by_side((by_call, compiled_fusion), N, 5)
    yield Row(
        "attitude, called per sample", "from Python, one sample a call, magnetometer included", mine, theirs,
        "imufusion", "us", mine / theirs, "<= 1.5 x", mine <= 1.5 * theirs, must=True,
    )  # fmt: skip
