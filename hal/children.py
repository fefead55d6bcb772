"""Start this program in child processes, which import our packages whatever the current folder is."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SUPERVISED = "MICRON_SUPERVISED"
"""Environment variable with the file handle on which a supervised command says that it ended by itself."""


def child_command(module: str, *arguments: str) -> list[str]:
    """Return the command line that runs our ``module`` as a program.

    ``-P`` keeps the current folder off the import path: a ``random.py`` that lies there is not ours to run.
    """
    return [sys.executable, "-P", "-m", module, *arguments]


def child_environment() -> dict[str, str]:
    """Return the environment for ``child_command``.

    Our packages come first on the import path if they do so in this process, or if it runs from a source tree."""
    environment = dict(os.environ)
    if str(ROOT) in sys.path[:1] or (ROOT / "pyproject.toml").exists():
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(ROOT), environment.get("PYTHONPATH"))))
    return environment


def use_one_thread() -> None:
    """Give one thread to every linear algebra call of this process and its children, unless the user chose otherwise.

    Call it before numpy is imported. Work is parallel in processes here. Beside a real-time loop, a second thread of
    ordinary priority makes every large call wait for a processor.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def begin_as_worker() -> None:
    """Leave Ctrl-C to the process that started this one, and end with it (Linux).

    A thread that serves a cluster changes nothing: its process belongs to the cluster.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # PR_SET_PDEATHSIG
