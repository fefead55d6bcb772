"""micron emulate one_chip.toml -- python one_chip.py"""

from smbus2 import SMBus

with SMBus(1) as bus:
    bus.write_byte_data(0x68, 0x6B, 0)  # PWR_MGMT_1: wake up
    print(f"WHO_AM_I 0x{bus.read_byte_data(0x68, 0x75):02X}")
