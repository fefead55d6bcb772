"""Keeps the kernel's threads of ttys raised for a run, and lowers them when the run is over, however it ended.

``python -m firmware_py.machine.attendant PRIORITY`` is a process of its own: the kernel closes the pipe from the run
also when the run is killed, and starts new threads while it lasts.
"""

from __future__ import annotations

import ctypes
import errno
import select
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress

from firmware_py.machine.tree import MACHINE, Tree
from firmware_py.machine.workers import NAME, has_attendant, lower_workers, raise_workers
from hal.children import child_command, child_environment

LOOK_S = 1.0
"""Time between two looks for threads that the kernel has started since."""
END_S = 2.0
_PR_SET_NAME = 15  # linux/prctl.h


def attend_workers(priority: int) -> Callable[[], None]:
    """Start the attendant, and return what ends it. Raises ``OSError`` if it may not raise the threads."""
    process = subprocess.Popen(
        child_command("firmware_py.machine.attendant", str(priority)),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=child_environment(),
        start_new_session=True,  # Ctrl-C is for the firmware
    )
    assert process.stdin is not None
    assert process.stdout is not None
    pipe, answer = process.stdin, process.stdout.readline().decode().strip()
    process.stdout.close()
    if answer != "ready":
        pipe.close()
        process.wait()
        raise PermissionError(errno.EPERM, answer or "its process ended without a word")

    def end() -> None:
        pipe.close()
        with suppress(subprocess.TimeoutExpired):
            process.wait(END_S)

    return end


def attend(tree: Tree, priority: int, pipe: int) -> None:
    """Raise the threads that the kernel starts, until ``pipe`` is closed at its other end, and lower them all then
    unless another run is under way."""
    while not select.select([pipe], (), (), LOOK_S)[0]:
        raise_workers(tree, priority)
    if not has_attendant(tree, besides_us=True):
        lower_workers(tree, priority)


def main(arguments: list[str]) -> int:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with the firmware
    ctypes.CDLL(None).prctl(_PR_SET_NAME, NAME.encode(), 0, 0, 0)
    priority = int(arguments[0])
    try:
        raise_workers(MACHINE, priority)
    except PermissionError as error:
        sys.stdout.write(f"{error.strerror}\n")
        return 1
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    attend(MACHINE, priority, sys.stdin.fileno())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
