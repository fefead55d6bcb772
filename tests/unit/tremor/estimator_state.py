"""What tests of estimators need: the state as attributes, and a configuration without a filter."""

from __future__ import annotations

from numpy import inf

from firmware_py.records import Record, attributes
from firmware_py.tremor.config import TremorConfig


def unfiltered(config: TremorConfig) -> TremorConfig:
    """Return ``config`` for a displacement sensor without a filter."""
    method = "adaptive" if config.method == "kalman" else config.method
    return config.model_copy(update={"sees": "displacement", "filter_cutoff_rad_s": inf, "method": method})


def peek(record: Record) -> Record:
    """A state's or parameters' fields as attributes, for tests and figures."""
    return attributes(record)[0]
