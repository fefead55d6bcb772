"""Transfers of compiled code through ``/dev/i2c-1``, as a compiled loop makes them; prints what came back."""

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3]))

from hal.backends.smbus2_i2c import Smbus2I2c
from hal.i2c_kernels import REPLY_SIZE, new_transfer, transfer, write_at
from hal.types import I2cRead, I2cWrite

DAC = 0x0C
bus = Smbus2I2c(1, exclusive=False)
write_d, read_d = I2cWrite(bytes((0x18, 0, 0))), (I2cWrite(b"\x08"), I2cRead(2))  # AD5696R: input register of D
both = new_transfer(bus.CARRIER, DAC, (write_d, *read_d))
read = []
for code in (0x1234, 0xFEDC):
    at = write_at((write_d, *read_d), 0, 1)
    both.request[at], both.request[at + 1] = code >> 8, code & 0xFF
    assert transfer(both, bus.fileno()) == 0
    read.append(both.reply[REPLY_SIZE:].tobytes().hex())
absent = new_transfer(bus.CARRIER, 0x33, (I2cWrite(b"\x00"),))
failure = bus.failure(transfer(absent, bus.fileno()), 0x33)
print(json.dumps({"read": read, "absent": [type(failure).__name__, str(failure)]}))
