"""An emulated I2C bus as a file that any process opens like ``/dev/i2c-1``: honest to the kernel's ioctl path.

``python -m tests.contract.i2c_fuse unix-i2c:///path/of.sock MOUNT_FOLDER`` mounts a file system with one file,
``i2c-1``, and serves it until it is unmounted or terminated. The kernel hands each ioctl(2) on that file to this
process (FUSE protocol 7.31, spoken directly on /dev/fuse); since the I2C ioctls do not encode their sizes, the
caller's structures are read and written with process_vm_readv/writev. Needs root and /dev/fuse.
Source: Linux uapi fuse.h, i2c.h, i2c-dev.h; process_vm_readv(2). Supported: I2C_SLAVE, I2C_SLAVE_FORCE, I2C_FUNCS,
I2C_RDWR, I2C_SMBUS (quick, byte, byte data, word data, I2C block), I2C_TIMEOUT, I2C_RETRIES, I2C_PEC off.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import signal
import struct
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from hal.backends.unix_i2c import UnixI2c
from hal.errors import ErrorKind, HalError, I2cNack
from hal.types import I2cOp, I2cRead, I2cWrite

Transfer = Callable[[int, Sequence[I2cOp]], bytes]

FILE_NAME = b"i2c-1"
ROOT, FILE = 1, 2
BUFFER_BYTES = 1 << 17
LOOKUP, FORGET, GETATTR, OPEN, STATFS, RELEASE, FLUSH, INIT, OPENDIR, RELEASEDIR = 1, 2, 3, 14, 17, 18, 25, 26, 27, 29
INTERRUPT, DESTROY, IOCTL, BATCH_FORGET = 36, 38, 39, 42
DIRECT_IO = 1
I2C_RETRIES, I2C_TIMEOUT, I2C_SLAVE, I2C_SLAVE_FORCE = 0x0701, 0x0702, 0x0703, 0x0706
I2C_FUNCS, I2C_RDWR, I2C_PEC, I2C_SMBUS = 0x0705, 0x0707, 0x0708, 0x0720
FUNCTIONS = 0x00000001 | 0x00010000 | 0x00060000 | 0x00180000 | 0x00600000 | 0x0C000000
QUICK, BYTE, BYTE_DATA, WORD_DATA, I2C_BLOCK_BROKEN, I2C_BLOCK = 0, 1, 2, 3, 6, 8
MAX_MESSAGES, MAX_LENGTH = 42, 8192
ANSWER_S = 120.0
"""Longest time that a transfer may take: a host may stand still, and a test does not fail for that."""
_HEADER = struct.Struct("<IIQQIIII")
_LIBC = ctypes.CDLL(None, use_errno=True)


class _IoVector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class FuseI2cFile:
    """Serves a file system with one file. ``serve`` returns when it is unmounted."""

    def __init__(self, transfer: Transfer, folder: Path) -> None:
        self._transfer = transfer
        self._folder = folder
        self._address: dict[int, int] = {}  # by file handle
        self._handles = 0
        self._done = 0  # messages of the last I2C_RDWR: its result
        self._fuse = os.open("/dev/fuse", os.O_RDWR)
        options = f"fd={self._fuse},rootmode=40000,user_id=0,group_id=0,allow_other".encode()
        if _LIBC.mount(b"micron-i2c", bytes(folder), b"fuse", 0x6, options):  # MS_NOSUID | MS_NODEV
            code = ctypes.get_errno()
            os.close(self._fuse)
            raise OSError(code, f"cannot mount on {folder}: {os.strerror(code)}; this needs root and /dev/fuse")

    def close(self) -> None:
        """Unmount, even if somebody still has the file open. Idempotent."""
        _LIBC.umount2(bytes(self._folder), 2)  # MNT_DETACH

    def serve(self) -> None:
        while True:
            try:
                request = os.read(self._fuse, BUFFER_BYTES)
            except OSError as error:
                if error.errno in (errno.EINTR, errno.EAGAIN, errno.ENOENT):
                    continue
                return  # ENODEV: unmounted
            _, opcode, unique, node, _, _, pid, _ = _HEADER.unpack_from(request)
            if opcode in (FORGET, BATCH_FORGET, INTERRUPT):
                continue
            try:
                answer, code = self._answer(opcode, node, pid, request[_HEADER.size :]), 0
            except OSError as error:
                answer, code = b"", error.errno or errno.EIO
            # the caller may have been killed meanwhile
            with contextlib.suppress(OSError):
                os.write(self._fuse, struct.pack("<IiQ", 16 + len(answer), -code, unique) + answer)
            if opcode == DESTROY:
                return

    # ------------------------------------------------------------------ file system

    def _answer(self, opcode: int, node: int, pid: int, body: bytes) -> bytes:
        if opcode == INIT:
            ahead = struct.unpack_from("<I", body, 8)[0]
            return struct.pack("<IIIIHHIIHHI28x", 7, 31, ahead, 0, 12, 9, 4096, 1, 1, 0, 0)
        if opcode == LOOKUP:
            if node != ROOT or body.rstrip(b"\0") != FILE_NAME:
                raise OSError(errno.ENOENT, "")
            return struct.pack("<QQQQII", FILE, 0, 1, 1, 0, 0) + self._attributes(FILE)
        if opcode == GETATTR:
            return struct.pack("<QII", 1, 0, 0) + self._attributes(node)
        if opcode in (OPEN, OPENDIR):
            self._handles += 1
            return struct.pack("<QII", self._handles, DIRECT_IO, 0)
        if opcode in (RELEASE, RELEASEDIR):
            self._address.pop(struct.unpack_from("<Q", body)[0], None)
            return b""
        if opcode in (FLUSH, DESTROY):
            return b""
        if opcode == STATFS:
            return bytes(80)
        if opcode == IOCTL:
            handle, _, command, argument, _, _ = struct.unpack_from("<QIIQII", body)
            self._done = 0
            self._ioctl(handle, pid, command, argument)
            return struct.pack("<iIII", self._done, 0, 0, 0)
        raise OSError(errno.ENOSYS, "")

    def _attributes(self, node: int) -> bytes:
        mode = 0o40755 if node == ROOT else 0o100600
        return struct.pack("<6Q10I", node, 0, 0, 0, 0, 0, 0, 0, 0, mode, 1, 0, 0, 0, 4096, 0)

    # ------------------------------------------------------------------ i2c-dev

    def _ioctl(self, handle: int, pid: int, command: int, argument: int) -> None:
        if command in (I2C_SLAVE, I2C_SLAVE_FORCE):
            if argument > 0x7F:
                raise OSError(errno.EINVAL, "")
            self._address[handle] = argument
        elif command == I2C_FUNCS:
            _poke(pid, argument, struct.pack("<Q", FUNCTIONS))
        elif command == I2C_RDWR:
            self._read_write(pid, argument)
        elif command == I2C_SMBUS:
            self._smbus(self._address.get(handle, 0), pid, argument)
        elif command == I2C_PEC:
            if argument:
                raise OSError(errno.EOPNOTSUPP, "")
        elif command not in (I2C_TIMEOUT, I2C_RETRIES):
            raise OSError(errno.ENOTTY, "")

    def _read_write(self, pid: int, argument: int) -> None:
        """Handle I2C_RDWR (struct i2c_rdwr_ioctl_data): pointer to messages of (u16 address, u16 flags, u16 length,
        pointer)."""
        messages_at, n = struct.unpack_from("<QI", _peek(pid, argument, 16))
        if not 1 <= n <= MAX_MESSAGES:
            raise OSError(errno.EINVAL, "")
        table = _peek(pid, messages_at, 16 * n)
        messages = [struct.unpack_from("<HHH2xQ", table, 16 * i) for i in range(n)]
        if any(length > MAX_LENGTH or address != messages[0][0] for address, _, length, _ in messages):
            raise OSError(errno.EINVAL, "")
        ops: list[I2cOp] = []
        for _, flags, length, at in messages:
            ops.append(I2cRead(length) if flags & 1 else I2cWrite(_peek(pid, at, length)))
        data = self._on_bus(messages[0][0], ops)
        for _, flags, length, at in messages:
            if flags & 1:
                _poke(pid, at, data[:length])
                data = data[length:]
        self._done = n

    def _smbus(self, address: int, pid: int, argument: int) -> None:
        """Handle I2C_SMBUS (struct i2c_smbus_ioctl_data): u8 read, u8 command, u32 size, pointer to a 34-byte union."""
        reads, command, size, at = struct.unpack("<BB2xIQ", _peek(pid, argument, 16))
        register = bytes((command,))
        if size == QUICK:
            self._on_bus(address, [I2cRead(0) if reads else I2cWrite(b"")])
        elif size == BYTE:
            if reads:
                _poke(pid, at, self._on_bus(address, [I2cRead(1)]))
            else:
                self._on_bus(address, [I2cWrite(register)])
        elif size in (BYTE_DATA, WORD_DATA, I2C_BLOCK, I2C_BLOCK_BROKEN):
            block = size in (I2C_BLOCK, I2C_BLOCK_BROKEN)
            n = min(32, _peek(pid, at, 1)[0]) if block else 1 if size == BYTE_DATA else 2
            if reads:
                _poke(pid, at + block, self._on_bus(address, [I2cWrite(register), I2cRead(n)]))
            else:
                self._on_bus(address, [I2cWrite(register + _peek(pid, at + block, n))])
        else:
            raise OSError(errno.EOPNOTSUPP, "")

    def _on_bus(self, address: int, ops: Sequence[I2cOp]) -> bytes:
        try:
            return self._transfer(address, ops)
        except I2cNack as error:
            raise OSError(
                errno.ENXIO if error.kind is ErrorKind.NACK_ADDRESS else errno.EREMOTEIO, str(error)
            ) from error
        except HalError as error:
            raise OSError(errno.EIO, str(error)) from error


def _move(call: Callable[..., int], pid: int, address: int, buffer: ctypes.Array[ctypes.c_char], n: int) -> None:
    local, remote = _IoVector(ctypes.addressof(buffer), n), _IoVector(address, n)
    if n and call(pid, ctypes.byref(local), 1, ctypes.byref(remote), 1, 0) != n:
        raise OSError(errno.EFAULT, "")


def _peek(pid: int, address: int, n: int) -> bytes:
    buffer = ctypes.create_string_buffer(max(1, n))
    _move(_LIBC.process_vm_readv, pid, address, buffer, n)
    return buffer.raw[:n]


def _poke(pid: int, address: int, data: bytes) -> None:
    buffer = ctypes.create_string_buffer(data, max(1, len(data)))
    _move(_LIBC.process_vm_writev, pid, address, buffer, len(data))


def main(argv: list[str]) -> int:
    try:
        bus = UnixI2c(argv[0].removeprefix("unix-i2c://"), timeout_s=ANSWER_S)
        mounted = FuseI2cFile(bus.transfer, Path(argv[1]))
    except (OSError, HalError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    _LIBC.prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG: no mount is left behind
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    try:
        mounted.serve()
    finally:
        mounted.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
