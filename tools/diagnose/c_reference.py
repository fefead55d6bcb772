"""The loop that only wakes up, in C, compiled at run time: what this machine does to the best loop there is."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SOURCE = r"""
#define _GNU_SOURCE
#include <errno.h>
#include <stdint.h>
#include <time.h>

void wake(int64_t *late_ns, int64_t n, int64_t period_ns, int64_t due_ns)
{
    for (int64_t k = 0; k < n; k++) {
        struct timespec t = {due_ns / 1000000000, due_ns % 1000000000};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, 0) == EINTR) {}
        clock_gettime(CLOCK_MONOTONIC, &t);
        int64_t now_ns = t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
        late_ns[k] = now_ns - due_ns;
        due_ns += period_ns;
        if (now_ns > due_ns)
            due_ns += (now_ns - due_ns) / period_ns * period_ns + period_ns;
    }
}
"""
COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-O2", "-fPIC", "-shared", "-std=gnu11")
LIMIT_S = 60.0


@dataclass(frozen=True)
class CReference:
    """Holds the compiled loop and the first line of the compiler's ``--version``."""

    compiler: str
    library: ctypes.CDLL

    def wake(self, late_ns: NDArray[np.int64], period_ns: int, due_ns: int) -> None:
        """Wake up n times as ``wake_kernel.wake`` does and fill ``late_ns`` (n,). The GIL is not held."""
        call = self.library.wake
        call.argtypes = [ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64]
        call.restype = None
        call(late_ns.ctypes.data, len(late_ns), period_ns, due_ns)


def compile_reference() -> CReference | str:
    """Compile the loop with the first C compiler on the path. Return it, or why there is none."""
    compiler = next((path for name in COMPILERS if (path := shutil.which(name))), None)
    if compiler is None:
        return f"no C compiler ({', '.join(COMPILERS)}) on the path"
    with tempfile.TemporaryDirectory(prefix="micron-") as folder:
        source, library = Path(folder) / "wake.c", Path(folder) / "wake.so"
        source.write_text(SOURCE, encoding="ascii")
        try:
            version = subprocess.run([compiler, "--version"], capture_output=True, text=True, timeout=LIMIT_S)
            command = [compiler, *FLAGS, str(source), "-o", str(library)]
            subprocess.run(command, check=True, capture_output=True, text=True, timeout=LIMIT_S)
            loaded = ctypes.CDLL(str(library))  # stays loaded without its file
        except subprocess.CalledProcessError as error:
            message = (error.stderr.strip().splitlines() or ["it said nothing"])[0]
            return f"{compiler} cannot compile it: {message}"
        except (OSError, subprocess.SubprocessError) as error:
            return f"{compiler} cannot be used: {error}"
    return CReference((version.stdout.splitlines() or [compiler])[0], loaded)
