"""Heartbeat of the firmware in shared memory: a few aligned 64-bit words, each with one writer."""

from __future__ import annotations

import mmap
import os
from enum import IntEnum
from typing import NamedTuple

from firmware_py.guardian.mark import MARK_BYTES, DeathMark

PHASE, BEAT, _NOTICED, TAKEN, _REACHED, _WHY, INSIDE, _WATCHED, _ASKED, _CONFIRMED = range(10)
"""Places in ``Heart.words``."""
SOMEBODY, REPEATS = 1 << 48, 1 << 49
"""Bits of the word ``INSIDE`` above the three codes: a command is going out; it repeats the one before it."""
_MARK = 128
_BYTES = _MARK + MARK_BYTES


class Phase(IntEnum):
    """The firmware's word about the outputs: at rest, being armed (only a death counts), moving with every beat, or
    not its own any more."""

    IDLE = 0
    ARMING = 1
    RUNNING = 2
    YIELDED = 3


class Why(IntEnum):
    """Why the guardian took the outputs."""

    NOTHING = 0
    DIED = 1
    SILENT = 2


class Order(NamedTuple):
    """A command that is going out: three 16-bit codes. ``repeats``: they are those of the command before it."""

    codes: tuple[int, int, int]
    repeats: bool


class Heart:
    """``phase``, ``beat``, ``inside`` and ``asked`` are the firmware's words, the others the guardian's. Times: bench
    clock, ns; 0: never.

    Without ``fd`` in private memory, for a guardian in the same process.
    """

    def __init__(self, fd: int | None = None) -> None:
        self.fd = fd
        memory = memoryview(bytearray(_BYTES) if fd is None else mmap.mmap(fd, _BYTES))
        self.words = memory[:_MARK].cast("q")
        """The words themselves, for a compiled loop, which is the firmware's side of them."""
        self.mark = DeathMark(memory[_MARK:])
        """Held by the firmware's loop: the kernel says here that it is dead."""

    @classmethod
    def shared(cls) -> Heart:
        """In memory that a child process can open by ``fd``."""
        fd = os.memfd_create("micron-heart")
        os.ftruncate(fd, _BYTES)
        return cls(fd)

    # -- the firmware's side

    def beat(self, t_ns: int) -> None:
        self.words[BEAT] = t_ns

    def say(self, phase: Phase) -> None:
        self.words[PHASE] = phase

    def enter(self, order: Order) -> None:
        """A command is about to go out."""
        a, b, c = order.codes
        self.words[INSIDE] = SOMEBODY | REPEATS * order.repeats | a << 32 | b << 16 | c

    def leave(self) -> None:
        """It has gone out, or will not."""
        self.words[INSIDE] = 0

    def ask_back(self, t_ns: int) -> None:
        """The outputs are wanted back once the guardian has done with them; no command is going out."""
        self.words[_ASKED] = t_ns

    def forget_guardian(self) -> None:
        """The guardian is gone: what it said is void. Its first ``notice`` is kept, for the run's report."""
        for word in (TAKEN, _REACHED, _CONFIRMED, _WHY, _WATCHED, _ASKED):
            self.words[word] = 0

    # -- the guardian's side

    def watch(self, t_ns: int) -> None:
        """The guardian is there."""
        self.words[_WATCHED] = t_ns

    def notice(self, t_ns: int) -> None:
        """The beat is late; the first time is kept."""
        if not self.words[_NOTICED]:
            self.words[_NOTICED] = t_ns

    def take(self, why: Why, t_ns: int) -> None:
        self.words[_WHY] = why
        self.words[TAKEN] = t_ns

    def reach(self, t_ns: int) -> None:
        """Neutral, read back."""
        self.words[_REACHED] = t_ns

    def confirm(self, t_ns: int) -> None:
        """A look at the outputs that began at ``t_ns`` found them at neutral."""
        self.words[_CONFIRMED] = t_ns

    def lose_neutral(self) -> None:
        """The outputs are not at neutral any more."""
        self.words[_REACHED] = self.words[_CONFIRMED] = 0

    def give_back(self) -> None:
        """The outputs are the firmware's again; ``taken`` is cleared last, because it is what the firmware looks at."""
        self.words[_WHY] = Why.NOTHING
        self.lose_neutral()
        self.words[TAKEN] = 0

    # -- for both

    @property
    def phase(self) -> Phase:
        return Phase(self.words[PHASE])

    @property
    def beat_ns(self) -> int:
        return self.words[BEAT]

    @property
    def inside(self) -> Order | None:
        """The command that is going out just now."""
        word = self.words[INSIDE]
        if not word:
            return None
        return Order((word >> 32 & 0xFFFF, word >> 16 & 0xFFFF, word & 0xFFFF), bool(word & REPEATS))

    @property
    def asked_ns(self) -> int:
        return self.words[_ASKED]

    @property
    def watched_ns(self) -> int:
        return int(self.words[_WATCHED])

    @property
    def noticed_ns(self) -> int:
        return self.words[_NOTICED]

    @property
    def taken_ns(self) -> int:
        return self.words[TAKEN]

    @property
    def reached_ns(self) -> int:
        return self.words[_REACHED]

    @property
    def confirmed_ns(self) -> int:
        """Return when the guardian's newest look that found neutral began."""
        return self.words[_CONFIRMED]

    @property
    def why(self) -> Why:
        return Why(self.words[_WHY])
