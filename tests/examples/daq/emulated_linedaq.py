"""The other end of the line. Model limits: nothing is lost, the clock is perfect, +-5 V, no noise of its own."""

import numpy as np

from sim_devices.devices.line_face import LineFace
from sim_devices.registry import Device


class EmulatedLineDaq(LineFace):
    def hear(self, words: list[str], t_ns: int) -> None:
        match words:
            case ["who"]:
                self.say("linedaq 1")
            case ["go", rate, *channels]:
                self._period_ns, self._channels = round(1e9 / float(rate)), [int(c) for c in channels]
                self._sequence, self.due_ns = 0, t_ns + self._period_ns
            case ["halt"]:
                self.due_ns = None
            case ["out", bits]:
                self.around.switch(int(bits), t_ns)

    def act(self, t_ns: int) -> None:
        counts = np.rint(self.around.analog_V(t_ns)[self._channels] / 5.0 * 32768)
        self.say(" ".join(map(str, (self._sequence & 0xFFFF, *np.clip(counts, -32768, 32767).astype(int)))))
        self._sequence, self.due_ns = self._sequence + 1, t_ns + self._period_ns


EMULATED = Device(EmulatedLineDaq)
