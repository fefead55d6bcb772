"""Describes the outputs that the compiled thread can command: memory, descriptor, hand-over."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from drivers.piezo.can_amplifier import CanAmplifier
from drivers.piezo.dac_output import DacOutput
from drivers.piezo.e727 import E727
from firmware_py.compiled.ports import Descriptor, Fed, lacks_descriptor
from firmware_py.guardian.amplifier import GuardedAmplifier
from hal.can_carrier import PYTHON as CAN_PYTHON
from hal.can_carrier import CanCarrier
from hal.can_wire import FRAME_BYTES, pack_frame, unpack_frame
from hal.clock import VirtualClock
from hal.contracts import AnalogOutput, CanBus, Clock, I2cBus
from hal.errors import BusError, HalError
from hal.i2c_carrier import PYTHON, I2cCarrier
from hal.middleware.share import CanView
from hal.types import I2cOp

LONGEST_FRAME = 72
"""Size of ``struct canfd_frame``: one read of a CAN socket takes one frame."""


class Side(Protocol):
    """Stands for the Python side of an output in the thread. In virtual time ``feed`` and ``flush`` carry its bytes.

    ``begin``, ``take_over``, ``catch_up``, ``feed``, ``flush`` and ``close`` do nothing where an output does not define
    them.
    """

    def memory(self, fixed_ns: NDArray[np.int64]) -> Any:
        """Return what ``firmware_py.compiled.outputs`` works on. ``fixed_ns`` (1,): the time in virtual time."""
        ...

    def lacks(self) -> str:
        """Return why the thread cannot reach the output; empty if it can."""
        ...

    @property
    def is_well(self) -> bool:
        """False while Python has to talk to the output."""
        ...

    def fileno(self) -> int: ...
    def begin(self) -> None:
        """Pass over what has come for the thread while Python was at work."""

    def take_over(self, is_read_back: bool) -> None:
        """Hand to the driver what the thread has left to it. ``is_read_back``: it came from reading back."""

    def catch_up(self) -> None:
        """Let the driver pass over what has come for it while the thread was at work."""

    def feed(self) -> None:
        """Give the thread what has come for it."""

    def flush(self) -> None:
        """Send what the thread has written."""

    def close(self) -> None:
        """Close what was opened for the thread."""


class E727Side(Side):
    """Connects an E-727 on a serial line. The thread reads and writes the driver's own port and memory."""

    def __init__(self, driver: E727, clock: Clock) -> None:
        self._driver = driver
        self._clock = clock

    def lacks(self) -> str:
        return lacks_descriptor(self._driver.port, self._clock)

    def memory(self, fixed_ns: NDArray[np.int64]) -> Any:
        from drivers.piezo.e727_loop import memory_of  # numba

        return memory_of(self._driver)

    @property
    def is_well(self) -> bool:
        return self._driver.link.is_well

    def fileno(self) -> int:
        port = self._driver.port
        assert isinstance(port, Descriptor)
        return port.fileno()

    def feed(self) -> None:
        port = self._driver.port
        assert isinstance(port, Fed)
        port.feed(0.0)

    def flush(self) -> None:
        port = self._driver.port
        assert isinstance(port, Fed)
        port.flush()


class VirtualCalls:
    """Makes what the thread asks of a bus of virtual time, as functions that compiled code calls.

    ``fixed_ns`` (1,) is the thread's time: a call begins then and moves it to when it has ended."""

    CARRIER = PYTHON

    def __init__(self, clock: Clock, fixed_ns: NDArray[np.int64]) -> None:
        self._clock, self._fixed_ns = clock, fixed_ns
        self._error: BaseException = BusError("no call has failed")
        self._kept: list[object] = []

    def add_call(self, do: Callable[[], int]) -> int:
        """Return the address by which compiled code calls ``do``. It gives -1 where ``do`` raises; ``error`` tells."""
        from hal.python_call import python_call  # numba

        address, kept = python_call(lambda: self._call(do))
        self._kept.append(kept)
        return address

    def _call(self, do: Callable[[], int]) -> int:
        self._clock.sleep_until_ns(int(self._fixed_ns[0]))
        try:
            return do()
        except BaseException as error:  # compiled code could not pass it on
            self._error = error
            return -1
        finally:
            self._fixed_ns[0] = self._clock.now_ns()

    def error(self) -> HalError:
        """Return the error of the last call that failed. Raises what is no error of the bus."""
        if isinstance(self._error, HalError):
            return self._error
        raise self._error

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        """The bus is the bench's."""


class VirtualBus(VirtualCalls):
    """Makes the thread's transfers on any I2C bus of virtual time."""

    def __init__(self, bus: I2cBus, clock: Clock, address: int, fixed_ns: NDArray[np.int64]) -> None:
        super().__init__(clock, fixed_ns)
        self._bus, self._address = bus, address
        self._transfers: list[Any] = []

    def add_transfer(self) -> int:
        """Return the address of the function for the transfer that ``serve`` will be given next."""
        from hal.i2c_kernels import ops_of  # numba

        number = len(self._kept)
        return self.add_call(lambda: self._transfer(self._transfers[number], ops_of))

    def serve(self, transfers: list[Any]) -> None:
        """Make ``transfers``, in the order of ``add_transfer``."""
        self._transfers = transfers

    def _transfer(self, transfer: Any, ops_of: Callable[[Any], list[I2cOp]]) -> int:
        answer = self._bus.transfer(self._address, ops_of(transfer))
        if answer:
            transfer.reply[-len(answer) :] = np.frombuffer(answer, np.uint8)
        return 0

    def for_thread(self) -> VirtualBus:
        return self

    def failure(self, code: int, address: int) -> HalError:
        """See ``I2cCarrier``."""
        return self.error()


class VirtualCan(VirtualCalls):
    """Sends and receives the thread's frames on any CAN bus of virtual time."""

    CARRIER = CAN_PYTHON

    def __init__(self, bus: CanBus, clock: Clock, fixed_ns: NDArray[np.int64]) -> None:
        super().__init__(clock, fixed_ns)
        self._bus = bus
        self._line: Any = None

    def serve(self, line: Any) -> None:
        """Send and receive the frames of ``line``."""
        self._line = line

    def send(self) -> int:
        """See ``hal.can_kernels.send``."""
        frame = unpack_frame(self._line.outgoing.tobytes(), 0)
        assert frame is not None
        self._bus.send(frame, 0.0)
        return 0

    def receive(self) -> int:
        """See ``hal.can_kernels.receive``."""
        from hal.can_kernels import CAME, NOTHING, RECEIVED_NS  # numba

        frame = self._bus.recv(0.0)
        if frame is None:
            return NOTHING
        self._line.received[:FRAME_BYTES] = np.frombuffer(pack_frame(frame), np.uint8)
        self._line.words[RECEIVED_NS] = frame.t_ns
        return CAME

    def for_thread(self, can_ids: Iterable[int]) -> VirtualCan:
        return self

    def failure(self, code: int) -> HalError:
        """See ``CanCarrier``."""
        return self.error()


class DacSide(Side):
    """Connects a DAC on an I2C bus, with or without a guardian. A DAC sends nothing by itself."""

    def __init__(self, amplifier: GuardedAmplifier | DacOutput, clock: Clock) -> None:
        self._gate = amplifier.gate if isinstance(amplifier, GuardedAmplifier) else None
        self._driver = amplifier.inner if isinstance(amplifier, GuardedAmplifier) else amplifier
        self._clock = clock
        self._carrier: I2cCarrier | None = None
        self._memory: Any = None

    def lacks(self) -> str:
        if isinstance(self._clock, VirtualClock) or isinstance(self._driver.bus, I2cCarrier):
            return ""
        return f"its bus ({type(self._driver.bus).__name__}) has no file descriptor"

    def memory(self, fixed_ns: NDArray[np.int64]) -> Any:
        from drivers.piezo.dac_loop import memory_of  # numba
        from firmware_py.compiled.outputs import GatedDac

        driver, gate, calls = self._driver, self._gate, (0, 0)
        virtual = None
        if isinstance(self._clock, VirtualClock):
            self._carrier = virtual = VirtualBus(driver.bus, self._clock, driver.address, fixed_ns)
            calls = virtual.add_transfer(), virtual.add_transfer()
        else:
            assert isinstance(driver.bus, I2cCarrier)
            self._carrier = driver.bus.for_thread()
        dac = memory_of(driver, self._carrier.CARRIER, fixed_ns, calls)
        if virtual is not None:
            virtual.serve([dac.command, dac.check])
        none = np.zeros(0, np.int64)
        heartbeat = np.frombuffer(gate.heartbeat.words, np.int64) if gate is not None else none
        self._memory = GatedDac(dac, heartbeat, np.frombuffer(gate.words, np.int64) if gate is not None else none)
        return self._memory

    @property
    def is_well(self) -> bool:
        return self._driver.is_ready and (self._gate is None or not self._gate.lost)

    def fileno(self) -> int:
        assert self._carrier is not None
        return self._carrier.fileno()

    def take_over(self, is_read_back: bool) -> None:
        from drivers.piezo.dac_loop import DIFFERS, FAILED
        from hal.i2c_kernels import REPLY_SIZE

        dac = self._memory.dac
        if not (failed := int(dac.words[FAILED])):
            return
        dac.words[FAILED] = 0
        if failed == DIFFERS:
            reply = dac.check.reply if is_read_back else dac.command.reply
            self._driver.pending = reply[REPLY_SIZE:].tobytes()
        else:
            assert self._carrier is not None
            self._driver.pending = self._carrier.failure(failed, self._driver.address)

    def close(self) -> None:
        self._memory = None
        is_own = cast("object", self._carrier) is not self._driver.bus
        if self._carrier is not None and is_own:
            self._carrier.close()


class CanSide(Side):
    """Connects the CAN node."""

    def __init__(self, driver: CanAmplifier, clock: Clock) -> None:
        self._driver = driver
        self._below = driver.bus.below if isinstance(driver.bus, CanView) else driver.bus
        self._clock = clock
        self._carrier: CanCarrier | None = None
        self._memory: Any = None

    def lacks(self) -> str:
        if isinstance(self._clock, VirtualClock) or isinstance(self._below, CanCarrier):
            return ""
        return f"its bus ({type(self._below).__name__}) has no socket of single frames"

    def memory(self, fixed_ns: NDArray[np.int64]) -> Any:
        from drivers.piezo.can_loop import memory_of  # numba

        driver = self._driver
        if isinstance(self._clock, VirtualClock):
            self._carrier = virtual = VirtualCan(driver.bus, self._clock, fixed_ns)
            calls = virtual.add_call(virtual.send), virtual.add_call(virtual.receive)
            self._memory = memory_of(driver, virtual.CARRIER, fixed_ns, calls)
            virtual.serve(self._memory.line)
        else:
            assert isinstance(self._below, CanCarrier)
            self._carrier = self._below.for_thread((driver.status_id,))
            self._memory = memory_of(driver, self._carrier.CARRIER, fixed_ns, (0, 0))
        return self._memory

    @property
    def is_well(self) -> bool:
        return self._driver.is_ready

    def fileno(self) -> int:
        assert self._carrier is not None
        return self._carrier.fileno()

    def take_over(self, is_read_back: bool) -> None:
        from drivers.piezo.can_loop import FAILED, WRONG_LENGTH
        from hal.can_wire import LENGTH_AT

        words = self._memory.words
        if not (failed := int(words[FAILED])):
            return
        words[FAILED] = 0
        assert self._carrier is not None
        if failed == WRONG_LENGTH:
            self._driver.pending = self._driver.wrong_status(int(self._memory.line.received[LENGTH_AT]))
        else:
            self._driver.pending = self._carrier.failure(failed)

    def begin(self) -> None:
        """The thread's connection holds what the node said since the thread ran last, or was made: all of it is old,
        and some of it says that the node was not armed."""
        if isinstance(self._carrier, VirtualCan):
            return
        with contextlib.suppress(HalError):  # the thread's next call says it
            self._driver.poll()
        with contextlib.suppress(OSError):
            while os.read(self.fileno(), LONGEST_FRAME):
                pass

    def catch_up(self) -> None:
        if not isinstance(self._carrier, VirtualCan):
            with contextlib.suppress(HalError):  # the driver's next call says it
                self._driver.forget_received()

    def close(self) -> None:
        self._memory = None
        if self._carrier is not None:
            self._carrier.close()


def side_of(amplifier: AnalogOutput, clock: Clock) -> Side | None:
    """Return the side of ``amplifier``, None if it has no kernels."""
    inner = amplifier.inner if isinstance(amplifier, GuardedAmplifier) else amplifier
    if isinstance(inner, E727):
        return E727Side(inner, clock)
    if isinstance(inner, CanAmplifier):
        return CanSide(inner, clock)
    if isinstance(inner, DacOutput) and inner.CODE_AT and inner.VERIFY:
        return DacSide(amplifier if isinstance(amplifier, GuardedAmplifier) else inner, clock)
    return None
