"""Shares the firmware's heartbeat, and the guardian's answers to it, as aligned 64-bit words with one writer each.

Times in the words are on the bench clock, in ns, which firmware and guardian read alike; 0 means never.
"""

from __future__ import annotations

import mmap
import os
from enum import IntEnum
from typing import NamedTuple

from firmware_py.guardian.mark import MARK_BYTES, DeathMark

PHASE, BEAT, _LATE_BEAT, TAKEN, _NEUTRAL, _REASON, IN_FLIGHT, _GUARDIAN_ALIVE, _REQUESTED, _CONFIRMED = range(10)
"""Places in ``Heartbeat.words``."""
IS_SENDING, REPEATS = 1 << 48, 1 << 49
"""Bits of the word ``IN_FLIGHT`` above the three codes: a command is going out; it repeats the previous one."""
_MARK = 128
_BYTES = _MARK + MARK_BYTES


class Phase(IntEnum):
    """Names what the firmware does with the outputs.

    ``IDLE``: they rest at neutral. ``ARMING``: they are being armed; only the firmware's death starts a takeover.
    ``RUNNING``: every command is a beat, and silence starts a takeover. ``YIELDED``: the firmware has lost its lease
    and sends nothing; the guardian takes the outputs at once.
    """

    IDLE = 0
    ARMING = 1
    RUNNING = 2
    YIELDED = 3


class TakeoverReason(IntEnum):
    """TakeoverReason the guardian took the outputs."""

    NOTHING = 0
    DIED = 1
    SILENT = 2


class Command(NamedTuple):
    """Holds a command that is going out: three 16-bit codes. ``repeats``: the previous command had the same codes."""

    codes: tuple[int, int, int]
    repeats: bool


class Heartbeat:
    """Holds the words. The firmware writes ``PHASE``, ``BEAT``, ``IN_FLIGHT`` and its request for the outputs; the
    guardian writes the others.

    ``fd`` is the file of the shared memory. Without it the memory is private, for a guardian in the same process.
    """

    def __init__(self, fd: int | None = None) -> None:
        self.fd = fd
        memory = memoryview(bytearray(_BYTES) if fd is None else mmap.mmap(fd, _BYTES))
        self.words = memory[:_MARK].cast("q")
        """The words themselves, for a compiled loop, which writes the firmware's words."""
        self.mark = DeathMark(memory[_MARK:])
        """Held by the firmware's loop. The kernel sets it when the loop's thread dies."""

    @classmethod
    def shared(cls) -> Heartbeat:
        """Return a heartbeat in memory that a child process can open by ``fd``."""
        fd = os.memfd_create("micron-heartbeat")
        os.ftruncate(fd, _BYTES)
        return cls(fd)

    # -- the firmware's side

    def beat(self, t_ns: int) -> None:
        """Renew the lease: a command goes out at ``t_ns``."""
        self.words[BEAT] = t_ns

    def set_phase(self, phase: Phase) -> None:
        self.words[PHASE] = phase

    def end_command(self) -> None:
        """Note that no command is going out: its transfer is over, or was not made."""
        self.words[IN_FLIGHT] = 0

    def request_outputs(self, t_ns: int) -> None:
        """Ask for the outputs, which the guardian returns once they have stayed at neutral."""
        self.words[_REQUESTED] = t_ns

    def clear_guardian(self) -> None:
        """Clear the words of a guardian that is gone. ``late_beat_ns`` is kept for the run's report."""
        for word in (TAKEN, _NEUTRAL, _CONFIRMED, _REASON, _GUARDIAN_ALIVE, _REQUESTED):
            self.words[word] = 0

    # -- the guardian's side

    def note_guardian_alive(self, t_ns: int) -> None:
        """Give a sign of life of the guardian; it does so in every step."""
        self.words[_GUARDIAN_ALIVE] = t_ns

    def note_late_beat(self, t_ns: int) -> None:
        """Note that the beat is late. The first time is kept."""
        if not self.words[_LATE_BEAT]:
            self.words[_LATE_BEAT] = t_ns

    def take_outputs(self, why: TakeoverReason, t_ns: int) -> None:
        self.words[_REASON] = why
        self.words[TAKEN] = t_ns

    def note_neutral(self, t_ns: int) -> None:
        """Note that the outputs were read back at neutral."""
        self.words[_NEUTRAL] = t_ns

    def confirm_neutral(self, t_ns: int) -> None:
        """Note that a read-back which began at ``t_ns`` found the outputs at neutral."""
        self.words[_CONFIRMED] = t_ns

    def clear_neutral(self) -> None:
        """Note that the outputs have left neutral."""
        self.words[_NEUTRAL] = self.words[_CONFIRMED] = 0

    def return_outputs(self) -> None:
        """Return the outputs to the firmware. ``TAKEN`` is cleared last, because the firmware waits for it."""
        self.words[_REASON] = TakeoverReason.NOTHING
        self.clear_neutral()
        self.words[TAKEN] = 0

    # -- for both

    @property
    def phase(self) -> Phase:
        return Phase(self.words[PHASE])

    @property
    def beat_ns(self) -> int:
        return self.words[BEAT]

    @property
    def command_in_flight(self) -> Command | None:
        """Return the command that is going out, or ``None``."""
        word = self.words[IN_FLIGHT]
        if not word:
            return None
        return Command((word >> 32 & 0xFFFF, word >> 16 & 0xFFFF, word & 0xFFFF), bool(word & REPEATS))

    @property
    def requested_ns(self) -> int:
        return self.words[_REQUESTED]

    @property
    def guardian_alive_ns(self) -> int:
        return int(self.words[_GUARDIAN_ALIVE])

    @property
    def late_beat_ns(self) -> int:
        return self.words[_LATE_BEAT]

    @property
    def taken_ns(self) -> int:
        return self.words[TAKEN]

    @property
    def neutral_ns(self) -> int:
        return self.words[_NEUTRAL]

    @property
    def confirmed_ns(self) -> int:
        """Return when the guardian's latest read-back that found neutral began."""
        return self.words[_CONFIRMED]

    @property
    def reason(self) -> TakeoverReason:
        return TakeoverReason(self.words[_REASON])
