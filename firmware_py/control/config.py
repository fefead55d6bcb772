"""Reads [firmware] of a bench file (stages, safety limits, task budgets) and merges the calibration files into it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from drivers.specs import check_devices
from firmware_py.control.plausibility import PlausibilityLimits
from firmware_py.control.safety import SafetyLimits
from firmware_py.control.stages import StageConfigs
from firmware_py.control.tasks import Works, task_table
from firmware_py.control.wiring import bus_plan
from firmware_py.scheduler.check import check_table
from firmware_py.scheduler.task import TickInfo
from firmware_py.sensing.attitude_params import tip_lever
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.noise_file import noise_table
from firmware_py.tremor.config import LeverConfig
from hal.bench import BenchFile
from hal.errors import BenchError
from hal.toml_file import parse_toml, read_text
from hal.validation import validate_table

TAPS_HZ = 1000.0
"""Rate for which `micron calibrate piezo` makes the taps of a feedforward."""
STAGES = ("sensing", "tremor", "actuation")


class SelfTestLimits(BaseModel):
    """Sets how long the sensors must be good without interruption before arming, and the time limit of the self-test.

    ``watch_ms``: required time without interruption. ``limit_ms``: a self-test that takes longer trips.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    watch_ms: float = Field(default=500.0, ge=50.0, le=10_000.0)
    limit_ms: float = Field(default=3000.0, ge=100.0, le=60_000.0)


class FirmwareConfig(BaseModel):
    """Holds the checked [firmware] table. The tables of the three stages are checked by ``StageConfigs``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    safety: SafetyLimits = SafetyLimits()
    self_test: SelfTestLimits = SelfTestLimits()
    plausibility: PlausibilityLimits = PlausibilityLimits()
    budget_us: dict[str, float] = Field(default_factory=dict[str, float])
    calibration: tuple[str, ...] = ()
    noise: str | None = None
    """Names the JSON file of ``micron noise`` from which the filters' covariances are computed."""
    sensing: dict[str, Any] = Field(default_factory=dict[str, Any])
    tremor: dict[str, Any] = Field(default_factory=dict[str, Any])
    actuation: dict[str, Any] = Field(default_factory=dict[str, Any])


def load_firmware_config(
    bench: BenchFile, wired: Mapping[str, Any], method: str | None = None
) -> tuple[FirmwareConfig, StageConfigs]:
    """Return the configuration of firmware and stages. Later sources override earlier ones: bench table, calibration
    files (in order), ``wired`` (what the wiring decides), measured noise, ``method``.

    ``method``: another tremor estimator than the bench file's. Raises ``BenchError`` naming file and key.
    """
    where = str(bench.path)
    config = validate_table(FirmwareConfig, bench.description.firmware, f"{where}: firmware")
    _check_tasks(bench, config)
    tables: dict[str, dict[str, Any]] = {name: dict(getattr(config, name)) for name in STAGES}
    for name in config.calibration:
        for stage, table in _calibration(bench, name).items():
            tables[stage].update(table)
    tables["sensing"].update(wired)
    if config.noise is not None:
        sensing = SensingConfig.from_dict(tables["sensing"], f"{where}: firmware.sensing")
        tables["sensing"].update(noise_table(bench.resolve(config.noise), sensing))
    if method is not None:
        tables["tremor"]["method"] = method
    _design_for_tick(tables, float(bench.description.clock.tick_hz), where)
    return config, _with_lever(StageConfigs.from_dict(tables, where))


def _with_lever(configs: StageConfigs) -> StageConfigs:
    """The tremor estimator is told what the accelerometers' places say of the tip's noise."""
    tremor = configs.tremor
    if tremor.lever is not None or tremor.sees != "acceleration" or tremor.adaptive.lever_share == 0.0:
        return configs
    arm, turning, tip = (tuple(part.tolist()) for part in tip_lever(configs.sensing))
    if not any(arm):
        return configs
    lever = LeverConfig.model_validate({"arm_m": arm, "noise_m_s2_rtHz": turning, "tip_noise_m_s2_rtHz": tip})
    return replace(configs, tremor=tremor.model_copy(update={"lever": lever}))


def _design_for_tick(tables: dict[str, dict[str, Any]], tick_hz: float, where: str) -> None:
    """Give every stage the rate of the bench's clock: filters and estimators are designed for it.

    Raises ``BenchError`` for a stage that names another rate, and for taps of a feedforward, which are a tick apart and
    were made for 1000 Hz unless [firmware.actuation] says which rate they are for.
    """
    taps = tables["actuation"].get("feedforward", ())
    filters = taps if taps and isinstance(taps[0], list | tuple) else (taps,)
    if tick_hz != TAPS_HZ and "tick_hz" not in tables["actuation"] and any(len(t) > 1 for t in filters):
        raise BenchError(
            f"{where}: firmware.actuation: the taps of feedforward are for ticks of {TAPS_HZ:g} Hz, this bench has "
            f"{tick_hz:g} Hz: calibrate the stacks at that rate and name it there (tick_hz), or set feedforward = [1.0]"
        )
    for name in STAGES:
        given = tables[name].setdefault("tick_hz", tick_hz)
        if given != tick_hz:
            raise BenchError(
                f"{where}: firmware.{name}: tick_hz = {given!r}, but [clock] tick_hz is {tick_hz:g}: leave it out, it "
                "follows the clock"
            )


def _check_tasks(bench: BenchFile, config: FirmwareConfig) -> None:
    """Raise ``BenchError`` where the rates and budgets of the bench do not fit its ticks, before it is opened."""
    description, where = bench.description, str(bench.path)
    polling, bus_us = bus_plan(description, check_devices(description, where))

    def idle(_: TickInfo) -> None:
        pass

    works = Works(
        sense=idle,
        estimate=idle,
        actuate=idle,
        publish=idle,
        supervise=idle,
        magnetometer=idle if polling.magnetometer is not None else None,
        verify=idle if polling.verify is not None else None,
        monitor=idle if polling.monitor is not None else None,
        telemetry=idle if polling.telemetry is not None else None,
    )
    tick_hz = description.clock.tick_hz
    try:
        check_table(task_table(works, tick_hz, config.budget_us, polling, bus_us), (), 1_000_000_000 // tick_hz)
    except BenchError as error:
        raise BenchError(f"{where}: {error}") from error


def _calibration(bench: BenchFile, name: str) -> dict[str, dict[str, Any]]:
    path = bench.resolve(name)
    try:
        text = read_text(path, "name a file of `micron calibrate`, relative to the bench file")
    except BenchError as error:
        raise BenchError(f"{bench.path}: [firmware.calibration] {error}") from error
    try:
        table = parse_toml(text, str(path))
    except tomllib.TOMLDecodeError as error:
        raise BenchError(f"{path}: not a calibration file: {error}") from error
    stages = {key: value for key, value in table.items() if key in STAGES}
    unknown = sorted(set(table) - set(STAGES) - {"format", "title", "made_by", "report"})
    version = table.get("format")
    if isinstance(version, int) and version > 1:
        raise BenchError(
            f"{path}: a calibration of format {version}, written by a later version; this one reads format 1. "
            "Calibrate again, or use that version"
        )
    if unknown or version != 1:
        detail = f"unknown table [{unknown[0]}]" if unknown else "format = 1 is missing"
        raise BenchError(f"{path}: {detail}; a calibration has format = 1 and any of {', '.join(STAGES)}")
    return stages
