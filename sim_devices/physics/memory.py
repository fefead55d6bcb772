"""Computes operators with rate-independent memory: plays and stops, Dahl elements, relays."""

from __future__ import annotations

import numpy as np

from hal.compiled import kernel


@kernel
def stops(x, thresholds, rest, starts):
    """Stop operators E_r[x] = x - P_r[x] of the play operator P_r, (n, k); |E_r| <= r.

    P_r(t) = max(x - r, min(x + r, P_r(t-)))  (Kuhnen 2003, eq. 2); memory starts at ``rest`` at each start.
    """
    n, k = x.size, thresholds.size
    out = np.empty((k, n))
    for j in range(k):
        r = thresholds[j]
        s = 0
        p = rest
        for i in range(n):
            if s < starts.size and i == starts[s]:
                s += 1
                p = rest
            v = x[i]
            p = max(v - r, min(v + r, p))
            out[j, i] = v - p
    return out.T


def thresholds(half: float, count: int) -> tuple[float, ...]:
    """Denser at small radii, where loops turn: half times ((i)/(n + 1/2))^1.5."""
    return tuple(float(half * (i / (count + 0.5)) ** 1.5) for i in range(1, count + 1))


@kernel
def risen(y):
    """1 - exp(-y) for y >= 0: steps of a recording are short, where the series (error below 1e-16) saves the call."""
    if y > 0.03:
        return 1.0 - np.exp(-y)
    bend = 1.0 - y * (1 / 5 - y * (1 / 30 - y / 210))
    return y * (1.0 - 0.5 * y * (1.0 - y * (1 / 3) * (1.0 - 0.25 * y * bend)))


@kernel
def dahl(x, radii, skew, rest, starts):
    """Smooth elements dz = dx - (|dx| z + g dx |z|) / r, (n, k), exact for any step; z = 0 at ``rest`` at each start.

    P. R. Dahl, AIAA J. 14 (1976) 1675 (g = 0); Y. K. Wen, J. Eng. Mech. 102 (1976) 249, eq. 3 with n = 1.
    """
    n, k = x.size, radii.size
    out = np.empty((k, n))
    for j in range(k):
        r, g = radii[j], skew[j]
        a = (1.0 - g) / r
        b = (1.0 + g) / r
        z = 0.0
        before = rest
        s = 0
        for i in range(n):
            if s < starts.size and i == starts[s]:
                s += 1
                z = 0.0
                before = rest
            d = x[i] - before
            before = x[i]
            if d != 0.0:
                sign = 1.0 if d > 0.0 else -1.0
                d = abs(d)
                u = sign * z
                if u < 0.0:
                    relaxed = u + (1.0 / a - u) * risen(a * d)
                    if relaxed < 0.0:
                        u = relaxed
                        d = 0.0
                    else:
                        d -= np.log(1.0 - u * a) / a  # what is left of the travel when it has relaxed to zero
                        u = 0.0
                if d > 0.0:
                    u += (1.0 / b - u) * risen(b * d)
                z = sign * u
            out[j, i] = z
    return out.T


@kernel
def relays(x, lo, hi, count, starts):
    """Relays with ridges of one grid step, rising at g[q], falling at g[p], p <= q, (n, count (count + 1) / 2).

    M. A. Krasnosel'skii, A. V. Pokrovskii, Systems with Hysteresis (1989), section 36; all down at each start.
    """
    n = x.size
    out = np.empty((count * (count + 1) // 2, n))
    w = (hi - lo) / count
    c = 0
    for p in range(count):
        for q in range(p, count):
            v = -1.0
            s = 0
            for i in range(n):
                if s < starts.size and i == starts[s]:
                    s += 1
                    v = -1.0
                up = min(max(2.0 * (x[i] - lo - q * w) / w - 1.0, -1.0), 1.0)
                down = min(max(2.0 * (x[i] - lo - p * w) / w - 1.0, -1.0), 1.0)
                v = max(up, min(down, v))
                out[c, i] = v
            c += 1
    return out.T
