"""An emulated bench inside a test: virtual time, and ports shaped like those of smbus2 and pyserial.

Nothing waits: time moves by what the ports do and by ``VirtualBench.advance``, so every run gives the same bits.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import numpy as np

from drivers.specs import check_devices
from hal.bench import BenchDescription, load_bench
from hal.clock import VirtualClock
from hal.contracts import CanBus, I2cBus, SerialPort
from hal.errors import BenchError, BusError, ErrorKind, I2cNack
from hal.types import I2cOp, I2cRead, I2cWrite
from hal.validation import validate_table
from sim_devices.lockstep_world import LockstepWorld
from sim_devices.register import provider
from sim_devices.stimuli import constant, played

DRIVERS = {"ad5696r": "dac_amplifier", "can_piezo_node": "can_amplifier"}
"""Parts whose driver in a bench file has another name."""
SERIAL = ("di4108", "e727", "motion_card")
CAN = ("can_amplifier", "can_telemetry")
READ_BYTES = 4096


class VirtualBench:
    """A world in virtual time with its ports. ``part`` is the emulated device of a bench with one part."""

    def __init__(self, description: BenchDescription, folder: Path) -> None:
        check_devices(description, description.name)
        self.clock = VirtualClock()
        table = {**description.model_dump(), "folder": str(folder)}
        world = provider(table, clock=self.clock, runtime_dir=folder, hand_file=None, hand_scale=None)
        assert isinstance(world, LockstepWorld)
        self._world = world
        self._kinds = {name: description.bus[name].kind for name in description.emulated_buses()}

    @property
    def part(self) -> Any:
        """Return the emulated device with its truth face; the first one of a bench with several."""
        return next(iter(self._world.world.devices.values()))

    @property
    def now_s(self) -> float:
        """Return the age of the world, in s."""
        return self.clock.now_ns() * 1e-9

    def advance(self, seconds: float) -> None:
        """Let time pass; devices act in it."""
        self.clock.advance_to(self.clock.now_ns() + round(seconds * 1e9))

    def port(self, bus: str | None = None) -> SerialPort | I2cBus | CanBus:
        """Return the port of ``bus`` (the only one, if it is left out) with the contract of ``hal.contracts``."""
        if bus is None and len(self._kinds) != 1:
            raise BenchError(f"name one of the buses {', '.join(self._kinds)}")
        return self._world.endpoint(bus or next(iter(self._kinds)))

    def smbus(self, bus: str | None = None) -> VirtualSMBus:
        """Return an I2C bus with the methods of ``smbus2.SMBus``."""
        return VirtualSMBus(cast(I2cBus, self.port(bus)))

    def serial(self, bus: str | None = None, timeout: float | None = 1.0) -> VirtualSerial:
        """Return a serial port with the methods of ``serial.Serial``; ``timeout`` in s of virtual time."""
        return VirtualSerial(cast(SerialPort, self.port(bus)), timeout)

    def put(self, channel: str, values: Any, rate_hz: float | None = None) -> None:
        """Put a constant at ``channel``, a column (n,) at ``rate_hz`` from now on, or ``None``: the physics again.

        Raises ``UnknownChannel``, a ValueError."""
        stimuli = self._world.world.stimuli
        if values is None:
            stimuli.put(channel, None)
        elif rate_hz is None:
            stimuli.put(channel, constant(float(values)))
        else:
            column = np.asarray(values, dtype=np.float64)
            stimuli.put(channel, played(np.arange(len(column)) / rate_hz, column, self.clock.now_ns()))

    def read(self, name: str = "") -> dict[str, float]:
        """Return the value of a channel, of all channels of a part, or of all parts, by channel."""
        return self._world.world.stimuli.read(name, self.clock.now_ns())

    def fault(self, fault: str, target: str) -> None:
        """Do one of ``sim_devices.faults.FAULTS`` to a part or bus; raises ``UnknownFault``, a ValueError."""
        self._world.inject(fault, target)

    def close(self) -> None:
        """End the world. Idempotent."""
        self._world.stop()


class VirtualSMBus:
    """Implements the methods of ``smbus2.SMBus`` on an emulated bus. Errors are OSError, as from the kernel."""

    def __init__(self, bus: I2cBus) -> None:
        self._bus = bus

    def _transfer(self, address: int, ops: Iterable[I2cOp]) -> bytes:
        try:
            return self._bus.transfer(address, list(ops))
        except I2cNack as error:
            code = errno.ENXIO if error.kind is ErrorKind.NACK_ADDRESS else errno.EREMOTEIO
            raise OSError(code, str(error)) from error
        except BusError as error:
            raise OSError(errno.EIO, str(error)) from error

    def write_quick(self, i2c_addr: int, force: bool | None = None) -> None:
        self._transfer(i2c_addr, [I2cWrite(b"")])

    def read_byte(self, i2c_addr: int, force: bool | None = None) -> int:
        return self._transfer(i2c_addr, [I2cRead(1)])[0]

    def write_byte(self, i2c_addr: int, value: int, force: bool | None = None) -> None:
        self._transfer(i2c_addr, [I2cWrite(bytes((value,)))])

    def read_byte_data(self, i2c_addr: int, register: int, force: bool | None = None) -> int:
        return self.read_i2c_block_data(i2c_addr, register, 1)[0]

    def write_byte_data(self, i2c_addr: int, register: int, value: int, force: bool | None = None) -> None:
        self.write_i2c_block_data(i2c_addr, register, [value])

    def read_word_data(self, i2c_addr: int, register: int, force: bool | None = None) -> int:
        low, high = self.read_i2c_block_data(i2c_addr, register, 2)
        return low | high << 8

    def write_word_data(self, i2c_addr: int, register: int, value: int, force: bool | None = None) -> None:
        self.write_i2c_block_data(i2c_addr, register, [value & 0xFF, value >> 8])

    def read_i2c_block_data(self, i2c_addr: int, register: int, length: int, force: bool | None = None) -> list[int]:
        return list(self._transfer(i2c_addr, [I2cWrite(bytes((register,))), I2cRead(length)]))

    def write_i2c_block_data(
        self, i2c_addr: int, register: int, data: Iterable[int], force: bool | None = None
    ) -> None:
        self._transfer(i2c_addr, [I2cWrite(bytes((register, *data)))])

    def i2c_rdwr(self, *messages: Any) -> None:
        """Do one transfer of ``smbus2.i2c_msg`` messages to one address."""
        if len({message.addr for message in messages}) != 1:
            raise OSError(errno.EOPNOTSUPP, "the emulated bus does one address per transfer")
        ops = [I2cRead(m.len) if m.flags & 1 else I2cWrite(bytes(m.buf[: m.len])) for m in messages]
        data = self._transfer(messages[0].addr, ops)
        for message in messages:
            if message.flags & 1:
                for i in range(message.len):
                    message.buf[i] = data[i : i + 1]
                data = data[message.len :]

    def close(self) -> None:
        self._bus.close()

    def __enter__(self) -> VirtualSMBus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class VirtualSerial:
    """The methods of ``serial.Serial`` that programs use; waiting moves the bench's clock."""

    def __init__(self, port: SerialPort, timeout: float | None) -> None:
        self._port = port
        self.timeout = timeout
        self._held = bytearray()
        self._buffer = memoryview(bytearray(READ_BYTES))

    def _take(self, timeout_s: float) -> bool:
        n = self._port.read_into(self._buffer, timeout_s)
        self._held += self._buffer[:n]
        return n > 0

    @property
    def in_waiting(self) -> int:
        while self._take(0.0):
            pass
        return len(self._held)

    def read(self, size: int = 1) -> bytes:
        """Return ``size`` bytes, or fewer when nothing more came within ``timeout``."""
        while len(self._held) < size and self._take(self._patience()):
            pass
        return self._give(size)

    def read_until(self, expected: bytes = b"\n", size: int | None = None) -> bytes:
        """Return everything up to ``expected``, or what came before nothing more did within ``timeout``."""
        while expected not in self._held and (size is None or len(self._held) < size):
            if not self._take(self._patience()):
                return self._give(len(self._held))
        end = self._held.find(expected)
        n = len(self._held) if end < 0 else end + len(expected)
        return self._give(n if size is None else min(n, size))

    def readline(self) -> bytes:
        return self.read_until(b"\n")

    def read_all(self) -> bytes:
        return self._give(self.in_waiting)

    def write(self, data: bytes) -> int:
        self._port.write(bytes(data), 1.0)
        return len(data)

    def reset_input_buffer(self) -> None:
        self._give(self.in_waiting)

    def flush(self) -> None:
        """Do nothing: what is written has been sent."""

    def close(self) -> None:
        self._port.close()

    def __enter__(self) -> VirtualSerial:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _patience(self) -> float:
        return 3600.0 if self.timeout is None else self.timeout

    def _give(self, n: int) -> bytes:
        data = bytes(self._held[:n])
        del self._held[:n]
        return data


def open_named(bench: str | Path) -> VirtualBench:
    """Open a bench file, or one that ships by its name. Raises ``BenchError``."""
    from tools.emulate.shipped import bench_file

    file = load_bench(bench_file(str(bench)))
    return VirtualBench(file.description, file.path.parent)


def open_part(part: str, *, emulation: dict[str, Any] | None = None, **options: Any) -> VirtualBench:
    """Emulate one part alone on a bus of its own, on a body that rests. Raises ``BenchError`` for what it cannot be.

    ``options`` are the keys of the device's entry in a bench file; its channels are named after ``part``. ``emulation``
    is the bench's table of that name, for example ``{"imu": {"mpu6050": {"errors": 0.0}}}``.
    """
    driver = DRIVERS.get(part, part)
    kind = "serial" if driver in SERIAL else "can" if driver in CAN else "i2c"
    if driver == "di4108":
        options = {"rate_hz": 1000, "channels": list(range(8)), "range_V": 10.0, **options}
    table = {
        "format": 1,
        "name": part,
        "emulation": {
            "provider": "sim_devices.register:provider",
            "endoscope": {"scenario": "rest"},
            **(emulation or {}),
        },
        "bus": {"bus0": {"kind": kind, "uri": "sim://bus0"}},
        "device": {part: {"driver": driver, "bus": "bus0", **options}},
    }
    return VirtualBench(validate_table(BenchDescription, table, part), Path())
