"""Sequential kernels of the prover's own physics: memory operators and a one-axis machine.

They share no code and, where there is a choice, no mathematical form with the tool under test.
All arrays are one-dimensional and on the prover's fine time grid.
"""

from __future__ import annotations

import numpy as np

from hal.compiled import kernel


@kernel
def bouc_wen(x, a, beta, gamma_up, gamma_down, power):
    """Rate-independent Bouc-Wen memory z of the drive x (Bouc 1967, Wen 1976).

    ``gamma_up`` holds for z > 0 and ``gamma_down`` for z < 0, which makes the loop asymmetric.
    """
    z = np.zeros(x.size)
    for i in range(1, x.size):
        parts = 1 + int(abs(x[i] - x[i - 1]) / 0.02)
        dx = (x[i] - x[i - 1]) / parts
        v = z[i - 1]
        for _ in range(parts):
            gamma = gamma_up if v > 0 else gamma_down
            v += a * dx - (beta * abs(dx) * v * abs(v) ** (power - 1.0) + gamma * dx * abs(v) ** power)
        z[i] = v
    return z


@kernel
def bouc_wen_rate(x, dt, a, beta, gamma, exponent, rate0, leak):
    """Bouc-Wen memory whose dissipation grows with speed and whose state leaks (1/s)."""
    z = np.zeros(x.size)
    for i in range(1, x.size):
        speed = abs(x[i] - x[i - 1]) / dt
        factor = (1.0 + speed / rate0) ** exponent
        parts = 1 + int(abs(x[i] - x[i - 1]) * factor / 0.02)
        dx = (x[i] - x[i - 1]) / parts
        h = dt / parts
        v = z[i - 1]
        for _ in range(parts):
            v += a * dx - factor * (beta * abs(dx) * v + gamma * dx * abs(v)) - leak * v * h
        z[i] = v
    return z


@kernel
def relays(x, up, down, weight):
    """Preisach sum of delayed relays; ``up`` >= ``down`` are the switching values."""
    state = np.empty(up.size)
    for k in range(up.size):
        state[k] = 1.0 if x[0] > 0.5 * (up[k] + down[k]) else -1.0
    out = np.empty(x.size)
    total = np.sum(state * weight)
    out[0] = total
    for i in range(1, x.size):
        if x[i] > x[i - 1]:
            for k in range(up.size):
                if state[k] < 0 and x[i] >= up[k]:
                    state[k] = 1.0
                    total += 2.0 * weight[k]
        elif x[i] < x[i - 1]:
            for k in range(up.size):
                if state[k] > 0 and x[i] <= down[k]:
                    state[k] = -1.0
                    total -= 2.0 * weight[k]
        out[i] = total
    return out


@kernel
def slip_elements(x, stiffness, reach):
    """Generalised Maxwell-slip: springs that slide when stretched beyond their reach."""
    stretch = np.zeros(stiffness.size)
    out = np.zeros(x.size)
    for i in range(1, x.size):
        dx = x[i] - x[i - 1]
        s = 0.0
        for k in range(stiffness.size):
            e = min(max(stretch[k] + dx, -reach[k]), reach[k])
            stretch[k] = e
            s += stiffness[k] * e
        out[i] = s
    return out


@kernel
def jiles(x, shape, pinning, reversible, coupling):
    """Magnetisation-like memory after Jiles and Atherton (1986), normalised to one."""
    out = np.zeros(x.size)
    irr = 0.0
    m = 0.0
    for i in range(1, x.size):
        parts = 1 + int(abs(x[i] - x[i - 1]) / 0.01)
        dx = (x[i] - x[i - 1]) / parts
        for j in range(parts):
            he = (x[i - 1] + (j + 1) * dx + coupling * m) / shape
            an = he / 3.0 if abs(he) < 1e-3 else 1.0 / np.tanh(he) - 1.0 / he
            sign = 1.0 if dx > 0 else -1.0
            gap = an - irr
            if gap * sign > 0:
                irr += gap * sign / pinning * abs(dx) * sign
            m = (1.0 - reversible) * irr + reversible * an
        out[i] = m
    return out


@kernel
def hodgdon(x, speed, slope_line, slope_inner):
    """Coleman-Hodgdon differential memory: dz = a |dx| (b x - z) + c dx."""
    z = np.zeros(x.size)
    for i in range(1, x.size):
        parts = 1 + int(abs(x[i] - x[i - 1]) * speed / 0.05)
        dx = (x[i] - x[i - 1]) / parts
        v = z[i - 1]
        for j in range(parts):
            xv = x[i - 1] + (j + 0.5) * dx
            v += speed * abs(dx) * (slope_line * xv - v) + slope_inner * dx
        z[i] = v
    return z


@kernel
def free_play(x, half_gap, compliance):
    """Free play; inside the gap the output still follows with a small share ``compliance``."""
    y = np.empty(x.size)
    centre = x[0]
    y[0] = x[0]
    for i in range(1, x.size):
        d = x[i] - centre
        if d > half_gap:
            centre = x[i] - half_gap
        elif d < -half_gap:
            centre = x[i] + half_gap
        y[i] = centre + compliance * (x[i] - centre)
    return y


@kernel
def limited_rate(x, step_max, soft):
    """Follower whose step is limited; ``soft`` > 0 rounds the limit off (in units of x)."""
    y = np.empty(x.size)
    y[0] = x[0]
    for i in range(1, x.size):
        d = x[i] - y[i - 1]
        if soft > 0.0:
            y[i] = y[i - 1] + min(step_max * np.tanh(abs(d) / (step_max + soft)), abs(d)) * np.sign(d)
        else:
            y[i] = y[i - 1] + min(max(d, -step_max), step_max)
    return y


@kernel
def linear_system(a, b, c, d, x0, u):
    """Discrete linear system, u of shape (n, inputs): y of shape (n, outputs)."""
    n, m = u.shape
    ns = a.shape[0]
    ny = c.shape[0]
    y = np.empty((n, ny))
    x = x0.copy()
    new = np.empty(ns)
    for i in range(n):
        for r in range(ny):
            v = 0.0
            for k in range(ns):
                v += c[r, k] * x[k]
            for k in range(m):
                v += d[r, k] * u[i, k]
            y[i, r] = v
        for r in range(ns):
            v = 0.0
            for k in range(ns):
                v += a[r, k] * x[k]
            for k in range(m):
                v += b[r, k] * u[i, k]
            new[r] = v
        for r in range(ns):
            x[r] = new[r]
    return y


@kernel
def _rates(x, v, z, w, force, p):
    """Right-hand side of the axis: (acceleration, friction state rate, loop state rate)."""
    m, c, k, k3, k5 = p[0], p[1], p[2], p[3], p[4]
    f = force - c * v - k * x - k3 * x**3 - k5 * x**5
    if p[5] != 0.0:
        ph = 2.0 * np.pi * x / p[6] + p[7]
        f -= p[5] * (np.sin(ph) + p[8] * np.sin(2.0 * ph + 0.7))
    dz = 0.0
    kind = int(p[9])
    if kind == 1:
        f -= p[10] * np.tanh(v / p[12])
    elif kind == 3 or kind == 4:
        r = (v / p[12]) ** 2
        curve = np.exp(-r) if p[15] < 0.5 else 1.0 / (1.0 + r)
        g = p[10] + (p[11] - p[10]) * curve
        if kind == 4:
            ratio = 1.0 - p[13] * z / p[10] * np.sign(v)
            dz = v * abs(ratio) * np.sign(ratio)
            f -= p[13] * z
        else:
            dz = v - p[13] * abs(v) / g * z
            f -= p[13] * z + p[14] * dz
    dw = 0.0
    if p[16] != 0.0:
        xn = v / p[17]
        dw = xn - p[18] * abs(xn) * w - p[19] * xn * abs(w)
        f -= p[16] * w
    return f / m, dz, dw


@kernel
def axis(force, dt, p, x0, v0):
    """Mass on a spring with optional friction, cubic spring, cogging and a hysteretic spring.

    Runge-Kutta 4 with the force linear within a step. ``p``: mass, damping, stiffness, k3, k5, cogging
    force, pitch, phase, second harmonic, friction kind (0 none, 1 tanh, 2 Karnopp, 3 LuGre, 4 Dahl), sliding
    friction, static friction, Stribeck speed, bristle stiffness, bristle damping, curve (0 exponential,
    1 Lorentzian), loop force, loop yield, loop beta, loop gamma. Returns position and velocity.
    """
    n = force.size
    xs = np.empty(n)
    vs = np.empty(n)
    x, v, z, w = x0, v0, 0.0, 0.0
    stuck = False
    kind = int(p[9])
    for i in range(n):
        xs[i] = x
        vs[i] = v
        if i == n - 1:
            break
        f0 = force[i]
        f1 = force[i + 1]
        fm = 0.5 * (f0 + f1)
        if kind == 2:
            a0, _, _ = _rates(x, 0.0, z, w, fm, p)
            if stuck and abs(a0 * p[0]) <= p[11]:
                v = 0.0
                continue
            direction = np.sign(v)
            if stuck or direction == 0.0:
                direction = np.sign(a0)
            r = (v / p[12]) ** 2
            curve = np.exp(-r) if p[15] < 0.5 else 1.0 / (1.0 + r)
            fr = direction * (p[10] + (p[11] - p[10]) * curve)
            f0 -= fr
            f1 -= fr
            fm -= fr
            stuck = False
        # bristles are stiff: as many parts as keep a Runge-Kutta step stable
        parts = 1
        if kind >= 3:
            parts = 1 + int(2.0 * dt * p[13] * abs(v) / p[10])
        h = dt / parts
        df = (f1 - f0) / parts
        last = v
        for j in range(parts):
            g0 = f0 + j * df
            gm = g0 + 0.5 * df
            a1, z1, w1 = _rates(x, v, z, w, g0, p)
            v2 = v + 0.5 * h * a1
            a2, z2, w2 = _rates(x + 0.5 * h * v, v2, z + 0.5 * h * z1, w + 0.5 * h * w1, gm, p)
            v3 = v + 0.5 * h * a2
            a3, z3, w3 = _rates(x + 0.5 * h * v2, v3, z + 0.5 * h * z2, w + 0.5 * h * w2, gm, p)
            v4 = v + h * a3
            a4, z4, w4 = _rates(x + h * v3, v4, z + h * z3, w + h * w3, g0 + df, p)
            x += h / 6.0 * (v + 2 * v2 + 2 * v3 + v4)
            v += h / 6.0 * (a1 + 2 * a2 + 2 * a3 + a4)
            z += h / 6.0 * (z1 + 2 * z2 + 2 * z3 + z4)
            w += h / 6.0 * (w1 + 2 * w2 + 2 * w3 + w4)
        if kind == 2 and v * last < 0.0:
            # at rest only where the other forces cannot break it loose: else it passes through zero
            a0, _, _ = _rates(x, 0.0, z, w, force[i + 1], p)
            if abs(a0 * p[0]) <= p[11]:
                v = 0.0
                stuck = True
    return xs, vs
