"""Declares the registers of the LSM6DS3.

Source: STMicroelectronics DocID026899, "Register description" (chapter 9; the section has the register's name).
"""

from __future__ import annotations

from drivers.imu.registers import Register

FIFO_CTRL3 = Register("FIFO_CTRL3", 0x08, 0x00, "rw", "9, FIFO_CTRL3")
FIFO_CTRL5 = Register("FIFO_CTRL5", 0x0A, 0x00, "rw", "9, FIFO_CTRL5")
WHO_AM_I = Register("WHO_AM_I", 0x0F, 0x69, "r", "9, WHO_AM_I")
CTRL1_XL = Register("CTRL1_XL", 0x10, 0x00, "rw", "9, CTRL1_XL: off after reset")
CTRL2_G = Register("CTRL2_G", 0x11, 0x00, "rw", "9, CTRL2_G: off after reset")
CTRL3_C = Register("CTRL3_C", 0x12, 0x04, "rw", "9, CTRL3_C")
CTRL4_C = Register("CTRL4_C", 0x13, 0x00, "rw", "9, CTRL4_C")
CTRL5_C = Register("CTRL5_C", 0x14, 0x00, "rw", "9, CTRL5_C")
CTRL6_C = Register("CTRL6_C", 0x15, 0x00, "rw", "9, CTRL6_C")
CTRL7_G = Register("CTRL7_G", 0x16, 0x00, "rw", "9, CTRL7_G")
STATUS_REG = Register("STATUS_REG", 0x1E, None, "r", "9, STATUS_REG")
FIFO_STATUS1 = Register("FIFO_STATUS1", 0x3A, None, "r", "9, FIFO_STATUS1 .. 4")
FIFO_DATA_OUT_L = Register("FIFO_DATA_OUT_L", 0x3E, None, "r", "9, FIFO_DATA_OUT: the address rolls back to it")

DEC_FIFO_GYRO = FIFO_CTRL3.bits(5, 3)
DEC_FIFO_XL = FIFO_CTRL3.bits(2, 0)
ODR_FIFO = FIFO_CTRL5.bits(6, 3)
FIFO_MODE = FIFO_CTRL5.bits(2, 0)
ODR_XL = CTRL1_XL.bits(7, 4)
FS_XL = CTRL1_XL.bits(3, 2)
BW_XL = CTRL1_XL.bits(1, 0)
ODR_G = CTRL2_G.bits(7, 4)
FS_G = CTRL2_G.bits(3, 2)
FS_125 = CTRL2_G.bits(1)
BDU = CTRL3_C.bits(6)
IF_INC = CTRL3_C.bits(2)
SW_RESET = CTRL3_C.bits(0)
XL_BW_SCAL_ODR = CTRL4_C.bits(7)
ST_G = CTRL5_C.bits(3, 2)
ST_XL = CTRL5_C.bits(1, 0)
XL_HM_MODE = CTRL6_C.bits(4)
G_HM_MODE = CTRL7_G.bits(7)
GDA = STATUS_REG.bits(1)
XLDA = STATUS_REG.bits(0)

BYPASS, CONTINUOUS = 0b000, 0b110  # FIFO_MODE
RATES = {12.5: 1, 26.0: 2, 52.0: 3, 104.0: 4, 208.0: 5, 416.0: 6, 833.0: 7, 1660.0: 8}  # ODR_XL, ODR_G, ODR_FIFO
ACCEL_CODES = {2.0: 0b00, 4.0: 0b10, 8.0: 0b11, 16.0: 0b01}  # FS_XL is not in order
GYRO_CODES = {125.0: 0b00, 250.0: 0b00, 500.0: 0b01, 1000.0: 0b10, 2000.0: 0b11}  # 125 has a bit of its own
ACCEL_MG_PER_LSB = {2.0: 0.061, 4.0: 0.122, 8.0: 0.244, 16.0: 0.488}  # "Mechanical characteristics", LA_So
GYRO_MDPS_PER_LSB = {125.0: 4.375, 250.0: 8.75, 500.0: 17.5, 1000.0: 35.0, 2000.0: 70.0}  # G_So
ACCEL_BANDWIDTHS = {400.0: 0b00, 200.0: 0b01, 100.0: 0b10, 50.0: 0b11}  # BW_XL with XL_BW_SCAL_ODR = 1
