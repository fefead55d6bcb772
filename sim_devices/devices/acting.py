"""A device that acts by itself at one time that it sets: the clock half of ``WordFace`` and ``LineFace``."""

from __future__ import annotations


class ActingFace:
    """Acts by itself at ``due_ns``. ``frozen`` is a fault hook: the device then stops acting."""

    frozen = False
    due_ns: int | None = None

    def act(self, t_ns: int) -> None:
        """Do the action that is due at ``t_ns``, and set ``due_ns`` to the time of the next one."""

    def next_event_ns(self) -> int | None:
        return None if self.frozen else self.due_ns

    def advance_to(self, t_ns: int) -> None:
        while self.due_ns is not None and self.due_ns <= t_ns and not self.frozen:
            now_ns, self.due_ns = self.due_ns, None
            self.act(now_ns)
