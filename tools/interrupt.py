"""Ctrl-C, the same in every command: stop, print and write what was measured, end with status 130; a second one ends
the program at once.

The ``micron`` script installs the handler. A loop whose results are worth something before it is done stands in
``keep_what_is_there``; ``tools.cli.common.clear_errors`` says what happened and sets the exit status.
"""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType

_STOPPED: ContextVar[bool] = ContextVar("stopped", default=False)


def install_handler() -> None:
    """Let the first SIGINT end the worker processes and raise KeyboardInterrupt, and the second one kill.

    Outside the main thread nothing can be installed, and nothing is.
    """
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, _interrupt)


def was_interrupted() -> bool:
    """Return whether the handler has had its first SIGINT."""
    return signal.getsignal(signal.SIGINT) is signal.SIG_DFL


def _interrupt(number: int, frame: FrameType | None) -> None:
    # the next one is the kernel's: it ends the program also where Python is deep in compiled code
    signal.signal(number, signal.SIG_DFL)
    for worker in multiprocessing.active_children():  # of every kind of pool; nobody waits for what they still compute
        worker.kill()
    raise KeyboardInterrupt


@contextmanager
def keep_what_is_there() -> Iterator[None]:
    """End the block on Ctrl-C and go on behind it, where what was measured until then is printed and written."""
    try:
        yield
    except KeyboardInterrupt:
        note_stop()


@contextmanager
def begin_command() -> Iterator[None]:
    """Remember Ctrl-C until the block ends: of two commands in one process it stops the one that runs."""
    before = _STOPPED.set(False)
    try:
        yield
    finally:
        _STOPPED.reset(before)


def note_stop() -> None:
    """Remember that Ctrl-C ended the work of this command early."""
    _STOPPED.set(True)


def is_stopped() -> bool:
    """Return whether Ctrl-C ended the work of this command early."""
    return _STOPPED.get()


def need_some(found: object) -> None:
    """Raise KeyboardInterrupt when Ctrl-C came before there was anything to print."""
    if is_stopped() and not found:
        raise KeyboardInterrupt
