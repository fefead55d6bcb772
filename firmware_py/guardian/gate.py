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

from firmware_py.guardian.heart import Heart, Order, Phase
from hal.contracts import Clock
from hal.errors import LeaseLost

LEASE_MARGIN_MS = 1.0
"""The guardian waits so much longer than the firmware's lease lasts."""


class LeaseGate:
    """``drivers.piezo.dac_amplifier.OutputGate`` of the firmware."""

    def __init__(self, heart: Heart, clock: Clock, name: str, lease_ms: float) -> None:
        self.lost = False
        """The lease is over or the guardian has the outputs: until it has given them back or is gone."""
        self._heart = heart
        self._clock = clock
        self._name = name
        self._lease_ns = round(lease_ms * 1e6)
        self._alone = False
        self._last = (-1, -1, -1)

    def enter(self, codes: tuple[int, int, int]) -> None:
        """Raises ``LeaseLost`` when the outputs are not the firmware's any more: then nothing may be sent."""
        heart = self._heart
        heart.enter(Order(codes, codes == self._last))
        self._last = codes
        now_ns = self._clock.now_ns()
        if self._alone:
            return
        silent_ns = now_ns - heart.beat_ns if heart.phase is Phase.RUNNING else 0
        if self.lost or heart.taken_ns or silent_ns > self._lease_ns:
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
        self._heart.leave()

    @property
    def alone(self) -> bool:
        """There is no guardian any more."""
        return self._alone

    def take_up(self) -> None:
        """The guardian has given the outputs back: the lease begins anew."""
        self.lost = False

    def join(self) -> None:
        """A new guardian watches: leases count again."""
        self._alone = False

    def regain(self) -> None:
        """There is no guardian any more: nobody else commands."""
        self._alone = True
        self.lost = False
