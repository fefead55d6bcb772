"""Resolves a bench file once into one frozen plan, from which devices, stages, tasks and reports take their part.

A fact that several parts need has one owner, and the others follow it:

| fact | owner | who follows |
|---|---|---|
| tick rate | ``[clock] tick_hz`` | every stage, the task table, the DAQ's rate (which must be equal) |
| limits, neutral voltage and slew rate of the outputs | the output's ``[device]`` table | the actuation stage |
| filter in front of the accelerometers | ``[firmware.sensing] filter_ohm, filter_farad`` | the tremor estimator |

A file that states such a fact a second time, differently, is refused with one message.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isclose
from operator import eq, ge, le
from typing import Any

from drivers.options import OutputOptions
from drivers.polling import Polling
from drivers.specs import check_devices
from firmware_py.control.config import FirmwareConfig
from firmware_py.control.stages import StageConfigs
from firmware_py.control.tasks import task_rows
from firmware_py.control.wiring import bus_plan
from firmware_py.run.tasks import bind_tasks
from firmware_py.scheduler.check import check_table
from firmware_py.scheduler.task import TickInfo
from firmware_py.sensing.attitude_params import tip_lever
from firmware_py.sensing.config import SensingConfig
from firmware_py.sensing.noise_file import noise_table
from firmware_py.sensing.stage import LEAN_CORNER_HZ
from firmware_py.tremor.config import LeverConfig
from hal.bench import BenchFile
from hal.errors import BenchError
from hal.toml_file import parse_toml, read_text
from hal.validation import validate_table

TAPS_HZ = 1000.0
"""Rate for which `micron calibrate piezo` makes the taps of a feedforward."""
STAGES = ("sensing", "tremor", "actuation")


@dataclass(frozen=True)
class Plan:
    """Holds all that a bench file decides, checked and resolved.

    ``options``: each device's checked keys, by name. ``polling``: polling rate of each device; ``bus_us``: time that a
    transaction of each task takes on the wires, us. ``tables``: the stages' tables with their calibrations, before
    ``with_wiring``; ``stages``: the configurations made from them.
    """

    bench: BenchFile
    options: Mapping[str, Any]
    polling: Polling
    bus_us: Mapping[str, float]
    firmware: FirmwareConfig
    tables: Mapping[str, Mapping[str, Any]]
    stages: StageConfigs

    @property
    def tick_hz(self) -> int:
        """Return the rate of the tick, Hz."""
        return self.bench.description.clock.tick_hz

    def with_wiring(self, wired: Mapping[str, Any]) -> Plan:
        """Return the plan with ``wired``, the part of the sensing table that only the opened devices know."""
        tables = {**self.tables, "sensing": {**self.tables["sensing"], **wired}}
        return replace(self, tables=tables, stages=_design_stages(self.bench, self.firmware, tables))


def load_plan(bench: BenchFile, method: str | None = None) -> Plan:
    """Resolve ``bench``. Later sources override earlier ones: bench table, calibration files (in order), wiring,
    measured noise; ``method`` is another tremor estimator than the bench file's. Raises ``BenchError`` naming file and
    key."""
    where, description = str(bench.path), bench.description
    firmware = validate_table(FirmwareConfig, description.firmware, f"{where}: firmware")
    options = check_devices(description, where)
    polling, bus_us = bus_plan(description, options)
    _check_tasks(bench, firmware, polling, bus_us)
    tables: dict[str, dict[str, Any]] = {name: dict(getattr(firmware, name)) for name in STAGES}
    for name in firmware.calibration:
        for stage, table in _calibration(bench, name).items():
            tables[stage].update(table)
    if method is not None:
        tables["tremor"]["method"] = method
    _follow_clock(tables, float(description.clock.tick_hz), where)
    _follow_output(tables["actuation"], options, where)
    stages = _design_stages(bench, firmware, tables)
    return Plan(bench, options, polling, bus_us, firmware, tables, stages)


def _design_stages(bench: BenchFile, firmware: FirmwareConfig, tables: Mapping[str, Mapping[str, Any]]) -> StageConfigs:
    where = str(bench.path)
    sensing = SensingConfig.from_dict(tables["sensing"], f"{where}: firmware.sensing")
    table = dict(tables["sensing"])
    if firmware.noise is not None:
        table.update(noise_table(bench.resolve(firmware.noise), sensing))
    tremor = _behind_filter(tables["tremor"], sensing, where)
    return _with_lever(StageConfigs.from_dict({**tables, "sensing": table, "tremor": tremor}, where))


def _with_lever(configs: StageConfigs) -> StageConfigs:
    """The tremor estimator is told what the accelerometers' places say of the tip's noise."""
    tremor = configs.tremor
    if tremor.lever is not None or tremor.sees != "acceleration" or tremor.adaptive.lever_share == 0.0:
        return configs
    arm, noise = (part.tolist() for part in tip_lever(configs.sensing))
    if not any(arm):
        return configs
    lever = LeverConfig.model_validate(
        {"arm_m": arm, "noise": noise, "gravity_m_s2": configs.sensing.gravity_m_s2, "lean_from_hz": LEAN_CORNER_HZ}
    )
    return replace(configs, tremor=tremor.model_copy(update={"lever": lever}))


def _follow_clock(tables: dict[str, dict[str, Any]], tick_hz: float, where: str) -> None:
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
            " where they are (calibration files override the bench)"
        )
    for name in STAGES:
        given = tables[name].setdefault("tick_hz", tick_hz)
        if given != tick_hz:
            raise BenchError(
                f"{where}: firmware.{name}: tick_hz = {given!r}, but [clock] tick_hz is {tick_hz:g}: leave it out, it "
                "follows the clock"
            )


def _follow_output(table: dict[str, Any], options: Mapping[str, Any], where: str) -> None:
    """Give the actuation stage the limits of the bench's output, within which [firmware.actuation] may set narrower
    ones. Raises ``BenchError`` for wider ones and for another neutral voltage."""
    outputs = [(name, option) for name, option in options.items() if isinstance(option, OutputOptions)]
    if len(outputs) != 1:
        return
    ((name, option),) = outputs
    limit = option.limit
    for key, of_output, output_key, narrows in (
        ("low_V", limit.lo_V, "lo_V", ge),
        ("high_V", limit.hi_V, "hi_V", le),
        ("slew_V_per_s", limit.slew_V_per_s, "slew_V_per_s", le),
        ("neutral_V", limit.safe_V, "neutral_V", eq),
    ):
        given = table.setdefault(key, of_output)
        if isinstance(given, int | float) and not narrows(given, of_output):
            what = "the ramp to neutral ends at" if key == "neutral_V" else "the output allows"
            raise BenchError(
                f"{where}: firmware.actuation: {key} = {given:g}, but {what} {output_key} = {of_output:g} of "
                f"[device.{name}]: leave {key} out here, or change it there"
            )


def _behind_filter(table: Mapping[str, Any], sensing: SensingConfig, where: str) -> dict[str, Any]:
    """Return the tremor table with the filter that stands in front of the accelerometers.

    Raises ``BenchError`` for an estimator of acceleration that is told of another filter."""
    follows = table.get("sees", "acceleration") == "acceleration"
    if not follows:
        return dict(table)
    cutoff_rad_s = sensing.cutoff_rad_s
    given = table.get("filter_cutoff_rad_s", cutoff_rad_s)
    if isinstance(given, int | float) and not isclose(given, cutoff_rad_s, rel_tol=1e-9):
        raise BenchError(
            f"{where}: firmware.tremor: filter_cutoff_rad_s = {given:g}, but the filter of firmware.sensing "
            f"(filter_ohm, filter_farad) has {cutoff_rad_s:g}: leave it out, it follows sensing"
        )
    return {**table, "filter_cutoff_rad_s": cutoff_rad_s if isinstance(given, int | float) else given}


def _check_tasks(bench: BenchFile, firmware: FirmwareConfig, polling: Polling, bus_us: Mapping[str, float]) -> None:
    """Raise ``BenchError`` where the rates and budgets of the bench do not fit its ticks, before it is opened."""
    description, where = bench.description, str(bench.path)

    tick_hz = description.clock.tick_hz
    try:
        rows = task_rows(_Idle(), polling, bus_us)
        check_table(bind_tasks(rows, tick_hz, firmware.budget_us), (), 1_000_000_000 // tick_hz)
    except BenchError as error:
        raise BenchError(f"{where}: {error}") from error


class _Idle:
    """``Works`` that do nothing: rates and budgets of a table are checked before there is an instrument."""

    def idle(self, info: TickInfo) -> None:
        pass

    sense = estimate = actuate = publish = supervise = verify = monitor = magnetometer = telemetry = idle


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
