"""Commands an output from the compiled thread.

``write``, ``step_ramp``, ``verify`` and ``is_stuck`` choose the kernels of a driver by the type of its memory when they
are compiled. The lease of a DAC with a guardian is renewed around its transfers, as ``LeaseGate`` does it.
Importing this module imports numba.
"""

# pyright: basic
# numba's extension interface has no types

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from drivers.output_guard_steps import CLIPPED, SLEW_LIMITED
from drivers.piezo import can_loop, dac_loop, e727_loop
from drivers.piezo.e727_loop import HANDED_OVER, SENT
from drivers.piezo.gcs import UNSENT
from firmware_py.guardian.gate import NO_GUARDIAN, TRANSFER_END_NS, announce, has_lease, silence_ns
from firmware_py.guardian.heartbeat import BEAT, IN_FLIGHT
from hal.compiled import kernel
from hal.fd_kernels import full_fence

gate_announce = kernel(announce)
gate_silence = kernel(silence_ns)
gate_has_lease = kernel(has_lease)


class GatedDac(NamedTuple):
    """Holds a DAC and its lease: the words of ``Heartbeat`` and of ``LeaseGate``, both (0,) without a guardian."""

    dac: dac_loop.DacMemory
    heartbeat: NDArray[np.int64]
    gate: NDArray[np.int64]


@kernel
def enter(out: GatedDac) -> bool:
    """Do what ``LeaseGate.enter`` does. Return False if it would raise: nothing may be sent then."""
    heartbeat, gate, codes = out.heartbeat, out.gate, out.dac.codes
    if len(heartbeat) == 0:
        return True
    gate_announce(heartbeat, gate, codes[0], codes[1], codes[2])
    # the guardian must see the command before this side looks whether it has taken the outputs
    full_fence()  # pyright: ignore[reportCallIssue]
    if gate[NO_GUARDIAN] != 0:
        return True
    now = dac_loop.clock_ns(out.dac)
    if not gate_has_lease(heartbeat, gate, gate_silence(heartbeat, now)):
        heartbeat[IN_FLIGHT] = 0
        return False
    heartbeat[BEAT] = now
    return True


@kernel
def leave(out: GatedDac) -> None:
    """Do what ``LeaseGate.leave`` does."""
    if len(out.heartbeat) > 0:
        out.gate[TRANSFER_END_NS] = dac_loop.clock_ns(out.dac)
        full_fence()  # pyright: ignore[reportCallIssue]
        out.heartbeat[IN_FLIGHT] = 0


@kernel
def send_dac(out: GatedDac, fd: int) -> bool:
    """Do what ``DacOutput`` does with ``next_V``. Return False if the driver has to go on."""
    dac_loop.encode(out.dac)
    if not enter(out):
        return False
    is_sent = dac_loop.send(out.dac, fd)
    leave(out)
    return is_sent


@kernel
def write_dac(out: GatedDac, fd: int, values_V: NDArray[np.float64]) -> tuple[int, int]:
    """Do what ``DacOutput.write`` does. Return the result and the guard's mask."""
    guard = out.dac.guard.words
    clipped, slew_limited = guard[CLIPPED], guard[SLEW_LIMITED]
    mask = dac_loop.admit_wish(out.dac, values_V)
    if mask >= 0 and send_dac(out, fd):
        return SENT, mask
    if mask < 0 or out.dac.words[dac_loop.FAILED] == 0:  # refused: the driver begins anew
        dac_loop.take_back(out.dac, clipped, slew_limited)
    return HANDED_OVER, 0


@kernel
def step_ramp_dac(out: GatedDac, fd: int) -> bool:
    """Do what ``DacOutput.safe_step`` does but for reading back. Return True if that was the last step."""
    is_last = dac_loop.guard_ramp(out.dac.guard, dac_loop.clock_ns(out.dac))
    return send_dac(out, fd) and is_last


def write(out: Any, fd: int, values_V: NDArray[np.float64], now_ns: int) -> tuple[int, int]:
    """Send a command. Return SENT, PASSED_OVER or HANDED_OVER, and the guard's mask."""
    raise NotImplementedError


def step_ramp(out: Any, fd: int, now_ns: int) -> bool:
    """Send the next step to neutral. Return True if that was the last one."""
    raise NotImplementedError


def verify(out: Any, fd: int) -> bool:
    """Read the output back. Return False if the driver has to go on."""
    raise NotImplementedError


def is_stuck(out: Any) -> bool:
    """Return True while bytes of a command have not been taken."""
    raise NotImplementedError


@kernel
def write_can(out: can_loop.CanMemory, fd: int, values_V: NDArray[np.float64]) -> tuple[int, int]:
    """Do what ``CanAmplifier.write`` does. Return the result and the guard's mask."""
    is_sent, mask = can_loop.write(out, fd, values_V)
    return (SENT if is_sent else HANDED_OVER), mask


def _is(out: Any, memory: type) -> bool:
    return getattr(out, "instance_class", None) is memory


@overload(write, strict=False)
def _write(out: Any, fd: Any, values_V: Any, now_ns: Any) -> Any:
    if _is(out, GatedDac):
        return lambda out, fd, values_V, now_ns: write_dac(out, fd, values_V)
    if _is(out, can_loop.CanMemory):
        return lambda out, fd, values_V, now_ns: write_can(out, fd, values_V)
    return lambda out, fd, values_V, now_ns: e727_loop.write(out, fd, values_V, now_ns)


@overload(step_ramp, strict=False)
def _step_ramp(out: Any, fd: Any, now_ns: Any) -> Any:
    if _is(out, GatedDac):
        return lambda out, fd, now_ns: step_ramp_dac(out, fd)
    if _is(out, can_loop.CanMemory):
        return lambda out, fd, now_ns: can_loop.step_ramp(out, fd)
    return lambda out, fd, now_ns: e727_loop.step_ramp(out, fd, now_ns)


@overload(verify, strict=False)
def _verify(out: Any, fd: Any) -> Any:
    if _is(out, GatedDac):
        return lambda out, fd: dac_loop.verify(out.dac, fd)
    return lambda out, fd: True


@overload(is_stuck, strict=False)
def _is_stuck(out: Any) -> Any:
    if _is(out, e727_loop.OutputMemory):
        return lambda out: out.link.sizes[UNSENT] > 0
    return lambda out: False
