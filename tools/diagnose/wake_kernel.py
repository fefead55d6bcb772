"""A loop in compiled code without the GIL that only wakes up: the same calls as ``c_reference.SOURCE`` makes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.compiled import thread_kernel
from hal.fd_kernels import now_ns, sleep_until_ns


@thread_kernel
def wake(late_ns: NDArray[np.int64], period_ns: int, due_ns: int) -> None:
    """Wake up ``len(late_ns)`` times, ``period_ns`` apart, first at ``due_ns``, and note how late, ns. After a stall
    the next time that is yet to come is due."""
    for k in range(len(late_ns)):
        sleep_until_ns(due_ns)
        now = now_ns()
        late_ns[k] = now - due_ns
        due_ns += period_ns
        if now > due_ns:
            due_ns += (now - due_ns) // period_ns * period_ns + period_ns
