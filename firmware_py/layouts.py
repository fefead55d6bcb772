"""Says which instrument a bench or a recording is of, by the layout of its frames."""

from __future__ import annotations

from collections.abc import Mapping

from firmware_py import frame
from firmware_py.endoscope import frame as endoscope_frame
from firmware_py.endoscope.wiring import is_endoscope
from firmware_py.frame import Layout
from hal.bench import BenchDescription


def layout_of(description: BenchDescription) -> Layout:
    """Return the layout of the frames that the instrument of a bench publishes and records."""
    return endoscope_frame.LAYOUT if is_endoscope(description) else frame.LAYOUT


def layout_of_recording(metadata: Mapping[str, object]) -> Layout:
    """Return the layout of the instrument that made a recording."""
    return endoscope_frame.LAYOUT if "endoscope" in metadata else frame.LAYOUT
