"""Defines the one shape of all attitude filters: the built-in one and those of packages (``micron.attitude``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from firmware_py.records import Records, field, record
from firmware_py.sensing.config import SensingConfig
from hal.arrays import Array


@record
class AttitudeParams:
    """The numbers that all attitude filters have; each adds its own record."""

    align_samples: float = field("1")
    dt_s: float = field("s")


@record
class AttitudeState:
    """The state that all attitude filters have; each adds its own record."""

    quaternion: Array = field("1", 4)
    matrix: Array = field("1", 3, 3)  # C_WB of the quaternion
    rate: Array = field("rad/s", 3)
    bias: Array = field("rad/s^2", 3)  # of the angular acceleration
    previous: Array = field("rad/s^2", 3)  # angular acceleration of the last tick
    corrected: Array = field("rad, rad/s, rad/s^2", 3, 3)  # body frame: turn, rate of this tick; bias since the start
    time_s: float = field("s")  # since the start of alignment
    aligned: int = field("1")
    samples: float = field("1")
    sums: Array = field("m/s^2, rad/s^2, uT", 3, 3)  # force, angular acceleration and field while aligning
    field: Array = field("uT", 3)  # last magnetic field, body frame


class Motion(NamedTuple):
    """A step's input, body frame: specific force (3,) m/s^2, angular acceleration (3,) rad/s^2, duration s.

    ``fresh``: ``field`` in the state is a measurement of this step.
    """

    force: Array
    alpha: Array
    fresh: bool
    dt_s: float


@record
class OwnEntries:
    """Addresses of the kernels of a package's filter, which ``attitude_params`` fills. Its parameters begin so."""

    begin: int = field("1")
    step: int = field("1")


@record
class OwnNumbers(AttitudeParams):
    """The attitude's parameters with those of a package's filter."""

    own: OwnEntries = field("")


@dataclass(frozen=True)
class AttitudeFilter:
    """An attitude filter.

    ``params`` and ``state`` are the attitude's records, each with one of the filter's own, called ``own`` in a package;
    ``new_params(config)`` makes its parameters. The kernels take ``(input, state, params)``, the
    whole records:

    - ``begin``: the field (3,), body frame, summed over the alignment. Sets the filter's own state.
    - ``step``: ``Motion``. Updates quaternion, matrix, rate and bias.
    """

    params: type[AttitudeParams]
    state: type[AttitudeState]
    new_params: Callable[[SensingConfig], Records[Any]]
    begin: Callable[[Array, Any, Any], None]
    step: Callable[[Motion, Any, Any], None]
