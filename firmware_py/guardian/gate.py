"""Who may command the amplifier: a lease that every command renews, and a word that says that a command is going out.

No command of the firmware goes out after the guardian has the outputs:

1. The firmware puts its command into ``heart.inside``, then looks at ``heart.taken_ns`` and at the age of its lease,
   and only then sends; after the transfer it clears the word. A lease that is over stays over.
2. The guardian waits until the lease has certainly expired (same clock, plus a margin), sets ``taken_ns``, and then
   looks at ``inside``, a step later at the earliest. Empty: whatever comes now finds ``taken_ns`` set. Not empty: the
   firmware stands still within a command; see ``Guardian``.
3. Once the guardian has reached neutral and has watched over it for a while, and the firmware asks (``heart.asked``
   later than ``taken_ns``, no command inside), it clears ``taken_ns``. Only then does the firmware take its lease up
   again; it reads back where the outputs are before it moves them.
"""

from __future__ import annotations

from array import array
from typing import Any

from firmware_py.guardian.heart import BEAT, INSIDE, PHASE, REPEATS, SOMEBODY, TAKEN, Heart, Phase
from hal.contracts import Clock
from hal.errors import LeaseLost

LEASE_MARGIN_MS = 1.0
"""The guardian waits so much longer than the firmware's lease lasts."""
LOST, IS_ALONE, LEASE_NS, LAST, LEFT_NS, WORDS = range(6)
"""Places in ``LeaseGate.words``. ``LAST``: the three codes of the last command, 16 bits each; -1 before the first.
``LEFT_NS``: when the last transfer of the firmware was over, 0 before the first."""
RUNNING = int(Phase.RUNNING)


def announce(heart: Any, gate: Any, a: int, b: int, c: int) -> None:
    """Say in the heart that a command with these codes is going out. Runs in the interpreter and compiled."""
    codes = a << 32 | b << 16 | c
    heart[INSIDE] = SOMEBODY | (REPEATS if codes == gate[LAST] else 0) | codes
    gate[LAST] = codes


def silence_ns(heart: Any, now_ns: int) -> int:
    """Return for how long the lease has not been renewed, 0 while none is running."""
    return now_ns - heart[BEAT] if heart[PHASE] == RUNNING else 0


def has_lease(heart: Any, gate: Any, silent_ns: int) -> bool:
    """Return True if the outputs are the firmware's. Call it after ``announce`` (step 1 of the module's text)."""
    return gate[LOST] == 0 and heart[TAKEN] == 0 and silent_ns <= gate[LEASE_NS]


class LeaseGate:
    """``drivers.piezo.dac_output.OutputGate`` of the firmware."""

    def __init__(self, heart: Heart, clock: Clock, name: str, lease_ms: float) -> None:
        self.words = array("q", bytes(8 * WORDS))
        """This memory is all that the gate knows; a compiled loop works on it, too."""
        self.words[LEASE_NS], self.words[LAST] = round(lease_ms * 1e6), -1
        self.heart = heart
        self._clock = clock
        self._name = name

    @property
    def lost(self) -> bool:
        """True while the lease is over or the guardian has the outputs: until it has given them back or is gone."""
        return bool(self.words[LOST])

    @lost.setter
    def lost(self, is_lost: bool) -> None:
        self.words[LOST] = is_lost

    def enter(self, codes: tuple[int, int, int]) -> None:
        """Raises ``LeaseLost`` when the outputs are not the firmware's any more: then nothing may be sent."""
        heart = self.heart
        announce(heart.words, self.words, *codes)
        now_ns = self._clock.now_ns()
        if self.words[IS_ALONE]:
            return
        silent_ns = silence_ns(heart.words, now_ns)
        if not has_lease(heart.words, self.words, silent_ns):
            heart.leave()
            self.lost = True
            heart.say(Phase.YIELDED)
            raise LeaseLost(
                f"the host stood still for {silent_ns * 1e-6:.0f} ms: this process has lost the outputs to the "
                "guardian, which takes them to neutral",
                device=self._name,
            )
        heart.beat(now_ns)

    def leave(self) -> None:
        """The transfer is over, well or not."""
        self.words[LEFT_NS] = self._clock.now_ns()
        self.heart.leave()

    @property
    def left_ns(self) -> int:
        """Return when the last transfer of the firmware was over."""
        return self.words[LEFT_NS]

    @property
    def alone(self) -> bool:
        """There is no guardian any more."""
        return bool(self.words[IS_ALONE])

    def take_up(self) -> None:
        """The guardian has given the outputs back: the lease begins anew."""
        self.lost = False

    def join(self) -> None:
        """A new guardian watches: leases count again."""
        self.words[IS_ALONE] = False

    def regain(self) -> None:
        """There is no guardian any more: nobody else commands."""
        self.words[IS_ALONE] = True
        self.lost = False
