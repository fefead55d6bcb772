"""Functions that the accelerometer and gyroscope dies of a BMX055 share: power, reset, shadowing, FIFO, NVM.

Source: BMX055 data sheet BST-BMX055-DS000 rev. 1.3.

Model limits
- Those of ``bmx055``, which is made of these.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_devices.devices.register_map import Outputs, RegisterFace, SampleClock, signed_limited
from sim_devices.plant.imu import Imu

CHIP_ID, DATA, TEMPERATURE, INT_STATUS_1, FIFO_STATUS = 0x00, 0x02, 0x08, 0x0A, 0x0E
RANGE, BANDWIDTH, LPM1, HIGH_BANDWIDTH, SOFT_RESET, LATCH = 0x0F, 0x10, 0x11, 0x13, 0x14, 0x21
NVM_CONTROL, FIFO_CONFIG_1, FIFO_DATA = 0x33, 0x3E, 0x3F
RESET_COMMAND = 0xB6
NVM_PROGRAM_NS = 10_000_000


@dataclass(frozen=True)
class DieFacts:
    """Holds the constants in which the dies differ."""

    start_up_ns: int
    unlatched_ns: int
    fifo_frames: int
    empty_word: bytes
    nvm: tuple[int, int]  # first and last register that the NVM keeps


class Die(RegisterFace):
    """Power, reset, shadowing, FIFO, NVM and averaging, common to both dies."""

    def __init__(
        self, facts: DieFacts, reset: Mapping[int, int], masks: Mapping[int, int], imu: Imu, start_ns: int
    ) -> None:
        self._facts, self._imu = facts, imu
        self._nvm: dict[int, int] = {}
        self._nvm_left = 15
        self._clock, self._outputs = SampleClock(), Outputs(bytes(6))
        self.fifo: deque[bytes] = deque()
        self.samples, self.overruns = 0, 0
        super().__init__(reset, masks)
        self._set_up()
        self._run(start_ns)

    def load_reset_values(self) -> None:
        super().load_reset_values()
        for register, value in self._nvm.items():
            self.registers[register] = value

    def _set_up(self) -> None:
        self._clock.halt()
        self._outputs.clear()
        self._ready_ns, self._nvm_due_ns = -1, -1
        self._locked: dict[int, int] = {}
        self._seen_ns = [-1, -1, -1]
        self._latch_ns = -1
        self._averaging: list[NDArray[np.float64]] | None = None
        self._clear_fifo()

    def _clear_fifo(self) -> None:
        self.fifo.clear()
        self._fifo_overrun = False
        self._frame = b""

    # ------------------------------------------------------------------ for each die

    def _rate_hz(self) -> float:
        raise NotImplementedError

    def _measure(self, t_ns: int) -> list[int]:
        """Three data words as they stand in the registers, new-data bit clear."""
        raise NotImplementedError

    def _new_data_enabled(self) -> bool:
        raise NotImplementedError

    def _watermark(self) -> int:
        raise NotImplementedError

    # ------------------------------------------------------------------ registers

    def next_register(self, register: int) -> int:
        return register if register == FIFO_DATA else register + 1 & 0x7F

    def read(self, n: int, t_ns: int) -> bytes:
        data = super().read(n, t_ns)
        self._frame = b""
        return data

    def read_register(self, register: int, t_ns: int) -> int:
        if t_ns < self._ready_ns:
            return 0
        if DATA <= register < DATA + 6:
            return self._data(register - DATA, t_ns)
        if register == TEMPERATURE:
            return signed_limited((self._imu.temperature_C(t_ns) - 23.0) * 2.0, 8) & 0xFF
        if register == FIFO_STATUS:
            return (0x80 if self._fifo_overrun else 0) | len(self.fifo)
        if register == FIFO_DATA:
            return self._fifo_byte()
        if register == NVM_CONTROL:
            busy = self._nvm_due_ns >= 0
            return self._nvm_left << 4 | (0 if busy else 0x04) | self.registers[NVM_CONTROL] & 0x01
        return self.registers[register]

    def _data(self, offset: int, t_ns: int) -> int:
        channel, msb = offset >> 1, offset & 1
        sampled_ns, block = self._outputs.at(t_ns)
        low, high = block[2 * channel], block[2 * channel + 1]
        fresh = sampled_ns > self._seen_ns[channel]
        self._seen_ns[channel] = max(sampled_ns, self._seen_ns[channel])
        if msb:
            return self._locked.pop(channel, high)
        if not self.registers[HIGH_BANDWIDTH] & 0x40:  # shadow_dis
            self._locked[channel] = high
        return self._with_flag(low, fresh)

    def _with_flag(self, low: int, fresh: bool) -> int:
        return low

    def _fifo_byte(self) -> int:
        if not self._frame:
            self._frame = self.fifo.popleft() if self.fifo else self._facts.empty_word
        value, self._frame = self._frame[0], self._frame[1:]
        return value

    def _new_data(self, t_ns: int) -> bool:
        """Status bit of the new-data interrupt."""
        if not self._new_data_enabled():
            return False
        sampled_ns = self._outputs.at(t_ns)[0]
        if self.registers[LATCH] & 0x0F in (0x7, 0xF):
            return sampled_ns > self._latch_ns
        return sampled_ns >= 0 and t_ns - sampled_ns < self._facts.unlatched_ns

    def write_register(self, register: int, value: int, t_ns: int) -> None:
        if t_ns < self._ready_ns:
            return
        if register == SOFT_RESET:
            if value == RESET_COMMAND:
                self.load_reset_values()
                self._set_up()
                self._ready_ns = t_ns + self._facts.start_up_ns
                self._run(self._ready_ns)
            return
        before = self.registers[register]
        super().write_register(register, value, t_ns)
        if register in (BANDWIDTH, LPM1, HIGH_BANDWIDTH) and before != self.registers[register]:
            woken = register == LPM1 and before & 0xA0
            self._run(t_ns + (self._facts.start_up_ns if woken else 0))
        elif register == FIFO_CONFIG_1:
            self._clear_fifo()
        elif register == LATCH and value & 0x80:
            self.registers[LATCH] &= 0x7F
            self._latch_ns = t_ns
        elif register == NVM_CONTROL:
            self._nvm_order(value, t_ns)

    def _nvm_order(self, value: int, t_ns: int) -> None:
        first, last = self._facts.nvm
        if value & 0x08:  # load
            for register in range(first, last + 1):
                self.registers[register] = self._nvm.get(register, 0)
        if value & 0x02 and self.registers[NVM_CONTROL] & 0x01 and self._nvm_left and self._nvm_due_ns < 0:
            self._nvm_left -= 1
            self._nvm_due_ns = t_ns + NVM_PROGRAM_NS

    # ------------------------------------------------------------------ sampling

    def next_event_ns(self) -> int | None:
        return None if self.frozen else self._clock.due_ns

    def advance_to(self, t_ns: int) -> None:
        if 0 <= self._nvm_due_ns <= t_ns:
            self._nvm_due_ns = -1
            first, last = self._facts.nvm
            self._nvm = {register: self.registers[register] for register in range(first, last + 1)}
        for due_ns in self._clock.ticks_until(t_ns, frozen=self.frozen):
            self._sample(due_ns)

    def _run(self, t_ns: int) -> None:
        if self.registers[LPM1] & 0xA0:  # suspend, deep suspend
            self._clock.halt()
        else:
            self._clock.run(t_ns, 1e9 / self._rate_hz())

    def _sample(self, t_ns: int) -> None:
        self.samples += 1
        block = b"".join(word.to_bytes(2, "little") for word in self._measure(t_ns))
        self._outputs.push(t_ns, block)
        mode, axes = self.registers[FIFO_CONFIG_1] >> 6, self.registers[FIFO_CONFIG_1] & 3
        frame = block if axes == 0 else block[2 * axes - 2 : 2 * axes]
        depth = self._facts.fifo_frames if mode else 1
        if len(self.fifo) >= depth:
            if mode:
                self.overruns += 1
                self._fifo_overrun = True
            if mode == 1:  # FIFO mode stops when full; bypass and stream keep the newest
                return
            self.fifo.popleft()
        self.fifo.append(frame)

    def _average(self, values: NDArray[np.float64], n: int) -> NDArray[np.float64] | None:
        """Collects for fast compensation; the mean once ``n`` samples are there."""
        if self._averaging is None:
            return None
        self._averaging.append(values)
        if len(self._averaging) < n:
            return None
        mean = np.mean(self._averaging, axis=0)
        self._averaging = None
        return mean
