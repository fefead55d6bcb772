"""Declares the registers of the MPU-6050.

Source: InvenSense RM-MPU-6000A-00 rev 4.2 (section and page with each register); offset registers from the
application note "MPU Hardware Offset Registers" rev 1.0. That note gives the accelerometer offsets in 8 g format
(4096 counts per g); InvenSense's Motion Driver 6.12 writes them in 16 g format (2048 counts per g, its comment: "bug
fix from +-8G") and RM-MPU-9250A rev 1.6, registers 119 to 126, has "+-16 g, 15 bit, 0.98 mg steps" for the same block.
2048 it is; bit 0 belongs to the factory's temperature compensation and is kept.
"""

from __future__ import annotations

from drivers.imu.registers import Register

XA_OFFS_H = Register("XA_OFFS_H", 0x06, None, "rw", "offset note: accelerometer, factory trim after reset")
SELF_TEST_X = Register("SELF_TEST_X", 0x0D, None, "rw", "4.1, p. 9")
XG_OFFS_USRH = Register("XG_OFFS_USRH", 0x13, 0x00, "rw", "offset note: gyro")
SMPLRT_DIV = Register("SMPLRT_DIV", 0x19, 0x00, "rw", "4.2, p. 11")
CONFIG = Register("CONFIG", 0x1A, 0x00, "rw", "4.3, p. 13")
GYRO_CONFIG = Register("GYRO_CONFIG", 0x1B, 0x00, "rw", "4.4, p. 14")
ACCEL_CONFIG = Register("ACCEL_CONFIG", 0x1C, 0x00, "rw", "4.5, p. 15")
FIFO_EN = Register("FIFO_EN", 0x23, 0x00, "rw", "4.6, p. 16")
INT_ENABLE = Register("INT_ENABLE", 0x38, 0x00, "rw", "4.15, p. 27")
INT_STATUS = Register("INT_STATUS", 0x3A, 0x00, "r", "4.16, p. 28: cleared by reading")
ACCEL_XOUT_H = Register("ACCEL_XOUT_H", 0x3B, 0x00, "r", "4.17, p. 29")
USER_CTRL = Register("USER_CTRL", 0x6A, 0x00, "rw", "4.27, p. 38")
PWR_MGMT_1 = Register("PWR_MGMT_1", 0x6B, 0x40, "rw", "4.28, p. 40: asleep after reset")
PWR_MGMT_2 = Register("PWR_MGMT_2", 0x6C, 0x00, "rw", "4.29, p. 42")
FIFO_COUNTH = Register("FIFO_COUNTH", 0x72, 0x00, "r", "4.30, p. 43")
FIFO_R_W = Register("FIFO_R_W", 0x74, None, "rw", "4.31, p. 44")
WHO_AM_I = Register("WHO_AM_I", 0x75, 0x68, "r", "4.32, p. 45: 0x68 at either address")

DLPF_CFG = CONFIG.bits(2, 0)
GYRO_SELF_TEST = GYRO_CONFIG.bits(7, 5)
FS_SEL = GYRO_CONFIG.bits(4, 3)
ACCEL_SELF_TEST = ACCEL_CONFIG.bits(7, 5)
AFS_SEL = ACCEL_CONFIG.bits(4, 3)
FIFO_SENSORS = FIFO_EN.bits(7, 3)  # temperature, gyro x y z, accelerometer
FIFO_OFLOW_EN = INT_ENABLE.bits(4)
DATA_RDY_EN = INT_ENABLE.bits(0)
FIFO_OFLOW_INT = INT_STATUS.bits(4)
DATA_RDY_INT = INT_STATUS.bits(0)
FIFO_ON = USER_CTRL.bits(6)
FIFO_RESET = USER_CTRL.bits(2)
DEVICE_RESET = PWR_MGMT_1.bits(7)
SLEEP = PWR_MGMT_1.bits(6)
CYCLE = PWR_MGMT_1.bits(5)
TEMP_DIS = PWR_MGMT_1.bits(3)
CLKSEL = PWR_MGMT_1.bits(2, 0)
LP_WAKE_CTRL = PWR_MGMT_2.bits(7, 6)
GYRO_STANDBY = PWR_MGMT_2.bits(2, 0)

ACCEL_CODES = {2.0: 0, 4.0: 1, 8.0: 2, 16.0: 3}  # 4.5: counts per g 16384, 8192, 4096, 2048
GYRO_CODES = {250.0: 0, 500.0: 1, 1000.0: 2, 2000.0: 3}
GYRO_LSB_PER_DPS = {250.0: 131.0, 500.0: 65.5, 1000.0: 32.8, 2000.0: 16.4}  # 4.19, p. 31
DLPF = {1: (184.0, 188.0), 2: (94.0, 98.0), 3: (44.0, 42.0), 4: (21.0, 20.0), 5: (10.0, 10.0), 6: (5.0, 5.0)}
"""4.3, p. 13: accelerometer and gyro bandwidth in Hz. Setting 0 is left out: it samples the gyro at 8 kHz."""
