"""Makes inertial sensors from a bench file, and defines their options, addresses and bus load.

The bus load counts the transactions of the drivers (``hal.wire_bits``).
"""

from __future__ import annotations

from collections import defaultdict
from typing import Annotated, Any, Literal

from pydantic import Field

from drivers.imu import lsm6ds3_map
from drivers.imu.base import Imu, pick_rate
from drivers.imu.bmx055 import Bmx055
from drivers.imu.bmx055_addresses import check_addresses
from drivers.imu.lsm6ds3 import Lsm6ds3
from drivers.imu.mpu6050 import Mpu6050
from drivers.options import Options, one_of
from drivers.polling import poll_divider
from drivers.registry import Driver, Load, Traffic
from hal.bench import BenchDescription, DeviceSpec
from hal.contracts import Clock, I2cBus
from hal.errors import BenchError
from hal.types import I2cRead, I2cWrite
from hal.wire_bits import i2c_bits


class ImuOptions(Options):
    """Holds the keys of every chip. ``rate_hz`` is the rate of readings, ``drain_hz`` that of the FIFO in mode
    "fifo"."""

    rate_hz: float = Field(default=100.0, gt=0)
    accel_range_g: Annotated[float, one_of(2, 4, 8, 16)] = 2.0
    gyro_range_dps: Annotated[float, one_of(125, 250, 500, 1000, 2000)] = 250.0
    bandwidth_hz: float | None = Field(default=None, gt=0)
    mode: Literal["data ready", "fifo"] = "data ready"
    drain_hz: float = Field(default=50.0, gt=0, le=1000)


class Mpu6050Options(ImuOptions):
    """Holds the keys of an MPU-6050. AD0 selects address 0x68 or 0x69."""

    rate_hz: float = Field(default=100.0, ge=3.91, le=1000)
    gyro_range_dps: Annotated[float, one_of(250, 500, 1000, 2000)] = 250.0


class Lsm6ds3Options(ImuOptions):
    """Holds the keys of an LSM6DS3. SA0 selects address 0x6A or 0x6B. Rates: 12.5, 26, 52, 104, 208, 416, 833, 1660
    Hz."""

    rate_hz: float = Field(default=104.0, gt=0, le=1660)


class Bmx055Options(ImuOptions):
    """Holds the keys of a BMX055. ``address`` is the accelerometer's. ``mag_rate_hz`` = 0 leaves the magnetometer
    off."""

    rate_hz: float = Field(default=100.0, gt=0, le=2000)
    gyro_address: int = 0x68
    mag_address: int = 0x10
    mag_rate_hz: Annotated[float, one_of(0, 2, 6, 8, 10, 15, 20, 25, 30)] = 10.0


IMU_OPTIONS: dict[str, type[ImuOptions]] = {
    "mpu6050": Mpu6050Options,
    "lsm6ds3": Lsm6ds3Options,
    "bmx055": Bmx055Options,
}
MAX_BUS_HZ = 400_000  # I2C fast mode, in the data sheets of all three
LOWEST_ADDRESS = {"mpu6050": 0x68, "lsm6ds3": 0x6A, "bmx055": 0x18}  # the other one is one higher


def make_imu(spec: DeviceSpec, options: ImuOptions, bus: I2cBus, clock: Clock, name: str) -> Imu:
    """Return the driver of a bench entry. It sends nothing; ``open_imu`` also sets the chip up."""
    address = spec.address or LOWEST_ADDRESS[spec.driver]
    match options:
        case Mpu6050Options():
            return Mpu6050(bus, clock, address, name=name)
        case Lsm6ds3Options():
            return Lsm6ds3(bus, clock, address, name=name)
        case Bmx055Options():
            return Bmx055(
                bus,
                clock,
                address,
                gyro_address=options.gyro_address,
                mag_address=options.mag_address,
                mag_rate_hz=options.mag_rate_hz,
                name=name,
            )
        case _:
            raise BenchError(f"'{spec.driver}' is no inertial sensor", device=name)


def open_imu(spec: DeviceSpec, options: ImuOptions, bus: I2cBus, clock: Clock, name: str) -> Imu:
    """Make, probe, reset and configure the sensor of a bench entry. The caller calls ``start``."""
    imu = make_imu(spec, options, bus, clock, name)
    imu.probe()
    imu.reset()
    imu.configure(
        rate_hz=options.rate_hz,
        accel_range_g=options.accel_range_g,
        gyro_range_dps=options.gyro_range_dps,
        bandwidth_hz=options.bandwidth_hz,
    )
    return imu


def address_problems(description: BenchDescription, options: dict[str, Any]) -> list[str]:
    """Return a message for each address that two parts claim on one bus, with the strap that changes one, and for each
    impossible address."""
    claims: dict[tuple[str, int], list[tuple[str, str]]] = defaultdict(list)
    problems: list[str] = []
    for name, spec in description.device.items():
        if spec.bus is None:
            continue
        option = options[name]
        if isinstance(option, ImuOptions):
            if spec.address is None:
                lowest = LOWEST_ADDRESS[spec.driver]
                problems.append(f"[device.{name}.address] is missing; it is 0x{lowest:02x} or 0x{lowest + 1:02x}")
                continue
            try:
                claimed = _claims(option, spec.address, name)
            except BenchError as error:
                problems.append(f"[device.{name}] {error}")
                continue
            for address, who, remedy in claimed:
                claims[spec.bus, address].append((who, remedy))
        elif spec.address is not None:
            claims[spec.bus, spec.address].append((f"'{name}' ({spec.driver})", ""))
    for (bus, address), users in claims.items():
        if len(users) > 1:
            who = " and ".join(user for user, _ in users)
            remedies = ", or ".join([remedy for _, remedy in users if remedy] + ["put one of them on another bus"])
            problems.append(f"0x{address:02x} on '{bus}' is claimed by {who}; {remedies}")
    return problems


def _claims(option: ImuOptions, address: int, name: str) -> list[tuple[int, str, str]]:
    """Return for every die its address, its name and the key that changes the address."""
    if isinstance(option, Bmx055Options):
        check_addresses(address, option.gyro_address, option.mag_address, name)
        gyro, mag = option.gyro_address ^ 1, option.mag_address ^ 1
        sdo2 = f"tie SDO2 of '{name}' {_level(gyro)} (gyro_address = 0x{gyro:02x}, mag_address = 0x{mag:02x})"
        claims = [
            (address, f"the accelerometer of '{name}' (BMX055)", _strap("SDO1", name, address)),
            (option.gyro_address, f"the gyro of '{name}' (BMX055)", sdo2),
        ]
        if option.mag_rate_hz:
            claims.append((option.mag_address, f"the magnetometer of '{name}' (BMX055)", sdo2))
        return claims
    part, pin = ("MPU6050", "AD0") if isinstance(option, Mpu6050Options) else ("LSM6DS3", "SA0")
    lowest = LOWEST_ADDRESS["mpu6050" if part == "MPU6050" else "lsm6ds3"]
    if address not in (lowest, lowest + 1):
        raise BenchError(f"address 0x{address:02x} is not 0x{lowest:02x} or 0x{lowest + 1:02x}, which {pin} selects")
    return [(address, f"'{name}' ({part})", _strap(pin, name, address))]


def _level(address: int) -> str:
    return "high" if address & 1 else "low"


def _strap(pin: str, name: str, address: int) -> str:
    return f"tie {pin} of '{name}' {_level(address ^ 1)} (address = 0x{address ^ 1:02x})"


def transactions(option: ImuOptions, name: str) -> list[tuple[str, int, float]]:
    """List the periodic transactions of one sensor's driver as (name, bits on the wire, times per second)."""
    match option:
        case Mpu6050Options():
            per_sample, per_drain, per_frame, frames_hz = (
                _bits(15),
                _bits(1) + _bits(2) + _bits(0),
                9 * 14,
                option.rate_hz,
            )
        case Lsm6ds3Options():
            per_sample, per_drain, per_frame = _bits(16), _bits(4) + _bits(0) + _bits(4), 9 * 12
            frames_hz, _ = pick_rate(option.rate_hz, lsm6ds3_map.RATES, name)
        case _:
            per_sample = _bits(7) + _bits(6) + _bits(1) + _bits(6)
            per_drain, per_frame, frames_hz = _bits(7) + _bits(1) + 2 * _bits(0), 9 * 12, option.rate_hz
    if option.mode == "data ready":
        uses = [("sample", per_sample, option.rate_hz)]
    else:
        uses = [("emptying of the FIFO", per_drain, option.drain_hz), ("frame", per_frame, frames_hz)]
    if isinstance(option, Bmx055Options) and option.mag_rate_hz:
        uses.append(("field", _bits(8), option.mag_rate_hz))
    return uses


def _bits(n: int) -> int:
    """Return the bits on the wire of reading ``n`` bytes, starting at a register."""
    return i2c_bits((I2cWrite(bytes(1)), I2cRead(n)))


def _traffic(load: Load) -> list[Traffic]:
    option, tick_hz = load.options, load.tick_hz
    looks_hz = {"sample": tick_hz / poll_divider(option.rate_hz, tick_hz)}
    return [
        Traffic(what, bits, max(per_s, looks_hz.get(what, 0.0)))
        for what, bits, per_s in transactions(option, load.name)
    ]


MPU6050, LSM6DS3, BMX055 = (
    Driver(options, role="inertial", traffic=_traffic, max_bus_hz=MAX_BUS_HZ) for options in IMU_OPTIONS.values()
)
