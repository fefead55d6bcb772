"""Dead zone: no response for small inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings
from sim_devices.physics.statistics import best_starts, thin, value_range

LEAST_BEYOND = 0.05
"""Least response beyond the near edge of a zone, in ranges of the signal: without it there is only a limit."""


def _dead_parts(settings: Settings) -> Parts:
    lo, hi = settings.get("range", (-1.0, 1.0))
    span = hi - lo
    return Parts(
        (
            Parameter("half_width", "{in}", 1e-4 * span, 0.45 * span, log=True, scale=0.02 * span),
            Parameter("centre", "{in}", lo, hi, scale=0.02 * span),
        ),
        (Parameter("missing_slope", "{out}/{in}"),),
    )


def _dead_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    lo, hi = settings["range"]
    span = hi - lo
    k = thin(ctx.keep, 4000)
    centres = [*np.linspace(lo + 0.1 * span, hi - 0.1 * span, 9).tolist(), *([0.0] if lo < 0 < hi else [])]
    grid = [(h, c) for h in (span * np.geomspace(0.01, 0.3, 8)).tolist() for c in centres]
    return best_starts(grid, lambda q: ctx.to_output(-np.clip(x - q[1], -q[0], q[0]))[k], ctx.line(x, k), residual[k])[
        :3
    ]


def _dead_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    whole = p.size < 3
    lost = 1.0 if whole else float(p[2] / scale) if scale else 0.0
    return (
        Human("half_width", float(p[0]), "{in}"),
        Human("centre", float(p[1]), "{in}"),
        *(() if whole else (Human("slope_lost_inside", lost, "1"),)),
        Human("response_beyond", _response_beyond(float(p[0]), float(p[1]), lost, settings), "1"),
    )


def _response_beyond(half_width: float, centre: float, lost: float, settings: Settings) -> float:
    """Return the response beyond the near edge of the zone, on the side away from zero, in ranges of the signal.

    A zone about zero is left on either side. Of one beside zero the far edge must be passed, or some slope be left
    inside: else the response never comes back, and the near edge is a limit.
    """
    lo, hi = settings.get("range", (-1.0, 1.0))
    low, high = centre - half_width, centre + half_width
    inside = (1.0 - lost) * (min(high, hi) - max(low, lo))
    below, above = low - lo, hi - high
    beyond = below if high < 0.0 else above if low > 0.0 else max(below, above)
    return (max(beyond, 0.0) + inside) / (hi - lo)


_PARTIAL = Effect(
    name="dead_zone",
    summary="no response for small inputs",
    kind="add",
    stages=("actuator", "amplifier", "sensor"),
    parts=_dead_parts,
    equation=r"y = x - w\,\mathrm{clip}(x - c, -h, h)",
    source="H. K. Khalil, Nonlinear Systems, 3rd ed., section 1.2.7",
    excitation="inputs that pass through the zone and go well beyond it",
    confusable_with=("static_nonlinearity", "backlash", "coulomb_friction"),
    prepare=lambda x, residual, ctx: {"range": value_range(x)},
    guess=_dead_guess,
    basis=lambda x, ctx, q, settings: -np.clip(x - q[1], -q[0], q[0])[:, None],
    report=_dead_report,
    # a slope gained inside makes a limit of it; one that is lost whole scatters about 1
    limits={"slope_lost_inside": (0.0, 1.1), "response_beyond": (LEAST_BEYOND, 1.0)},
    # a narrow zone holds few samples: width times slope is certain, and neither of them
    estimated=("slope_lost_inside",),
    vanishes_with=(("half_width",), ("slope_lost_inside",)),
    essential=("half_width",),
)
_WHOLE = replace(
    _PARTIAL,
    kind="nonlinear",
    parts=lambda settings: Parts(_dead_parts(settings).nonlinear),
    equation=r"y = x - \mathrm{clip}(x - c, -h, h)",
    apply=lambda x, ctx, q, settings: x - np.clip(x - q[1], -q[0], q[0]),
    basis=None,
    limits={"response_beyond": (LEAST_BEYOND, 1.0)},
    estimated=(),
    vanishes_with=(("half_width",),),
)
DEAD_ZONE = replace(_PARTIAL, variants=(_WHOLE,))
