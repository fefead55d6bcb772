"""Every number of a bench file, replaced by an absurd one: the bench can still run, or one message says no."""

from __future__ import annotations

import copy
import json
import math
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.specs import check_devices
from firmware_py.app import run_in_process
from firmware_py.control.config import FirmwareConfig
from firmware_py.control.plan import load_plan
from firmware_py.run.safety import SafetyLimits
from firmware_py.run_request import RunRequest
from hal.bench import load_bench
from hal.errors import BenchError, HalError
from sim_devices.config import emulation_config
from tests.conftest import DEFAULT_BENCH

ABSURD = (math.nan, math.inf, -math.inf, 0, -1, 1e9, 1e300, 5e-324, 2**63, 10**30)


def whole_bench() -> dict[str, Any]:
    """The default bench with every limit that may be left out."""
    table = tomllib.loads(DEFAULT_BENCH.read_text())
    table["firmware"]["calibration"] = [f"{DEFAULT_BENCH.parent}/{c}" for c in table["firmware"]["calibration"]]
    for part in ("safety", "self_test", "plausibility"):
        limits = FirmwareConfig().model_dump()[part]
        table["firmware"][part] = {k: list(v) if isinstance(v, tuple) else v for k, v in limits.items()}
    table["firmware"]["budget_us"] = {"estimate": 50.0}
    table["device"]["monitor"] |= {"settle_ms": 0.3, "change_V": 0.15, "rate_hz": 400}
    table["device"]["piezo"] |= {"lo_V": 0.0, "hi_V": 100.0, "slew_V_per_s": 20_000.0}
    return table


def numbers(value: Any, at: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from numbers(item, (*at, key))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield at


def toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, bool | str):
        return json.dumps(value)
    return repr(value)


BENCH = whole_bench()
PLACES = list(numbers(BENCH))


def with_number(folder: Path, place: tuple[str | int, ...], number: float) -> Path:
    table = copy.deepcopy(BENCH)
    at: Any = table
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = number
    path = folder / "bench.toml"
    path.write_text("\n".join(f"{json.dumps(key)} = {toml(item)}" for key, item in table.items()))
    return path


def test_the_bench_with_everything_said_is_a_bench(tmp_path: Path):
    path = with_number(tmp_path, ("device", "acc1", "channels", "x"), 0)
    load_plan(load_bench(path))
    assert len(PLACES) > 80


@settings(max_examples=300, deadline=None)
@given(place=st.sampled_from(PLACES), number=st.sampled_from(ABSURD))
def test_a_bench_is_checked_without_a_traceback(
    tmp_path_factory: pytest.TempPathFactory, place: tuple[str | int, ...], number: float
):
    path = with_number(tmp_path_factory.mktemp("absurd"), place, number)
    try:
        bench = load_bench(path)
        check_devices(bench.description, str(path))
        load_plan(bench)
        emulation_config(bench.description.model_dump())
    except BenchError:
        return
    assert math.isfinite(number)
    assert abs(number) < 2**63


SAFETY_NUMBERS = sorted(name for name, value in SafetyLimits() if not isinstance(value, bool | str))


@pytest.mark.parametrize("name", SAFETY_NUMBERS)
@pytest.mark.parametrize("number", [n for n in ABSURD if not abs(n) < 1e9])
def test_no_safety_limit_is_absurd(tmp_path: Path, name: str, number: float):
    """Every number of the table has a range; a member that is added without one fails here."""
    pair = isinstance(getattr(SafetyLimits(), name), tuple)
    for place in [("firmware", "safety", name, k) for k in (0, 1)] if pair else [("firmware", "safety", name)]:
        path = with_number(tmp_path, place, number)
        with pytest.raises(BenchError, match=name):
            load_plan(load_bench(path))


def test_the_ends_of_a_safety_limit_are_in_order(tmp_path: Path):
    path = with_number(tmp_path, ("firmware", "safety", "supply_V", 0), 5.6)
    with pytest.raises(BenchError, match=r"supply_V\] the lower limit"):
        load_plan(load_bench(path))


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(place=st.sampled_from(PLACES), number=st.sampled_from([0, -1, 1e9, 5e-324]))
def test_what_is_accepted_runs_and_ends(
    tmp_path_factory: pytest.TempPathFactory, place: tuple[str | int, ...], number: float
):
    """A run of a twentieth of a second: it ends in the safe state, whatever the reason, or is refused."""
    path = with_number(tmp_path_factory.mktemp("absurd"), place, number)
    try:
        outcome, _ = run_in_process(RunRequest(path, 0.05, pace="virtual"))
    except HalError:
        return
    assert outcome["safe_state"]["reached"]
