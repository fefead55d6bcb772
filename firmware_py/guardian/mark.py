"""Detects the death of a thread by a mark in shared memory that the kernel sets, whatever the cause of death.

The mark is a robust mutex (POSIX.1-2008, ``pthread_mutexattr_setrobust``) that its owner locks and never unlocks while
it lives. On the owner's death the kernel sets one bit of the mutex (Linux, ``Documentation/locking/``
``robust-futexes.rst``) before it takes down the address space and before it closes files: within a millisecond, where a
pipe closes only after hundreds of megabytes of memory have been given back.
"""

from __future__ import annotations

import ctypes
from typing import Any

MARK_BYTES = 64
"""Room for a ``pthread_mutex_t`` and its attribute each (40 and 4 bytes on 64-bit Linux)."""
OWNER_DIED = 0x4000_0000
"""FUTEX_OWNER_DIED of linux/futex.h."""
_PROCESS_SHARED = _ROBUST = 1


class DeathMark:
    """Wraps the mark at the beginning of ``memory``, which is shared, writable and zero at first.

    One side calls ``hold`` from the thread whose death matters; the other looks at ``owner_died``.
    """

    def __init__(self, memory: memoryview) -> None:
        self._word = memory[:4].cast("i")
        self._mutex = (ctypes.c_char * MARK_BYTES).from_buffer(memory)

    @property
    def owner_died(self) -> bool:
        """True if the thread that held the mark is dead: it sends no command and is inside no system call."""
        return bool(self._word[0] & OWNER_DIED)

    def hold(self) -> bool:
        """Bind the mark to the calling thread. Return False if the system has no robust mutexes."""
        library: Any = ctypes.CDLL(None)
        attribute = ctypes.create_string_buffer(MARK_BYTES)
        try:
            return not (
                library.pthread_mutexattr_init(attribute)
                or library.pthread_mutexattr_setpshared(attribute, _PROCESS_SHARED)
                or library.pthread_mutexattr_setrobust(attribute, _ROBUST)
                or library.pthread_mutex_init(self._mutex, attribute)
                or library.pthread_mutex_trylock(self._mutex)
            )
        except AttributeError:  # macOS
            return False

    def release(self) -> None:
        """Unbind the mark, so that the end of the thread is no death. The thread that holds the mark must call this."""
        library: Any = ctypes.CDLL(None)
        library.pthread_mutex_unlock(self._mutex)
