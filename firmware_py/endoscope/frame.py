"""The endoscope's frame: one row per sample of the steering sensor. Replay is given the inputs and must find the rest.

The inputs are the columns up to ``held``; ``steering`` fills the columns after them.
"""

from __future__ import annotations

from firmware_py.frame import XYZ, Layout

_QUANTITIES: tuple[tuple[str, str, tuple[str, ...], str], ...] = (
    ("tick", "1", (), "number of the sample since the start of the run; a gap is a lost sample"),
    ("t", "s", (), "bench time of the sample since the start of the run"),
    ("accel", "m/s^2", XYZ, "specific force, sensor frame"),
    ("gyro", "rad/s", XYZ, "angular rate, sensor frame"),
    ("temperature", "degC", (), "temperature of the sensor"),
    ("card_status", "1", (), "status of the card: 0 inactive, 1 move, 2 zoom"),
    ("fused", "1", (), "1 if the sample went into the attitude filter; the card's spike filter holds some back"),
    ("held", "1", (), "1 while a hold keeps the view where it is"),
    ("status", "1", (), "status that the view obeys"),
    ("used", "1", (), "1 if the sample could move the view"),
    ("quaternion", "1", ("w", "x", "y", "z"), "attitude of the sensor, body to world"),
    ("psi", "deg", (), "roll"),
    ("theta", "deg", (), "pitch"),
    ("view_x", "px", (), "centre of the view"),
    ("view_y", "px", (), "centre of the view"),
    ("view_size", "px", (), "side of the view"),
    ("reached", "1", (), "targets reached so far"),
)

LAYOUT = Layout("endoscope", _QUANTITIES, plotted=("psi", "theta", "view_x", "view_y"), held=("held", 1))

TICK, TIME = LAYOUT.start("tick"), LAYOUT.start("t")
ACCEL, GYRO, TEMPERATURE = LAYOUT.start("accel"), LAYOUT.start("gyro"), LAYOUT.start("temperature")
CARD_STATUS, FUSED, HELD = LAYOUT.start("card_status"), LAYOUT.start("fused"), LAYOUT.start("held")
OUTPUTS = LAYOUT.start("status")
USED, QUATERNION, PSI, VIEW = (LAYOUT.start(name) for name in ("used", "quaternion", "psi", "view_x"))
