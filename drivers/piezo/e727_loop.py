"""Does the E-727's ``write`` and ``safe_step`` in a compiled loop: the driver's own functions on its own memory, on a
descriptor.

What the driver would raise, and what is not ordinary, is handed over: the memory is left so that ``E727.write`` goes on
where this stopped. Importing this module imports numba.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.base import next_due_ns
from drivers.output_guard_steps import GuardState, admit, next_ramp_step, note_sent
from drivers.piezo.e727_kernels import TEXT_BYTES, encode
from drivers.piezo.e727_words import ASK_ERROR_EVERY, COMMANDS, DUE_NS, PERIOD_NS, SUPERSEDED
from drivers.piezo.gcs import (
    COMPLAINT,
    ERROR_QUERY,
    LINE,
    NEVER,
    NOTHING,
    UNSENT,
    LinkMemory,
    keep_unsent,
    take_answer,
)
from hal.compiled import kernel
from hal.fd_kernels import POLLIN, poll_word, read_fd, wait_fds, write_fd
from hal.scratch import stack_index

if TYPE_CHECKING:
    from drivers.piezo.e727 import E727

SENT, PASSED_OVER, HANDED_OVER = range(3)
"""Results of ``write``: the port has the command; a newer one will replace it; ``E727.write`` must be called."""

guard_admit = kernel(admit)
guard_ramp = kernel(next_ramp_step)
guard_sent = kernel(note_sent)
link_take = kernel(take_answer)
link_keep = kernel(keep_unsent)
following_due = kernel(next_due_ns)


class OutputMemory(NamedTuple):
    """Holds the driver's memory. ``scales`` (2,): ``per_V`` and, above 0, that the servo is on; ``timeout_ns`` (1,)."""

    words: NDArray[np.int64]
    guard: GuardState
    link: LinkMemory
    text: NDArray[np.uint8]
    answer: NDArray[np.uint8]
    query: NDArray[np.uint8]
    scales: NDArray[np.float64]
    timeout_ns: NDArray[np.int64]


def memory_of(driver: E727) -> OutputMemory:
    """Return the memory of ``driver``, which both then work on, one at a time."""
    return OutputMemory(
        np.frombuffer(driver.words, np.int64), driver.guard.state.view(), driver.link.memory.view(),
        np.zeros(TEXT_BYTES, np.uint8), np.zeros(256, np.uint8), np.frombuffer(ERROR_QUERY, np.uint8).copy(),
        np.array([driver.per_V, float(driver.servo)]), np.array([round(driver.link.timeout_s * 1e9)]),
    )  # fmt: skip


@kernel
def send(out: OutputMemory, fd: int, now_ns: int) -> bool:
    """Send ``next_V``, and ask for errors now and then, as ``E727`` does. Return False if the port failed: the bytes
    are kept then, and the next ``write`` of the driver tells why."""
    size = encode(out.text, out.scales[1] > 0.0, out.guard.next_V, out.scales[0])
    done = write_fd(fd, out.text, size, 0)
    if done < size:
        link_keep(out.link, out.text, max(done, 0), size)
    if done < 0:
        return False
    out.words[COMMANDS] += 1
    if out.words[COMMANDS] % ASK_ERROR_EVERY == 0 and out.link.asked_ns[0] == NEVER and out.link.sizes[UNSENT] == 0:
        size = len(out.query)
        done = write_fd(fd, out.query, size, 0)
        if done < size:
            link_keep(out.link, out.query, max(done, 0), size)
        if done < 0:
            return False
        out.link.asked_ns[0] = now_ns
    return True


@kernel
def is_link_well(out: OutputMemory, fd: int, now_ns: int) -> bool:
    """Take the answer to ``ERR?`` that has come, as ``GcsLink.take_error`` does. Return False if there is something to
    tell."""
    link = out.link
    if link.sizes[UNSENT] > 0:
        return False
    if link.asked_ns[0] == NEVER:
        return True
    polls = stack_index(1)  # pyright: ignore[reportCallIssue, reportUnknownVariableType]
    polls[0] = poll_word(fd, POLLIN)
    n, verdict = 0, NOTHING
    # a read of a tty that has nothing gives 0 bytes, as one that was hung up does
    if wait_fds(polls, 0) != 0:  # pyright: ignore[reportUnknownArgumentType]
        n = read_fd(fd, out.answer, 0, len(out.answer))
        if n <= 0:
            return False
    if n > 0 or link.sizes[LINE] > 0:
        verdict = link_take(link, out.answer, n)
    if verdict == NOTHING:
        return now_ns - link.asked_ns[0] <= out.timeout_ns[0]
    return verdict != COMPLAINT


@kernel
def write(out: OutputMemory, fd: int, values_V: NDArray[np.float64], now_ns: int) -> tuple[int, int]:
    """Write ``values_V`` (3,) as ``E727.write`` does. Return the result and the guard's mask."""
    if not is_link_well(out, fd, now_ns):
        return HANDED_OVER, 0
    mask = guard_admit(out.guard, values_V, now_ns)
    if mask < 0:
        return HANDED_OVER, 0
    if now_ns < out.words[DUE_NS]:
        out.words[SUPERSEDED] += 1
        return PASSED_OVER, mask
    out.words[DUE_NS] = following_due(out.words[DUE_NS], now_ns, out.words[PERIOD_NS])
    if not send(out, fd, now_ns):
        return HANDED_OVER, 0
    guard_sent(out.guard, now_ns)
    return SENT, mask


@kernel
def step_ramp(out: OutputMemory, fd: int, now_ns: int) -> bool:
    """Do what ``E727.safe_step`` does. Return True if that was the last step, and the port has it. Nothing goes out
    behind bytes that are stuck."""
    done = guard_ramp(out.guard, now_ns)
    if done or now_ns >= out.words[DUE_NS]:
        out.words[DUE_NS] = following_due(out.words[DUE_NS], now_ns, out.words[PERIOD_NS])
        if out.link.sizes[UNSENT] > 0:
            size = out.link.sizes[UNSENT]
            written = write_fd(fd, out.link.unsent, size, 0)
            if written > 0:
                link_keep(out.link, out.link.unsent, written, size)
            if out.link.sizes[UNSENT] > 0:
                return False
        if not send(out, fd, now_ns):
            return False
    guard_sent(out.guard, now_ns)
    return done
