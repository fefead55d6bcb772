"""Work arrays on the stack: they hold what is written, stay apart, and cost no allocation."""

from __future__ import annotations

import numba
import numpy as np

from hal.scratch import scratch, scratch_index, scratch_matrix
from tests.unit.allocations import allocations

SIZE = 13


def work(n: int) -> float:
    total = 0.0
    for k in range(n):
        a, b, m, index = scratch(SIZE), scratch(SIZE), scratch_matrix(3, 4), scratch_index(2)
        index[0], index[1] = 2, 3
        for i in range(SIZE):
            a[i] = i + k
            b[i] = -2.0 * a[i]
        for i in range(3):
            for j in range(4):
                m[i, j] = 10.0 * i + j
        total += a[SIZE - 1] + b[0] + m[index[0], index[1]] + m[1].sum() + m.shape[1]
    return total


compiled = numba.njit(work)


def test_the_kernel_says_what_the_interpreter_says() -> None:
    assert compiled(5) == work(5)


def test_nothing_is_allocated() -> None:
    compiled(1)
    before = allocations()
    compiled(1000)
    assert allocations() == before
    # and the count does see an allocation
    made = numba.njit(lambda n: np.empty(n).sum())
    made(3)
    assert allocations() > before
