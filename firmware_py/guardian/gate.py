"""Grants the firmware's commands: a lease that every command renews, and a word for the command that is going out.

No command of the firmware goes out after the guardian has the outputs:

1. The firmware writes its command into the word ``IN_FLIGHT``, then checks ``TAKEN`` and the age of its lease, and only
   then sends; after the transfer it clears the word. An expired lease stays expired.
2. The guardian waits until the lease has certainly expired (same clock, plus a margin), sets ``TAKEN``, and reads
   ``IN_FLIGHT`` one step later at the earliest. If it is empty, every later command finds ``TAKEN`` set. If it is not,
   the firmware stands still within a command; see ``Guardian``.
3. Once the outputs have stayed at neutral for ``guardian.HOLD_NS`` and the firmware has asked for them (a request
   later than ``TAKEN``, no command in flight), the guardian clears ``TAKEN``. Only then does the firmware use its lease
   again; it reads the outputs back before it moves them.
"""

from __future__ import annotations

from array import array
from typing import Any

from firmware_py.guardian.heartbeat import BEAT, IN_FLIGHT, IS_SENDING, PHASE, REPEATS, TAKEN, Heartbeat, Phase
from hal.contracts import Clock
from hal.errors import LeaseLost

LEASE_MARGIN_MS = 1.0
"""Time that the guardian waits beyond the end of the firmware's lease."""
LOST, NO_GUARDIAN, LEASE_NS, LAST, TRANSFER_END_NS, WORDS = range(6)
"""Places in ``LeaseGate.words``. ``LAST``: the three codes of the last command, 16 bits each; -1 before the first.
``TRANSFER_END_NS``: when the last transfer of the firmware was over, 0 before the first."""
RUNNING = int(Phase.RUNNING)


def announce(heartbeat: Any, gate: Any, a: int, b: int, c: int) -> None:
    """Write into the heartbeat that a command with these codes is going out. Runs in the interpreter and compiled."""
    codes = a << 32 | b << 16 | c
    heartbeat[IN_FLIGHT] = IS_SENDING | (REPEATS if codes == gate[LAST] else 0) | codes
    gate[LAST] = codes


def silence_ns(heartbeat: Any, now_ns: int) -> int:
    """Return the time since the lease was renewed (ns), 0 while no lease is running."""
    return now_ns - heartbeat[BEAT] if heartbeat[PHASE] == RUNNING else 0


def has_lease(heartbeat: Any, gate: Any, silent_ns: int) -> bool:
    """Return True if the outputs are the firmware's. Call it after ``announce`` (step 1 of the module's text)."""
    return gate[LOST] == 0 and heartbeat[TAKEN] == 0 and silent_ns <= gate[LEASE_NS]


class LeaseGate:
    """Implements ``drivers.piezo.dac_output.OutputGate`` for the firmware. ``lease_ms`` is the length of a lease."""

    def __init__(self, heartbeat: Heartbeat, clock: Clock, name: str, lease_ms: float) -> None:
        self.words = array("q", bytes(8 * WORDS))
        """The whole state of the gate. A compiled loop reads and writes the same memory."""
        self.words[LEASE_NS], self.words[LAST] = round(lease_ms * 1e6), -1
        self.heartbeat = heartbeat
        self._clock = clock
        self._name = name

    @property
    def lost(self) -> bool:
        """True from the loss of the lease until the guardian has returned the outputs or is gone."""
        return bool(self.words[LOST])

    @lost.setter
    def lost(self, is_lost: bool) -> None:
        self.words[LOST] = is_lost

    def enter(self, codes: tuple[int, int, int]) -> None:
        """Announce a command with ``codes`` and renew the lease. Raises ``LeaseLost`` if the lease has expired or the
        guardian has the outputs: nothing may be sent then."""
        heartbeat = self.heartbeat
        announce(heartbeat.words, self.words, *codes)
        now_ns = self._clock.now_ns()
        if self.words[NO_GUARDIAN]:
            return
        silent_ns = silence_ns(heartbeat.words, now_ns)
        if not has_lease(heartbeat.words, self.words, silent_ns):
            heartbeat.end_command()
            self.lost = True
            heartbeat.set_phase(Phase.YIELDED)
            raise LeaseLost(
                f"the host stood still for {silent_ns * 1e-6:.0f} ms: this process has lost the outputs to the "
                "guardian, which takes them to neutral",
                device=self._name,
            )
        heartbeat.beat(now_ns)

    def leave(self) -> None:
        """Note that the transfer is over, also after an error."""
        self.words[TRANSFER_END_NS] = self._clock.now_ns()
        self.heartbeat.end_command()

    @property
    def transfer_end_ns(self) -> int:
        """Return when the firmware's last transfer was over (bench clock, ns), 0 before the first."""
        return self.words[TRANSFER_END_NS]

    def clear_loss(self) -> None:
        """Begin a new lease, because the guardian has returned the outputs."""
        self.lost = False

    def require_lease(self) -> None:
        """Make commands need a lease, because a guardian watches."""
        self.words[NO_GUARDIAN] = False

    def drop_lease(self) -> None:
        """Let commands pass without a lease, because no guardian is left that could command the outputs."""
        self.words[NO_GUARDIAN] = True
        self.lost = False
