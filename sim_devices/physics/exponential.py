"""The exponential of a small matrix, compiled: library routines wake threads that cost more than the sum."""

from __future__ import annotations

import numpy as np

from hal.compiled import kernel


@kernel
def exponential(m):
    """Return e^m of a square matrix (s, s) by scaling, an 18-term Taylor sum (norm below 1/2) and squaring.

    C. Moler, C. Van Loan, SIAM Review 45 (2003) 3, method 3.
    """
    s = m.shape[0]
    norm = 0.0
    for i in range(s):
        row = 0.0
        for j in range(s):
            row += abs(m[i, j])
        norm = max(norm, row)
    halvings = 0
    while norm > 0.5:
        norm *= 0.5
        halvings += 1
    a = m * 0.5**halvings
    out = np.eye(s)
    term = np.eye(s)
    work = np.empty((s, s))
    for k in range(1, 19):
        for i in range(s):
            for j in range(s):
                v = 0.0
                for l in range(s):  # noqa: E741
                    v += term[i, l] * a[l, j]
                work[i, j] = v / k
        for i in range(s):
            for j in range(s):
                term[i, j] = work[i, j]
                out[i, j] += work[i, j]
    for _ in range(halvings):
        for i in range(s):
            for j in range(s):
                v = 0.0
                for l in range(s):  # noqa: E741
                    v += out[i, l] * out[l, j]
                work[i, j] = v
        out = work.copy()
    return out
