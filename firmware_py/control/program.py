"""Plays a program of voltages on the outputs in place of the compensation: ``micron run --manual``.

A program is a TOML file: ``format = 1``, ``rate_hz``, ``stacks`` (1 to 3) and ``volts``, one per sample for all stacks,
or a list of them for each. It is checked against the outputs' limits before anything moves; before and after it the
outputs are at neutral.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from firmware_py.actuation.config import ActuationConfig
from firmware_py.control.manual import RETURN_V_PER_S, ManualDrive
from hal.errors import BenchError
from hal.toml_file import parse_toml, read_text

LONGEST_S = 3600.0
APPROACH_S = 0.5
"""Time at neutral before the program, and longest way to its first value and back."""


@dataclass(frozen=True)
class Program:
    """``volts`` of ``stacks`` (0 to 2) at ``rate_hz``: (n,) the same for all, or (n, stacks)."""

    volts: NDArray[np.float64]
    stacks: tuple[int, ...]
    rate_hz: float

    @property
    def seconds(self) -> float:
        """Duration with the way to its first value and back to neutral."""
        return len(self.volts) / self.rate_hz + 4.0 * APPROACH_S


def load_program(path: Path) -> Program:
    """Read a program. Raises ``BenchError`` that says what is wrong with it."""
    text = read_text(path, "name a program that `micron mismatch plan` wrote")
    try:
        table: dict[str, Any] = dict(parse_toml(text, str(path)))
    except ValueError as error:
        raise BenchError(f"{path}: {error}") from error
    missing = [k for k in ("format", "rate_hz", "stacks", "volts") if k not in table]
    if missing or table["format"] != 1:
        raise BenchError(f"{path}: not a program (format = 1, rate_hz, stacks, volts); missing: {', '.join(missing)}")
    rate, listed = table["rate_hz"], table["stacks"]
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 1.0 <= rate <= 10_000.0:
        raise BenchError(f"{path}: rate_hz = {rate!r} must be a number from 1 to 10000")
    stacks = cast("list[int]", listed)
    if not isinstance(listed, list) or not stacks or not all(type(s) is int and 1 <= s <= 3 for s in stacks):
        raise BenchError(f"{path}: stacks = {listed!r} must list some of 1, 2 and 3")
    try:
        volts = np.asarray(table["volts"], np.float64).T
    except (TypeError, ValueError):
        raise BenchError(f"{path}: volts must be a list of numbers, or lists of as many numbers") from None
    if volts.ndim not in (1, 2) or len(volts) < 2 or not np.all(np.isfinite(volts)):
        raise BenchError(f"{path}: volts must be a list of at least two finite numbers")
    if volts.ndim == 2 and (volts.shape[1] != len(stacks) or len(set(stacks)) < len(stacks)):
        raise BenchError(f"{path}: volts has {volts.shape[1]} lists for stacks = {listed!r}; give each stack one")
    if len(volts) / rate > LONGEST_S:
        raise BenchError(f"{path}: lasts {len(volts) / rate:g} s; at most {LONGEST_S:g} s are played")
    return Program(volts, tuple(dict.fromkeys(s - 1 for s in stacks)), float(rate))


def check_program(path: Path, program: Program, limits: ActuationConfig) -> None:
    """Raise ``BenchError`` for a program that leaves the outputs' limits."""
    low, high = float(program.volts.min()), float(program.volts.max())
    if low < limits.low_V or high > limits.high_V:
        raise BenchError(
            f"{path}: goes from {low:g} to {high:g} V, and this bench's outputs from {limits.low_V:g} to "
            f"{limits.high_V:g} V; plan it for this bench (micron mismatch plan --bench)"
        )
    fastest = float(np.max(np.abs(np.diff(program.volts, axis=0)))) * program.rate_hz
    if fastest > limits.slew_V_per_s * (1 + 1e-9):
        raise BenchError(f"{path}: moves by {fastest:g} V/s, and this bench's outputs by {limits.slew_V_per_s:g} V/s")


class ProgramDrive(ManualDrive):
    """Plays a program instead of obeying orders. Compensation is off for the whole run."""

    def __init__(self, low_V: float, high_V: float, neutral_V: float, program: Program) -> None:
        super().__init__(low_V, high_V, neutral_V)
        self._program = program
        self._began_ns: int | None = None
        self.active = True

    def armed(self, now_ns: int) -> bool:
        return self._began_ns is None or (now_ns - self._began_ns) * 1e-9 < self._program.seconds

    def stop(self) -> None:
        """End the program where it is; the outputs have been taken to neutral already."""
        super().stop()
        self._began_ns = -(1 << 62)
        self.active = True

    def step(self, now_ns: int) -> NDArray[np.float64]:
        """Return the outputs (3,) V wanted now: neutral, the way to the first value, the program, the way back."""
        if self._began_ns is None:
            self._began_ns = self._last_ns = now_ns
        passed_s = min(0.01, (now_ns - self._last_ns) * 1e-9)
        self._last_ns = now_ns
        since_s = (now_ns - self._began_ns) * 1e-9 - 2.0 * APPROACH_S
        volts, target = self._program.volts, self._target_V
        k = int(since_s * self._program.rate_hz + 0.5)
        if since_s >= 0.0 and k < len(volts):
            target[list(self._program.stacks)] = volts[k]
            return target
        goal = np.full(3, self._neutral_V)
        if -APPROACH_S <= since_s < 0.0:
            goal[list(self._program.stacks)] = volts[0]
        step = RETURN_V_PER_S * passed_s
        target += np.clip(goal - target, -step, step)
        return target
