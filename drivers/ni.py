"""Registers National Instruments cards. Their package ``nidaqmx`` is optional and imported when a card is opened."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers.options import NiDaqOptions, NiOutputOptions
from drivers.registry import Driver, Site

if TYPE_CHECKING:
    from drivers.ni_output import NidaqmxOutput
    from hal.backends.nidaqmx_ai import NidaqmxScan


def _open_input(site: Site) -> NidaqmxScan:
    from hal.backends.nidaqmx_ai import NidaqmxScan

    return NidaqmxScan(site.options.device, site.bench.clock, name=site.name)


def _open_output(site: Site) -> NidaqmxOutput:
    from drivers.ni_output import NidaqmxOutput

    table = site.options.model_dump()
    return NidaqmxOutput(table.pop("device"), site.bench.clock, table.pop("channels"), name=site.name, **table)


INPUT = Driver(NiDaqOptions, _open_input, "daq", needs="")
OUTPUT = Driver(NiOutputOptions, _open_output, "output", needs="")
