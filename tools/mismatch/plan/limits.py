"""Determines the limits of an input: amplitude about a centre, rate, band and duration, in the channel's unit."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hal.bench import BenchFile
from tools.errors import InputError
from tools.mismatch.recording import Array

LEAST_SAMPLES = 200
MOST_SAMPLES = 60_000
"""Largest number of samples of a plan. Every candidate input is simulated with every model, some hundred times."""
BAND_SHARE = 0.1
"""Highest frequency of a default band, as a share of the sampling rate."""
LEAST_SHARE = 1e-9
"""Least amplitude of an input as a share of its centre; with less, rounding changes the wave."""


@dataclass(frozen=True)
class Limits:
    """Limits an input to ``centre`` +- ``amplitude``, the rate ``rate_per_s`` and the duration ``duration_s``.

    ``band_hz`` bounds the frequencies of sinusoids and the inverse of the shortest hold; ``rms`` bounds the rms about
    the centre, and so the energy.
    """

    unit: str
    centre: float
    amplitude: float
    rate_per_s: float
    band_hz: tuple[float, float]
    duration_s: float
    rms: float = np.inf


@dataclass(frozen=True)
class Wish:
    """Holds the limits that a person requested. None stands for the default."""

    amplitude: float | None = None
    centre: float | None = None
    rate_per_s: float | None = None
    band_hz: tuple[float, float] | None = None
    duration_s: float | None = None
    rms: float | None = None


def limits_json(limits: Limits) -> dict[str, Any]:
    """Return JSON values; an energy without a bound is null."""
    return {**asdict(limits), "rms": limits.rms if np.isfinite(limits.rms) else None}


def parse_band(text: str | None) -> tuple[float, float] | None:
    """Parse ``LOW:HIGH`` in Hz."""
    if text is None:
        return None
    found = re.fullmatch(r"([0-9.eE+-]+):([0-9.eE+-]+)", text)
    try:
        low, high = (float(v) for v in found.groups()) if found else (float("nan"), float("nan"))
    except ValueError:
        low, high = float("nan"), float("nan")
    if not 0.0 < low < high < float("inf"):
        raise InputError(f"--band {text}: must be LOW:HIGH in Hz with 0 < LOW < HIGH, for example 0.2:40")
    return low, high


def settle_limits(
    wish: Wish, unit: str, dt: float, recorded: Array | None, where: str, bench: Mapping[str, float] | None
) -> Limits:
    """Return the limits of an input: the requested ones, else those of the recorded course, else those of the bench.

    Raises InputError for a request that is impossible at this sampling rate or beyond the bench.
    """
    for option, value in (
        ("--amplitude", wish.amplitude),
        ("--rate", wish.rate_per_s),
        ("--duration", wish.duration_s),
        ("--rms", wish.rms),
    ):
        if value is not None and not 0.0 < value < 1e9:
            raise InputError(f"{option} {value:g}: must be a positive number below 1e9")
    if wish.centre is not None and not abs(wish.centre) < 1e9:
        raise InputError(f"--centre {wish.centre:g}: must be a number between -1e9 and 1e9")
    centre, amplitude, rate, duration = wish.centre, wish.amplitude, wish.rate_per_s, wish.duration_s
    if recorded is not None:
        low, high = float(np.min(recorded)), float(np.max(recorded))
        centre = 0.5 * (low + high) if centre is None else centre
        amplitude = 0.5 * (high - low) if amplitude is None else amplitude
        duration = min(recorded.size, MOST_SAMPLES) * dt if duration is None else duration
    if bench is not None:
        centre = bench["neutral"] if centre is None else centre
        amplitude = min(bench["high"] - centre, centre - bench["low"]) if amplitude is None else amplitude
        rate = bench["rate"] if rate is None else rate
        check_bench(centre, amplitude, rate, unit, bench)
    if amplitude is None:
        raise InputError(f"{where}: nothing was recorded, so nothing says how far the input may go; add --amplitude")
    least = 0.0 if centre is None else LEAST_SHARE * abs(centre)
    if wish.amplitude is not None and wish.amplitude < least:
        raise InputError(f"--amplitude {amplitude:g}: is lost beside the centre {centre:g}; give {least:g} or more")
    duration = 10.0 if duration is None else duration
    if not LEAST_SAMPLES <= duration / dt <= MOST_SAMPLES:
        raise InputError(
            f"--duration {duration:g}: {duration / dt:.0f} samples at {1 / dt:g} Hz; a plan has {LEAST_SAMPLES} to "
            f"{MOST_SAMPLES}, so give {LEAST_SAMPLES * dt:g} to {MOST_SAMPLES * dt:g} s"
        )
    band = wish.band_hz or (2.0 / duration, BAND_SHARE / dt)
    if band[1] > 0.5 / dt:
        raise InputError(f"--band {band[0]:g}:{band[1]:g}: half the sampling rate is {0.5 / dt:g} Hz; stay below it")
    if band[0] * duration < 0.5:
        raise InputError(f"--band {band[0]:g}:{band[1]:g}: {duration:g} s hold no half period of {band[0]:g} Hz")
    if rate is None:
        rate = 2.0 * np.pi * band[1] * amplitude
    rms = np.inf if wish.rms is None else wish.rms
    return Limits(unit, 0.0 if centre is None else centre, amplitude, float(rate), band, duration, rms)


def bench_limits(file: BenchFile) -> dict[str, float]:
    """Return output range, neutral voltage and slew limit (V, V/s) of a bench. Raises InputError without an output."""
    from firmware_py.actuation.config import ActuationConfig

    output = next((d.model_dump() for d in file.description.device.values() if "neutral_V" in d.model_dump()), None)
    if output is None:
        raise InputError(f"{file.path}: has no output that a program could move; name a bench with one")
    usual = ActuationConfig()
    return {
        "low": float(output.get("lo_V", usual.low_V)),
        "high": float(output.get("hi_V", usual.high_V)),
        "neutral": float(output["neutral_V"]),
        "rate": float(output.get("slew_V_per_s", usual.slew_V_per_s)),
    }


def check_bench(centre: float, amplitude: float, rate: float, unit: str, bench: Mapping[str, float]) -> None:
    """Raise InputError for limits that the bench's output does not allow."""
    if not bench["low"] < centre < bench["high"]:
        raise InputError(
            f"--centre {centre:g}: must lie within the bench's {bench['low']:g} to {bench['high']:g} {unit}"
        )
    low, high = centre - amplitude, centre + amplitude
    if low < bench["low"] - 1e-9 or high > bench["high"] + 1e-9:
        most = min(bench["high"] - centre, centre - bench["low"])
        raise InputError(
            f"--amplitude {amplitude:g}: {low:g} to {high:g} {unit} leaves the bench's {bench['low']:g} to "
            f"{bench['high']:g} {unit}; about {centre:g} {unit} at most {most:g}"
        )
    if rate > bench["rate"] * (1 + 1e-9):
        raise InputError(f"--rate {rate:g}: the bench's output moves by at most {bench['rate']:g} {unit}/s")
