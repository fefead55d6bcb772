"""Loads the nidaqmx package, if it is installed, and translates its errors."""

from __future__ import annotations

import importlib
from typing import Any, Literal

from hal.errors import BenchError, BusError, DeviceNotFound, Disconnected, HalError, HalTimeout, Overrun, WrongDevice

# nidaqmx.error_codes.DAQmxErrors
NOT_YET_AVAILABLE = -200284
OVERRUN_CODES = {-200279, -200222}  # samples no longer available, acquisition stopped before overwriting
GONE_CODES = {-201003, -88710, -50405, -50103}  # cannot be accessed, aborted, reserved by another program
UNKNOWN_DEVICE = -200220


def load() -> Any:
    """Return the package. ``DeviceNotFound`` says how to install it."""
    try:
        for part in ("constants", "errors", "stream_readers", "stream_writers", "system"):
            importlib.import_module(f"nidaqmx.{part}")
        return importlib.import_module("nidaqmx")
    except ImportError as error:
        raise DeviceNotFound(
            "the package 'nidaqmx' is not installed: uv pip install -e '.[ni]' in the project's folder"
        ) from error


def identify_card(nidaqmx: Any, device: str, name: str, direction: Literal["ai", "ao"], highest: int) -> str:
    """Return product, serial number and number of channels of card ``device``, as NI's driver reports them.

    ``highest`` is the highest channel of ``direction`` that the bench uses. Raises ``WrongDevice`` for a card without
    it, and ``BenchError`` when no card has this name.
    """
    try:
        card = nidaqmx.system.Device(device)
        product, serial = str(card.product_type), int(card.serial_num)
        channels = len(getattr(card, f"{direction}_physical_chans"))
        simulated = ", simulated by NI-DAQmx" if card.is_simulated else ""
    except nidaqmx.errors.DaqNotFoundError as error:
        raise _no_driver(name) from error
    except nidaqmx.errors.DaqError as error:
        raise translated(error, name) from error
    if highest >= channels:
        raise WrongDevice(
            f"{device} is an NI {product} with {channels} {direction} channels, the bench uses {direction}{highest}",
            device=name,
        )
    return f"NI {product} {device}, serial number {serial:X}, {channels} {direction} channels{simulated}"


def new_task(nidaqmx: Any, name: str) -> Any:
    """Return an empty task. Raises ``DeviceNotFound`` when NI's driver is missing."""
    try:
        return nidaqmx.Task()
    except nidaqmx.errors.DaqNotFoundError as error:
        raise _no_driver(name) from error


def _no_driver(name: str) -> DeviceNotFound:
    return DeviceNotFound(
        "NI's driver NI-DAQmx is not installed on this machine: get it from NI, then run 'micron doctor'", device=name
    )


def translated(error: Any, name: str, lost: int = 0) -> HalError:
    """Return the ``HalError`` that stands for a ``DaqError``."""
    code = int(error.error_code)
    text = str(error).strip().splitlines()[0]
    if code == NOT_YET_AVAILABLE:
        return HalTimeout(text, device=name)
    if code in OVERRUN_CODES:
        return Overrun(f"the NI input buffer overflowed because the host did not read: {text}", device=name, lost=lost)
    if code == UNKNOWN_DEVICE:
        return BenchError(f"no NI device of this name: {text}", device=name)
    if code in GONE_CODES:
        return Disconnected(text, device=name)
    return BusError(text, device=name)
