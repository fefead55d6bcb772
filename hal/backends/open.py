"""Open a port from its URI. Only the URI says which adapter is used, and so whether the hardware is real."""

from __future__ import annotations

from collections.abc import Callable
from urllib.parse import parse_qsl, unquote, urlsplit

from hal.clock import MonotonicClock
from hal.contracts import CanBus, Clock, I2cBus, SerialPort
from hal.errors import BenchError

SERIAL_FORMS = ("serial:///dev/ttyACM0?baud=115200",)
I2C_FORMS = ("linux-i2c://1", "unix-i2c:///path/to/socket")
CAN_FORMS = (
    "socketcan://can0",
    "slcan:///dev/ttyUSB0",
    "udp-multicast://239.74.163.2:43113",
    "virtual-can://name",
    "unix-can:///path/to/socket",
)


def open_serial(uri: str, baud: int = 115200) -> SerialPort:
    """Open a serial port; a ``?baud=`` in the URI wins.

    Raises ``BenchError`` for a URI we do not understand and ``DeviceNotFound`` if the port is not there.
    """
    scheme, host, path, options = _split(uri, SERIAL_FORMS)
    if scheme != "serial":
        raise _unknown(uri, SERIAL_FORMS)
    _need(not host and path, uri, SERIAL_FORMS)
    baud = _integer(options.pop("baud", str(baud)), "baud", uri)
    _no_more(options, uri)
    from hal.backends.pyserial_port import PyserialPort

    return PyserialPort(path, baud)


def open_i2c(uri: str, speed_hz: int = 400_000, *, exclusive: bool = True) -> I2cBus:
    """Open an I2C bus. A Linux bus has the speed its device tree says; ``speed_hz`` is then for reports.

    A Linux bus is locked against other programs of ours; ``exclusive`` off is for the guardian, which stands by on the
    firmware's bus.
    """
    scheme, host, path, options = _split(uri, I2C_FORMS)
    _no_more(options, uri)
    if scheme == "linux-i2c":
        _need(bool(host) != bool(path), uri, I2C_FORMS)
        from hal.backends.smbus2_i2c import Smbus2I2c

        return Smbus2I2c(_integer(host, "bus number", uri) if host else path, speed_hz, exclusive=exclusive)
    if scheme == "unix-i2c":
        _need(not host and path, uri, I2C_FORMS)
        from hal.backends.unix_i2c import UnixI2c

        return UnixI2c(path, speed_hz)
    raise _unknown(uri, I2C_FORMS)


def open_can(uri: str, bitrate: int = 500_000, clock: Clock | None = None) -> CanBus:
    """Open a CAN bus. Reception times are on ``clock`` (the machine's monotonic clock without one)."""
    scheme, host, path, options = _split(uri, CAN_FORMS)
    openers: dict[str, Callable[[], CanBus]] = {}
    from hal.backends import python_can
    from hal.backends.unix_can import UnixCan

    bench = clock or MonotonicClock()
    openers["socketcan"] = lambda: python_can.open_socketcan(host, bench)
    openers["virtual-can"] = lambda: python_can.open_virtual(host, bench)
    openers["slcan"] = lambda: python_can.open_slcan(
        path, bitrate, bench, wait_s=float(_integer(options.pop("wait_s", "0"), "wait_s", uri))
    )
    openers["udp-multicast"] = lambda: python_can.open_udp_multicast(*_group(host, uri), bench)
    openers["unix-can"] = lambda: UnixCan(path, bench)
    if scheme not in openers:
        raise _unknown(uri, CAN_FORMS)
    if scheme != "slcan":
        _no_more(options, uri)
    _need(path if scheme in ("slcan", "unix-can") else host, uri, CAN_FORMS)
    return openers[scheme]()


def _split(uri: str, forms: tuple[str, ...]) -> tuple[str, str, str, dict[str, str]]:
    parts = urlsplit(uri)
    if "://" not in uri:
        raise _unknown(uri, forms)
    return parts.scheme, parts.netloc, unquote(parts.path), dict(parse_qsl(parts.query))


def _group(host: str, uri: str) -> tuple[str, int]:
    group, colon, port = host.rpartition(":")
    _need(colon and group, uri, CAN_FORMS)
    return group.strip("[]"), _integer(port, "port", uri)


def _unknown(uri: str, forms: tuple[str, ...]) -> BenchError:
    return BenchError(f"uri {uri!r} is not understood; write it like {' or '.join(forms)}")


def _need(good: object, uri: str, forms: tuple[str, ...]) -> None:
    if not good:
        raise _unknown(uri, forms)


def _integer(text: str, what: str, uri: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise BenchError(f"{what} {text!r} in uri {uri!r} is not a whole number") from None


def _no_more(options: dict[str, str], uri: str) -> None:
    if options:
        raise BenchError(f"unknown option {', '.join(sorted(options))} in uri {uri!r}")
