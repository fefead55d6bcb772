"""Learns how the magnetic field varies in a room, and finds a magnet that moves with the body.

Two models explain the field z in the world frame, C b of body field b and attitude C:

    alone:   z = m + d          with:    z = m + C h + d

m is the room's field, a slow random walk; h, in the body frame, is what a magnet on the body adds; d is how the field
of a room differs from place to place, white beyond its correlation time. The second model is a Kalman filter of
(m, h). Each model's mean squared innovation over ``window_s`` is its estimate of d's density, so that a room with
steel in it needs stronger evidence than an empty one. n independent samples of a window prefer the second model by

    L = n/2 ln(alone / with) - price

in nats, and its share is the logistic function of L: the price is the log odds against a magnet that comes on. The
heading is corrected with b - share h, and trusts that the less, the less is known of h. Where the first model is
clearly better, the second begins anew.

The attitude enters without the corrections of the heading, so that a heading that follows a magnet does not hide it.
"""

from __future__ import annotations

from math import cos, exp, log, sin, sqrt

from firmware_py.records import field, record
from hal.arrays import Array
from hal.compiled import kernel
from hal.scratch import scratch, scratch_matrix

UNKNOWNS = 6
"""Room's field, then the magnet's."""
AGAIN = -3.0
"""Nats against the second model, without the price, at which it begins anew."""


@record
class MagnetParams:
    """Densities of both models, relative to the size of the field at the start."""

    room_density: float = field("s")  # of the differences between places; 0: magnets are not looked for
    room_walk: float = field("1/s")  # random walk of the room's field
    magnet_walk: float = field("1/s")  # random walk of the magnet's field
    magnet_start: float = field("1")  # standard deviation of a magnet's field when it is looked for anew
    window_s: float = field("s")
    independent_s: float = field("s")  # correlation time of the differences between places
    price: float = field("1")  # nats
    mean_s: float = field("s")  # fields are averaged over this time


@record
class Magnet:
    """The two models. ``alone`` and ``together`` are their densities of the room, relative as the parameters are."""

    unit: float = field("uT")  # size of the field at the start
    corrected_rad: float = field("rad")  # by which the heading was corrected: the models see it uncorrected
    total: Array = field("s", 3)  # of the world's field, until ``mean_s`` is full
    total_s: float = field("s")
    room: Array = field("1", 3)
    room_variance: float = field("1")
    pair: Array = field("1", UNKNOWNS)
    covariance: Array = field("1", UNKNOWNS, UNKNOWNS)
    alone: float = field("s")
    together: float = field("s")
    share: float = field("1")


@kernel
def begin_magnet(magnet: Magnet) -> None:
    """Forget room and magnet; the next field is the room's."""
    magnet.unit = 0.0
    magnet.corrected_rad = 0.0
    magnet.total_s = 0.0
    magnet.total[:] = 0.0
    magnet.room[:] = 0.0
    magnet.share = 0.0
    magnet.pair[:] = 0.0


@kernel
def _look_anew(magnet: Magnet, params: MagnetParams) -> None:
    p = magnet.covariance
    p[:, :] = 0.0
    for i in range(3):
        magnet.pair[i] = magnet.room[i]
        magnet.pair[3 + i] = 0.0
        p[i, i] = magnet.room_variance
        p[3 + i, 3 + i] = params.magnet_start**2
    magnet.together = magnet.alone
    magnet.share = 0.0


@kernel
def _update_pair(magnet: Magnet, c: Array, z: Array, variance: float) -> float:
    """Correct (m, h) with the field ``z`` (3,); return the sum of the squared normalised innovations."""
    p, x = magnet.covariance, magnet.pair
    column = scratch(UNKNOWNS)
    away = 0.0
    for i in range(3):
        for k in range(UNKNOWNS):
            column[k] = p[k, i] + c[i, 0] * p[k, 3] + c[i, 1] * p[k, 4] + c[i, 2] * p[k, 5]
        innovation = variance + column[i] + c[i, 0] * column[3] + c[i, 1] * column[4] + c[i, 2] * column[5]
        residual = z[i] - x[i] - (c[i, 0] * x[3] + c[i, 1] * x[4] + c[i, 2] * x[5])
        away += residual * residual / innovation
        for k in range(UNKNOWNS):
            x[k] += column[k] * (residual / innovation)
        for k in range(UNKNOWNS):
            for j in range(UNKNOWNS):
                p[k, j] -= column[k] * column[j] / innovation
    return away


@kernel
def find_magnet(magnet: Magnet, params: MagnetParams, attitude: Array, b: Array, dt: float) -> None:
    """Take the field ``b`` (3,) of a body with this attitude (3, 3), ``dt`` s after the last, and weigh the models."""
    c = scratch_matrix(3, 3)
    cosine, sine = cos(magnet.corrected_rad), sin(magnet.corrected_rad)
    for j in range(3):
        c[0, j] = cosine * attitude[0, j] + sine * attitude[1, j]
        c[1, j] = cosine * attitude[1, j] - sine * attitude[0, j]
        c[2, j] = attitude[2, j]
    if magnet.unit == 0.0:
        magnet.unit = sqrt(b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
        if magnet.unit == 0.0:
            return
        for i in range(3):
            magnet.room[i] = (c[i, 0] * b[0] + c[i, 1] * b[1] + c[i, 2] * b[2]) / magnet.unit
        magnet.room_variance = params.magnet_start**2
        magnet.alone = params.room_density
        _look_anew(magnet, params)
        return
    for i in range(3):
        magnet.total[i] += dt * (c[i, 0] * b[0] + c[i, 1] * b[1] + c[i, 2] * b[2])
    magnet.total_s += dt
    if magnet.total_s < params.mean_s:
        return
    span = magnet.total_s
    z = scratch(3)
    for i in range(3):
        z[i] = magnet.total[i] / (span * magnet.unit)
        magnet.total[i] = 0.0
    magnet.total_s = 0.0
    variance = params.room_density / span
    magnet.room_variance += params.room_walk * span
    for i in range(3):
        magnet.covariance[i, i] += params.room_walk * span
        magnet.covariance[3 + i, 3 + i] += params.magnet_walk * span
    innovation = magnet.room_variance + variance
    away = 0.0
    for i in range(3):
        away += (z[i] - magnet.room[i]) ** 2 / innovation
    if magnet.share < 0.5:
        gain = magnet.room_variance / innovation
        for i in range(3):
            magnet.room[i] += gain * (z[i] - magnet.room[i])
        magnet.room_variance *= 1.0 - gain
    away_pair = _update_pair(magnet, c, z, variance)
    if magnet.share >= 0.5:  # the room is what the better model says
        for i in range(3):
            magnet.room[i] = magnet.pair[i]
        magnet.room_variance = magnet.covariance[0, 0]
    weight = 1.0 - exp(-span / params.window_s)
    magnet.alone += weight * (away * params.room_density / 3.0 - magnet.alone)
    magnet.together += weight * (away_pair * params.room_density / 3.0 - magnet.together)
    gain = 1.5 * params.window_s / params.independent_s * log(magnet.alone / magnet.together)
    magnet.share = 1.0 / (1.0 + exp(min(50.0, params.price - gain)))
    if gain < AGAIN:
        _look_anew(magnet, params)


@kernel
def heading_spread(magnet: Magnet, params: MagnetParams, c: Array) -> float:
    """Return the noise density, s, of the west component of ``share h``; ``c`` (3, 3) is the attitude.

    The variance is that of h, by the innovations that were seen, and of the choice between the models. It lasts for a
    window, so its density is twice the window times as large.
    """
    known, west = 0.0, 0.0
    for i in range(3):
        west += c[1, i] * magnet.pair[3 + i]
        for j in range(3):
            known += c[1, i] * magnet.covariance[3 + i, 3 + j] * c[1, j]
    known *= magnet.together / params.room_density
    return 2.0 * params.window_s * magnet.share * (known + (1.0 - magnet.share) * west * west)
