"""(f) Prandtl-Ishlinskii hysteresis with creep, forward and inverse, against numpy vectorised over the plays."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benchmarks import step_input
from benchmarks.row import Row, side_by_side
from firmware_py.actuation.hysteresis import drive, stack_stroke
from firmware_py.records import Record, attributes
from hal.arrays import Array
from hal.compiled import kernel

N = 20_000
NUMPY_N = 2000


@kernel
def forward_run(volts: Array, out: Array, plays: Array, creep: Array, slopes: Array, stacks: Record) -> None:
    for k in range(len(volts)):
        out[k] = stack_stroke(volts[k], slopes, plays, creep, stacks[0])


@kernel
def inverse_run(wanted: Array, out: Array, plays: Array, creep: Array, slopes: Array, stacks: Record) -> None:
    """Inverse and then the forward model, which the inverse needs to remember what the stack has seen."""
    for k in range(len(wanted)):
        out[k] = drive(wanted[k], slopes, plays, creep, stacks[0])
        stack_stroke(out[k], slopes, plays, creep, stacks[0])


def numpy_forward(volts: Array, plays: Array, creep: Array, slopes: Array, p: Record) -> Array:
    """One sample after the other, vectors over plays, dead zones and creep."""
    out = np.empty(len(volts))
    weights = np.diff(slopes, prepend=0.0)
    share = (1.0 - p.creep_keep) * p.creep_share
    for k, v in enumerate(volts):
        np.clip(plays, v - p.centre_V - p.r, v - p.centre_V + p.r, out=plays)
        y = weights @ plays + p.level
        x = p.s[0] * y + p.s[1:] @ np.maximum(y - p.d[1:], 0.0) + p.offset
        creep[:] = p.creep_keep * creep + share * (x - p.creep_reference)
        out[k] = x + creep.sum()
    return out


def numpy_inverse(wanted: Array, plays: Array, creep: Array, slopes: Array, p: Record) -> Array:
    out = np.empty(len(wanted))
    weights = np.diff(slopes, prepend=0.0)
    inverse = np.diff(1.0 / slopes, prepend=0.0)
    share = (1.0 - p.creep_keep) * p.creep_share
    threshold = np.concatenate([[0.0], np.cumsum(slopes[:-1] * np.diff(p.r))])
    for k, z in enumerate(wanted):
        rest = z + (share * p.creep_reference - p.creep_keep * creep).sum()
        y = rest / (1.0 + share.sum()) - p.offset
        h = p.s_inverse[0] * y + p.s_inverse[1:] @ np.maximum(y - p.d_inverse[1:], 0.0) - p.level
        mapped = weights @ plays + np.concatenate([[0.0], np.cumsum(slopes[:-1] * np.diff(plays))])
        out[k] = inverse @ np.clip(mapped, h - threshold, h + threshold) + p.centre_V
        numpy_forward(out[k : k + 1], plays, creep, slopes, p)
    return out


def rows() -> Iterator[Row]:
    stages = step_input.stages()
    record = stages.actuation.params["stacks"][0, :1].copy()
    peer = attributes(record)[0]
    slopes = peer.slope.copy()
    n_creep = len(peer.creep_keep)
    t = np.arange(N) / 1000.0
    volts = 50.0 + 30.0 * np.sin(2 * np.pi * 9.0 * t) + 8.0 * np.sin(2 * np.pi * 1.3 * t)
    start = np.clip(np.zeros(len(peer.r)), -peer.r, peer.r)
    out = np.empty(N)

    def forward() -> None:
        forward_run(volts, out, start.copy(), np.zeros(n_creep), slopes, record)

    def forward_numpy() -> Array:
        return numpy_forward(volts[:NUMPY_N], start.copy(), np.zeros(n_creep), slopes, peer)

    forward()
    np.testing.assert_allclose(forward_numpy(), out[:NUMPY_N], rtol=1e-9)
    lengths = out.copy()
    back = np.empty(N)

    def inverse() -> None:
        inverse_run(lengths, back, start.copy(), np.zeros(n_creep), slopes, record)

    def inverse_numpy() -> Array:
        return numpy_inverse(lengths[:NUMPY_N], start.copy(), np.zeros(n_creep), slopes, peer)

    inverse()
    np.testing.assert_allclose(back, volts, rtol=1e-7)
    np.testing.assert_allclose(inverse_numpy(), back[:NUMPY_N], rtol=1e-7)
    for name, mine, theirs in (("forward", forward, forward_numpy), ("inverse and forward", inverse, inverse_numpy)):
        a = side_by_side((mine,), N, 5)[0]
        b = side_by_side((theirs,), NUMPY_N, 3)[0]
        what = f"per sample, {len(peer.r)} plays, {len(peer.d)} dead zones, {n_creep} creep elements"
        yield Row(f"hysteresis, {name}", what, a, b, "numpy", "us", b / a)
