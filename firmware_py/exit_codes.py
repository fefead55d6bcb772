"""Exit codes of every program of the project (contracts/commands.md)."""

from __future__ import annotations

from enum import IntEnum

from hal.errors import BenchError, DeviceNotFound, HalError, OpenFailed


class Exit(IntEnum):
    """Names the exit statuses of a program."""

    DONE = 0
    FAILED = 1
    BAD_INPUT = 2
    DATA_LOST = 3
    DEVICE_MISSING = 4
    HOST_UNFIT = 5
    INTERRUPTED = 130


def exit_code_of(error: HalError) -> Exit:
    """Return the exit code that an error stands for."""
    match error:
        case BenchError():
            return Exit.BAD_INPUT
        case DeviceNotFound() | OpenFailed():
            return Exit.DEVICE_MISSING
        case _:
            return Exit.FAILED
