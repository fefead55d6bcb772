"""Makes the transfers of ``DacOutput`` in a compiled loop, on the driver's own memory.

A transfer that fails, and an answer that differs from the command, is kept for ``DacOutput.pending``: the driver's
next ``write`` or ``verify`` raises or reports it. Importing this module imports numba.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.output_guard_steps import CLIPPED, OFFERED_NS, SLEW_LIMITED, GuardState, admit, next_ramp_step, note_sent
from hal.compiled import kernel
from hal.fd_kernels import now_ns
from hal.i2c_kernels import REPLY_SIZE, Transfer, new_transfer, transfer, write_at

if TYPE_CHECKING:
    from drivers.piezo.dac_output import DacOutput

TRANSFER_NS, READ_BACK_NS, FAILED, WORDS = range(4)
"""Places in ``DacMemory.words``. ``READ_BACK_NS``: 0 if commands are not read back."""
DIFFERS = 1 << 32
"""``FAILED`` after an answer that differs from the command; other values are those of ``hal.i2c_kernels.transfer``."""
REAL_TIME = -1

guard_admit = kernel(admit)
guard_ramp = kernel(next_ramp_step)
guard_sent = kernel(note_sent)


class DacMemory(NamedTuple):
    """Holds the driver's memory. ``fixed_ns`` (1,): the time in virtual time, else REAL_TIME; ``codes`` (n,): the
    three codes of the last command, and the words that never change; ``code_at`` (3,): places of the codes in
    ``command.request``; ``codes_per_V`` (1,)."""

    words: NDArray[np.int64]
    fixed_ns: NDArray[np.int64]
    guard: GuardState
    command: Transfer
    check: Transfer
    codes: NDArray[np.int64]
    code_at: NDArray[np.int64]
    codes_per_V: NDArray[np.float64]


def memory_of(driver: DacOutput, carrier: int, fixed_ns: NDArray[np.int64], calls: tuple[int, int]) -> DacMemory:
    """Return the memory of ``driver``, which both then work on, one at a time. ``carrier``: of its bus; ``calls``:
    addresses of the functions that make the two transfers where the carrier is Python."""
    ops = (*driver.segments(0, 0, 0), *(driver.READ_CODES if driver.read_back else ()))
    places = [write_at(ops, segment, byte) for segment, byte in driver.CODE_AT]
    words = [driver.TRANSFER_NS, driver.READ_BACK_NS if driver.read_back else 0, 0]
    return DacMemory(
        np.array(words), fixed_ns, driver.guard.state.view(), new_transfer(carrier, driver.address, ops, calls[0]),
        new_transfer(carrier, driver.address, driver.VERIFY, calls[1]), np.array([0, 0, 0, *driver.FIXED_WORDS]),
        np.array(places), np.array([driver.codes_per_V]),
    )  # fmt: skip


@kernel
def clock_ns(out: DacMemory) -> int:
    """Return the time, the one that virtual time has fixed where there is one."""
    return now_ns() if out.fixed_ns[0] == REAL_TIME else out.fixed_ns[0]


@kernel
def encode(out: DacMemory) -> None:
    """Put ``next_V`` into the command, as ``DacOutput.segments`` does."""
    for i in range(3):
        code = int(out.guard.next_V[i] * out.codes_per_V[0] + 0.5)
        at = out.code_at[i]
        out.codes[i] = code
        out.command.request[at] = code >> 8
        out.command.request[at + 1] = code & 0xFF
    out.guard.words[OFFERED_NS] = clock_ns(out) + out.words[TRANSFER_NS]


@kernel
def is_as_told(reply: NDArray[np.uint8], codes: NDArray[np.int64], n: int) -> bool:
    """Return True if the first ``n`` words of an answer are ``codes``."""
    for i in range(n):
        at = REPLY_SIZE + 2 * i
        if reply[at] << 8 | reply[at + 1] != codes[i]:
            return False
    return True


@kernel
def send(out: DacMemory, fd: int) -> bool:
    """Send the encoded command. Return False, with the reason in ``FAILED``, if the driver has to go on."""
    failed = transfer(out.command, fd)
    if failed == 0:
        guard_sent(out.guard, clock_ns(out) - out.words[READ_BACK_NS])
        if out.words[READ_BACK_NS] > 0 and not is_as_told(out.command.reply, out.codes, 3):
            failed = DIFFERS
    out.words[FAILED] = failed
    return failed == 0


@kernel
def verify(out: DacMemory, fd: int) -> bool:
    """Do what ``DacOutput.verify`` does. Return False, with the reason in ``FAILED``, if the driver has to go on."""
    failed = transfer(out.check, fd)
    if failed == 0 and not is_as_told(out.check.reply, out.codes, len(out.codes)):
        failed = DIFFERS
    out.words[FAILED] = failed
    return failed == 0


@kernel
def admit_wish(out: DacMemory, values_V: NDArray[np.float64]) -> int:
    """Fill the guard's ``next_V``. Return its mask, or its refusal below 0."""
    return guard_admit(out.guard, values_V, clock_ns(out))


@kernel
def take_back(out: DacMemory, clipped: int, slew_limited: int) -> None:
    """Set the guard's counters back: the driver will admit the same wish again."""
    out.guard.words[CLIPPED], out.guard.words[SLEW_LIMITED] = clipped, slew_limited
