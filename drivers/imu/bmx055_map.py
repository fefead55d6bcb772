"""Declares the registers of the three dies of a BMX055.

Source: Bosch BST-BMX055-DS000 rev 1.1, "Register description accelerometer", "... gyroscope", "... magnetometer"
(ACC, GYR and MAG in the sources below). The trim block of the magnetometer is "reserved" there; its layout is
that of Bosch's BMM050 API, to which the data sheet refers.
"""

from __future__ import annotations

from drivers.imu.registers import Register

ACC_CHIPID = Register("BGW_CHIPID", 0x00, 0xFA, "r", "ACC 0x00")
ACC_DATA = Register("ACCD_X_LSB", 0x02, None, "r", "ACC 0x02-0x07: 12 bit, left-aligned")
ACC_TEMP = Register("ACCD_TEMP", 0x08, None, "r", "ACC 0x08: 0.5 K per count, 23 degC at zero")
ACC_FIFO_STATUS = Register("FIFO_STATUS", 0x0E, 0x00, "r", "ACC 0x0E")
ACC_RANGE = Register("PMU_RANGE", 0x0F, 0x03, "rw", "ACC 0x0F")
ACC_BW = Register("PMU_BW", 0x10, 0x0F, "rw", "ACC 0x10")
ACC_LPW = Register("PMU_LPW", 0x11, 0x00, "rw", "ACC 0x11")
ACC_SOFTRESET = Register("BGW_SOFTRESET", 0x14, 0x00, "w", "ACC 0x14")
ACC_SELF_TEST = Register("PMU_SELF_TEST", 0x32, 0x00, "rw", "ACC 0x32")
ACC_OFFSET_X = Register("OFC_OFFSET_X", 0x38, None, "rw", "ACC 0x38-0x3A: from non-volatile memory")
ACC_FIFO_CONFIG_1 = Register("FIFO_CONFIG_1", 0x3E, 0x00, "rw", "ACC 0x3E: writing empties the FIFO")
ACC_FIFO_DATA = Register("FIFO_DATA", 0x3F, None, "r", "ACC 0x3F")

GYR_CHIPID = Register("CHIP_ID", 0x00, 0x0F, "r", "GYR 0x00")
GYR_FIFO_STATUS = Register("FIFO_STATUS", 0x0E, 0x00, "r", "GYR 0x0E")
GYR_RANGE = Register("RANGE", 0x0F, None, "rw", "GYR 0x0F")
GYR_BW = Register("BW", 0x10, None, "rw", "GYR 0x10")
GYR_LPM1 = Register("LPM1", 0x11, 0x00, "rw", "GYR 0x11")
GYR_SOFTRESET = Register("BGW_SOFTRESET", 0x14, 0x00, "w", "GYR 0x14")
GYR_OFC1 = Register("OFC1", 0x36, None, "rw", "GYR 0x36-0x39: from non-volatile memory")
GYR_TRIM_GP0 = Register("TRIM_GP0", 0x3A, None, "rw", "GYR 0x3A")
GYR_BIST = Register("BIST", 0x3C, None, "rw", "GYR 0x3C")
GYR_FIFO_CONFIG_1 = Register("FIFO_CONFIG_1", 0x3E, 0x00, "rw", "GYR 0x3E: writing empties the FIFO")
GYR_FIFO_DATA = Register("FIFO_DATA", 0x3F, None, "r", "GYR 0x3F")

MAG_CHIPID = Register("CHIP_ID", 0x40, 0x32, "r", "MAG 0x40: only with the power bit set")
MAG_DATA = Register("DATAX_LSB", 0x42, None, "r", "MAG 0x42-0x49")
MAG_POWER = Register("POWER_CONTROL", 0x4B, 0x00, "rw", "MAG 0x4B: suspended after power-up")
MAG_CONTROL = Register("CONTROL", 0x4C, 0x06, "rw", "MAG 0x4C")
MAG_REPXY = Register("REPXY", 0x51, 0x00, "rw", "MAG 0x51")
MAG_TRIM = Register("DIG_X1", 0x5D, None, "r", "BMM050 API: 0x5D-0x71")

SOFT_RESET = 0xB6
ACC_ID = ACC_CHIPID.bits(7, 0)
ACC_RANGE_SEL = ACC_RANGE.bits(3, 0)
ACC_BW_SEL = ACC_BW.bits(4, 0)
ACC_SUSPEND = ACC_LPW.bits(7)
ACC_ST_AMP = ACC_SELF_TEST.bits(4)
ACC_ST_SIGN = ACC_SELF_TEST.bits(2)
ACC_ST_AXIS = ACC_SELF_TEST.bits(1, 0)
ACC_FIFO_MODE = ACC_FIFO_CONFIG_1.bits(7, 6)
GYR_ID = GYR_CHIPID.bits(7, 0)
GYR_RANGE_SEL = GYR_RANGE.bits(2, 0)
GYR_BW_SEL = GYR_BW.bits(3, 0)
GYR_SUSPEND = GYR_LPM1.bits(7)
GYR_OFFSET_LOW = GYR_TRIM_GP0.bits(3, 0)  # x<1:0>, y<0>, z<0>; the upper half is free for the user
BIST_RATE_OK = GYR_BIST.bits(4)
BIST_FAIL = GYR_BIST.bits(2)
BIST_READY = GYR_BIST.bits(1)
BIST_TRIGGER = GYR_BIST.bits(0)
GYR_FIFO_MODE = GYR_FIFO_CONFIG_1.bits(7, 6)
FIFO_OVERRUN, FIFO_FRAMES = 0x80, 0x7F  # FIFO_STATUS of both dies
STREAM = 0b10  # FIFO_MODE: the oldest frame gives way
MAG_ID = MAG_CHIPID.bits(7, 0)
MAG_ON = MAG_POWER.bits(0)
MAG_RESET = 0x82  # both soft-reset bits of POWER_CONTROL
MAG_RATE = MAG_CONTROL.bits(5, 3)
MAG_MODE = MAG_CONTROL.bits(2, 1)
MAG_ST = MAG_CONTROL.bits(0)
MAG_NORMAL, MAG_SLEEP = 0b00, 0b11

ACCEL_CODES = {2.0: 0b0011, 4.0: 0b0101, 8.0: 0b1000, 16.0: 0b1100}  # 1024, 512, 256, 128 counts per g
ACCEL_RATES = {2 * 7.8125 * 2**i: 8 + i for i in range(8)}  # update time 64 ms .. 0.5 ms; bandwidth is half the rate
GYRO_CODES = {2000.0: 0, 1000.0: 1, 500.0: 2, 250.0: 3, 125.0: 4}
GYRO_LSB_PER_DPS = {2000.0: 16.4, 1000.0: 32.8, 500.0: 65.6, 250.0: 131.2, 125.0: 262.4}
GYRO_FILTERS = {  # rate: {bandwidth: code}
    2000.0: {523.0: 0, 230.0: 1},
    1000.0: {116.0: 2},
    400.0: {47.0: 3},
    200.0: {23.0: 4, 64.0: 6},
    100.0: {12.0: 5, 32.0: 7},
}
MAG_RATES = {10.0: 0, 2.0: 1, 6.0: 2, 8.0: 3, 15.0: 4, 20.0: 5, 25.0: 6, 30.0: 7}
