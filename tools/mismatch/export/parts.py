"""Numpy functions that are copied into exported twins, each with all that it needs.

A function with memory returns a function of samples (n,) that goes on where its last call stopped: a whole record in
one call, or sample by sample in an FMU. ``stops`` gives (n, elements), others (n,) unless they say so.
"""

import numpy as np


def low_pass(tau, dt, rest=None, settled=1.0):
    """tau y' = x - y for x straight between samples, exact; begins at ``rest``, else at ``settled`` times x."""
    decay = np.exp(-dt / np.asarray(tau))
    ramp = 1 - (1 - decay) * tau / dt
    y = before = None

    def run(x):
        nonlocal y, before
        out = []
        for v in x:
            if y is None:
                y = (settled * v if rest is None else rest) + 0.0 * decay
            else:
                y = decay * y + (1 - decay) * before + ramp * (v - before)
            before = v
            out.append(y)
        return np.array(out)

    return run


def mode(frequency_Hz, damping, dt, settled=1.0):
    """z'' + 2 D w z' + w^2 z = w^2 x for x straight between samples, exact; gives z and z'/w, (n,) each."""
    w = 2 * np.pi * frequency_Hz
    state, g0, g1 = discretise(np.array([[0, w], [-w, -2 * damping * w]]), np.array([[0.0], [w]]), dt, "linear")
    z = before = None

    def run(x):
        nonlocal z, before
        out = np.empty((len(x), 2))
        for k, v in enumerate(x):
            z = np.array([settled * v, 0.0]) if z is None else state @ z + g0[:, 0] * before + g1[:, 0] * v
            before, out[k] = v, z
        return out.T

    return run


def resample(first, step, bend, cubic):
    """x at the samples first + (step + bend k) k, by cubic convolution (Keys 1981, eq. 15) or on straight lines."""
    seen = np.empty(0)

    def run(x):
        nonlocal seen
        k = np.arange(len(seen), len(seen) + len(x))
        seen = np.append(seen, x)
        last = len(seen) - 1
        if last == 0:
            return seen
        at = np.clip(first + (step + bend * k) * k, 0, last)
        i = np.minimum(at.astype(int), last - 1)
        s = at - i
        a, b, c, d = (np.r_[2 * seen[0] - seen[1], seen, 2 * seen[-1] - seen[-2]][i + j] for j in range(4))
        if not cubic:
            return b + s * (c - b)
        return b + 0.5 * s * (c - a + s * (2 * a - 5 * b + 4 * c - d + s * (3 * (b - c) + d - a)))

    return run


def stops(radii, rest=None, first=0.0):
    """Stop operators E = x - P of plays P = max(x - r, min(x + r, P)) (Kuhnen 2003, eq. 2), (n, elements).

    P begins at ``rest``, else so that E begins at ``first`` r."""
    radii = np.asarray(radii)
    play = None if rest is None else np.full(len(radii), float(rest))

    def run(x):
        nonlocal play
        out = np.empty((len(x), len(radii)))
        for k, v in enumerate(x):
            if play is None:
                play = v - np.clip(first, -1, 1) * radii
            play = np.maximum(v - radii, np.minimum(v + radii, play))
            out[k] = v - play
        return out

    return run


def dahl(radii, skew, rest):
    """dz = dx - (|dx| z + g dx |z|) / r, exact for any step (Dahl 1976; Wen 1976, eq. 3), (n, elements)."""
    unload, load = (1 - np.asarray(skew)) / radii, (1 + np.asarray(skew)) / radii
    z, before = np.zeros(len(radii)), float(rest)

    def run(x):
        nonlocal z, before
        out = np.empty((len(x), len(radii)))
        for k, v in enumerate(x):
            if v != before:
                sign, way = np.sign(v - before), abs(v - before)
                u = sign * z
                back = np.minimum(u, 0.0)
                relaxed = back - (1 / unload - back) * np.expm1(-unload * way)
                rest_of_way = np.maximum(way - np.log1p(-back * unload) / unload, 0.0)
                u = np.maximum(u, 0.0)
                loaded = u - (1 / load - u) * np.expm1(-load * rest_of_way)
                z = sign * np.where((back < 0) & (relaxed < 0), relaxed, loaded)
                before = v
            out[k] = z
        return out

    return run


def relays(lo, hi, count):
    """Smooth relays on a triangular grid (Krasnosel'skii and Pokrovskii 1989, section 36), (n, elements)."""
    width = (hi - lo) / count
    fall, rise = np.triu_indices(count)
    state = np.full(len(rise), -1.0)

    def run(x):
        nonlocal state
        out = np.empty((len(x), len(rise)))
        for k, v in enumerate(x):
            up = np.clip(2 * (v - lo - rise * width) / width - 1, -1, 1)
            down = np.clip(2 * (v - lo - fall * width) / width - 1, -1, 1)
            state = np.maximum(up, np.minimum(down, state))
            out[k] = state
        return out

    return run


def slope(dt):
    """Smoothed slope of a record; where samples come one by one, the difference to the last one."""
    before = None

    def run(x):
        nonlocal before
        if len(x) > 2:
            d, ones = np.gradient(x, dt), np.ones(len(x))
            d = np.convolve(d, np.ones(3), "same") / np.convolve(ones, np.ones(3), "same")
        else:
            d = np.diff(x, prepend=x[0] if before is None else before) / dt
        before = x[-1]
        return d

    return run


def derivative(dt):
    """Derivative of (n, 3) by central differences; where samples come one by one, the difference to the last one."""
    before = None

    def run(x):
        nonlocal before
        if len(x) > 2:
            d = np.gradient(x, dt, axis=0, edge_order=2)
        else:
            d = np.diff(x, axis=0, prepend=x[:1] if before is None else before) / dt
        before = x[-1:]
        return d

    return run


def slew(up, down, tau, dt, rounded=False, parts=8):
    """tau y' = x - y with y' between -down and up (or bent towards them), in ``parts`` steps a sample."""
    share, up, down = -np.expm1(-dt / parts / tau), up * dt / parts, down * dt / parts
    y = before = None

    def run(x):
        nonlocal y, before
        out = np.empty(len(x))
        for k, v in enumerate(x):
            y, before = (v, v) if y is None else (y, before)
            for j in range(1, parts + 1):
                d = share * (before + (v - before) * j / parts - y)
                most = up if d > 0 else down
                y += most * np.tanh(d / most) if rounded else min(max(d, -down), up)
            before, out[k] = v, y
        return out

    return run


def limit(x, lo, hi, corner):
    """Between two limits, with corners rounded over the width ``corner``."""
    x = hi - corner * np.logaddexp(0, (hi - x) / corner)
    return lo + corner * np.logaddexp(0, (x - lo) / corner)


def conducted(x, knee, width, side):
    """Voltage across a diode that x feeds through a resistance: y = x - width w, w + ln w = (x - knee) / width."""
    z = np.maximum((side * x - knee) / width, -700.0)
    w = np.where(z > 1.0, z, np.exp(np.minimum(z, 1.0) - np.exp(np.minimum(z, 1.0) - 1.0)))
    for _ in range(6):  # Fritsch, Shafer, Crowley, Comm. ACM 16 (1973) 123
        r = z - w - np.log(w)
        q = 2.0 * (1.0 + w) * (1.0 + w + 2.0 * r / 3.0)
        w = w * (1.0 + r / (1.0 + w) * (q - r) / (q - 2.0 * r))
    return x - side * width * w


def legendre(x, lo, hi, degree):
    """Legendre polynomials 2 .. degree over lo .. hi, continued by their tangents, (n, degree - 1)."""
    z = (x - 0.5 * (lo + hi)) / (0.5 * (hi - lo))
    inside = np.clip(z, -1, 1)
    p = [np.polynomial.Legendre.basis(d) for d in range(2, degree + 1)]
    return np.stack([q(inside) + q.deriv()(inside) * (z - inside) for q in p], axis=1)


def rounded(x, step, origin, dither):
    """Mean reading of a quantiser under noise of rms ``dither`` (Widrow and Kollar 2008, eq. 16.14)."""
    z = (x - origin) / step
    if dither < 0.03 * step:
        return origin + step * np.round(z)
    k = np.arange(1, 40)
    decay = np.exp(-2 * (np.pi * k * dither / step) ** 2)
    k, decay = k[decay >= 1e-9], decay[decay >= 1e-9]
    return origin + step * (z + np.sin(2 * np.pi * z[:, None] * k) @ ((-1.0) ** k * decay / (np.pi * k)))


def exponential(m):
    """Matrix exponential by scaling, an 18-term series and squaring (Moler and Van Loan 2003, method 3)."""
    halvings = max(0, int(np.ceil(np.log2(max(np.abs(m).sum(axis=1).max(), 1e-300)))) + 1)
    out = term = np.eye(len(m))
    for k in range(1, 19):
        term = term @ m / (k * 2.0**halvings)
        out = out + term
    return np.linalg.matrix_power(out, 2**halvings)


def discretise(a, b, dt, hold):
    """ad, g0, g1 of x[k+1] = ad x[k] + g0 u[k] + g1 u[k+1], exact for held ("zero") or straight u (Van Loan 1978)."""
    if hold == "discrete":
        return a, b, 0 * b
    s, m = b.shape
    e = exponential(np.block([[a * dt, b * dt, 0 * b], [np.zeros((m, s + m)), np.eye(m)], [np.zeros((m, s + 2 * m))]]))
    held, ramp = e[:s, s : s + m], e[:s, s + m :] * (np.array(hold) != "zero")
    return e[:s, :s], held - ramp, ramp


def smoothed(u):
    """Samples (n,) or (n, inputs) between which an input without content above half the rate may run straight."""
    w = np.linspace(0.0, 0.9 * np.pi, 1024)
    waves = 2.0 * (np.cos(np.outer(w, np.arange(1, 13))) - 1.0)
    side = np.linalg.lstsq(waves, np.sinc(w / (2 * np.pi)) ** -2 - 1.0, rcond=None)[0]  # lines: times sinc^2
    taps = np.concatenate([side[::-1], [1.0 - 2.0 * side.sum()], side])
    each = [np.convolve(np.pad(c, 12, mode="edge"), taps, "valid") for c in np.atleast_2d(u.T)]
    return np.stack(each, axis=1) if u.ndim > 1 else each[0]


def linear(a, b, dt, hold, x):
    """States (n, order) of x' = a x + b u (or x[k+1] = a x + b u) for inputs (n, inputs), from the state ``x``."""
    ad, g0, g1 = discretise(a, b, dt, hold)
    before = None

    def run(u):
        nonlocal x, before
        out = np.empty((len(u), len(a)))
        for k, now in enumerate(u):
            x = x if before is None else ad @ x + g0 @ before + g1 @ now
            before, out[k] = now, x
        return out

    return run


def bent(e, z):
    """Stops whose weight varies along the range z, (n, elements + 2 times every second one)."""
    return np.hstack([e, e[:, 1:10:2] * z, e[:, 1:10:2] * z * z])


def curved(e, x, weights, lo, hi, degree):
    """Stops, and a curve on the loop that they make with ``weights`` (Kuhnen 2003, section 4), (n, columns)."""
    return np.hstack([e, legendre(x + e @ np.array(weights), lo, hi, degree)])


def loop_with_speed(x, e, speed, late, late_x):
    """Elements, every second one times log(1 + speed) and behind a lag, and the lag of x (Ang 2007, eqs. 12-15)."""
    fast = e[:, ::2]
    return np.column_stack([e, fast * np.log1p(np.abs(speed))[:, None], late(fast) - fast, late_x(x) - x])
