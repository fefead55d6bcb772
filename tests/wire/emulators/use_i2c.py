"""A program that knows smbus2 and /dev/i2c-1; prints what it saw as JSON."""

import fcntl
import json
import os
import time

from smbus2 import SMBus, i2c_msg

ABSENT = 0x33
seen: dict[str, object] = {"exists": [os.path.exists(f"/dev/i2c-{n}") for n in (1, 77)]}
with SMBus(1) as bus:
    seen["functions"] = int(bus.funcs)
    bus.write_byte_data(0x68, 0x6B, 0x00)
    seen["who"] = bus.read_byte_data(0x68, 0x75)
    seen["config"] = bus.read_i2c_block_data(0x48, 0x01, 2)
    seen["word"] = bus.read_word_data(0x48, 0x01)  # the low byte comes first
    bus.write_i2c_block_data(0x0C, 0x31, [0x40, 0x00])
    write, read = i2c_msg.write(0x0C, [0x01]), i2c_msg.read(0x0C, 2)
    bus.i2c_rdwr(write, read)
    seen["dac"] = list(read)
    bus.write_byte(0x48, 0x01)
    seen["byte"] = bus.read_byte(0x48)
    errors = {}
    for name, call in {
        "absent": lambda: bus.read_byte(ABSENT),
        "quick": lambda: bus.write_quick(ABSENT),
        "block_read": lambda: bus.read_block_data(0x48, 1),
        "two_addresses": lambda: bus.i2c_rdwr(i2c_msg.write(0x48, [1]), i2c_msg.read(0x0C, 1)),
    }.items():
        try:
            call()
        except OSError as error:
            errors[name] = error.errno
    seen["errors"] = errors
    bus.write_quick(0x68)
    began = time.monotonic()
    for _ in range(50):
        bus.i2c_rdwr(i2c_msg.write(0x0C, [0x00] * 30))
    seen["took_s"] = time.monotonic() - began
# the file itself, as C programs and Adafruit_PureIO use it
with open("/dev/i2c-1", "r+b", buffering=0) as device:
    fcntl.ioctl(device.fileno(), 0x0703, 0x48)
    seen["written"] = device.write(b"\x01")
    seen["read"] = list(device.read(2))
try:
    SMBus(77)
except OSError as error:
    seen["no_bus"] = error.errno
print(json.dumps(seen))
