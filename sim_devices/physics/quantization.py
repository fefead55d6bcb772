"""Quantisation: a grid that the readings show, exactly or under noise that was added after the rounding."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim_devices.physics.effect import Array, Context, Effect, Human, Parameter, Parts, Settings, Signature

GRID_TOLERANCE = 0.06  # of a step: a finer grid may lie over the coarse one


def find_step(y: Array) -> float:
    """Return the step of the grid on which all values of y lie; 0 if none is coarser than rounding in a text file."""
    values = np.unique(y)
    if values.size < 2:
        return 0.0
    span = float(values[-1] - values[0])
    # values that differ by print rounding are one
    values = values[np.concatenate([[True], np.diff(values) > 1e-7 * span])]
    if values.size < 2 or values.size > 0.5 * y.size:
        return 0.0
    d = np.sort(np.diff(values))
    # from the middle, where values are dense
    middle = values[values.size // 2]
    outward = values[np.argsort(np.abs(values - middle))] - middle
    for step in (float(np.median(d)), float(d[0])):
        # refined over more and more values: the step that makes every one a whole number of steps
        for count in (4, 8, 16, 32, 64, 128, 256, 512, values.size):
            whole = np.round(outward[:count] / step)
            step = float(outward[:count] @ whole / (whole @ whole)) if whole.any() else step
        places = outward / step
        if np.max(np.abs(places - np.round(places))) < GRID_TOLERANCE and span / step < 1e5:
            return step
    return 0.0


LUMPED = 0.3  # least length of the mean phasor beyond that of the model's own output
STEPS = (0.5, 4.2)  # of the residual's rms: q / sqrt(12) is all of it at most, and too little of it below


def find_lumps(y: Array, x: Array, rms: float) -> tuple[float, float, float]:
    """Find (step, origin, p) of a grid under noise that was added after the rounding; step 0 if there is none.

    y (n,) clusters at multiples of the step while the model's output x (n,) does not. ``rms`` is that of the residual.

    The characteristic function of y at 1 / step is exp(-2 (pi s / step)^2) for noise of rms s, and next to nothing
    for a smooth distribution (Widrow, Kollar 2008, eq. 4.11). A passage from one cell to the next counts as one sample.
    """
    lo, span = float(y.min()), float(np.ptp(y))
    if rms <= 0.0 or not 4.0 * STEPS[1] * rms < span < 1e5 * rms:
        return 0.0, 0.0, 1.0
    width = 0.1 * rms
    size = 1 << int(np.ceil(np.log2(4 * span / width)))
    edges = lo + width * np.arange(int(span / width) + 2)
    f = np.arange(size // 2) / (size * width)
    wanted = (f > 1 / (STEPS[1] * rms)) & (f < 1 / (STEPS[0] * rms))
    lengths = [np.abs(np.fft.rfft(np.histogram(v, edges)[0], size)[: size // 2]) / y.size for v in (y, x)]
    beyond = np.where(wanted, lengths[0] - lengths[1], 0.0)
    if beyond.max() < LUMPED:
        return 0.0, 0.0, 1.0
    # the half, the third of a step gather as well where noise is small: the coarsest that gathers nearly as much
    first = int(np.argmax(beyond > 0.8 * beyond.max()))
    best = first + int(np.argmax(beyond[first : first + 2 * size // int(span / width)]))
    fine = f[best] + np.linspace(-1.0, 1.0, 101) / (size * width)
    phasors = np.array([np.mean(np.exp(2j * np.pi * v * (y - lo))) for v in fine])
    top = int(np.argmax(np.abs(phasors)))
    step = float(1 / fine[top])
    origin = lo + step * float(np.angle(phasors[top])) / (2 * np.pi)
    cells = np.round((x - origin) / step)
    passages = int(np.count_nonzero(np.diff(cells))) + 1
    length = max(float(np.abs(phasors[top])) - float(np.abs(np.mean(np.exp(2j * np.pi * fine[top] * (x - lo))))), 0.0)
    p = min(1.0, float(np.count_nonzero(wanted)) * float(np.exp(-passages * length**2)))
    return step, origin, max(p, 1e-300)


def _lumps(x: Array, residual: Array, ctx: Context) -> tuple[float, float, float]:
    if ctx.measured is None:
        return 0.0, 0.0, 1.0
    k = ctx.keep
    y, r = ctx.measured[k], residual[k]
    return find_lumps(y, y - r, float(np.sqrt(np.mean(r**2))))


def _grid_prepare(x: Array, residual: Array, ctx: Context) -> Settings:
    y = ctx.measured if ctx.measured is not None else x
    step = find_step(y)
    if step > 0:
        return {"step": (step,), "origin": (float(np.unique(y)[0]),)}
    step, origin, _ = _lumps(x, residual, ctx)
    return {"step": (step,), "origin": (origin,)}


def _grid_parts(settings: Settings) -> Parts:
    step = settings.get("step", (0.0,))[0] or 1.0
    return Parts((Parameter("dither_rms", "{out}", 0.01 * step, 0.6 * step, log=True, scale=0.05 * step),))


def mean_of_steps(x: Array, step: float, origin: float, dither: float) -> Array:
    """Return the expected reading of a rounding quantiser that noise of rms ``dither`` precedes.

    B. Widrow, I. Kollar, Quantization Noise (2008), eq. 16.14: x + step/pi sum (-1)^k/k sin(2 pi k x/step) e^(...).
    """
    z = (x - origin) / step
    s = dither / step
    out = z.copy()
    for k in range(1, 40):
        decay = np.exp(-2 * (np.pi * k * s) ** 2)
        if decay < 1e-9:
            break
        out += (-1.0) ** k * decay / (np.pi * k) * np.sin(2 * np.pi * k * z)
    return origin + step * out


def _grid_apply(x: Array, ctx: Context, q: Array, settings: Settings) -> Array:
    step = settings.get("step", (0.0,))[0]
    if step <= 0:
        return x
    if q[0] < 0.03 * step:
        return settings["origin"][0] + step * np.round((x - settings["origin"][0]) / step)
    return mean_of_steps(x, step, settings["origin"][0], q[0])


def _grid_guess(x: Array, residual: Array, ctx: Context, settings: Settings) -> Sequence[Sequence[float]]:
    step = settings["step"][0] or 1.0
    return ((0.3 * step,), (0.1 * step,), (0.02 * step,))


def _grid_test(x: Array, residual: Array, ctx: Context) -> Signature:
    if ctx.measured is None:
        return Signature(1.0, 0.0)
    step = find_step(ctx.measured)
    power = float(np.mean(residual[ctx.keep] ** 2))
    if power == 0.0:
        return Signature(1.0, 0.0, "no grid")
    if step == 0.0:
        step, _, p = _lumps(x, residual, ctx)
        share = min(1.0, step * step / 12 / power)
        return Signature(p, share, f"readings gather at multiples of {step:g}" if step else "no grid")
    share = min(1.0, step * step / 12 / power)
    # every distinct value but the two that fix the grid lies on it by chance of twice the tolerance
    values = min(max(round(float(np.ptp(ctx.measured)) / step) - 1, 0), 100)
    p = max(1e-300, (2 * GRID_TOLERANCE) ** values) if share > 0.02 else 1.0
    return Signature(p, share, f"all readings lie on a grid of {step:g}")


def _grid_report(p: Array, settings: Settings, scale: float) -> Sequence[Human]:
    return (Human("step", float(settings["step"][0]), "{out}"), Human("dither_rms", float(p[0]), "{out}"))


QUANTIZATION = Effect(
    name="quantization",
    summary="steps coarser than declared",
    kind="nonlinear",
    stages=("acquisition", "sensor"),
    parts=_grid_parts,
    equation=r"y = \Delta\,\mathrm{round}(x/\Delta)",
    source="B. Widrow, I. Kollar, Quantization Noise, Cambridge 2008, chapters 4 and 16",
    excitation="slow parts, where the steps are visible one by one",
    confusable_with=(),
    prepare=_grid_prepare,
    guess=_grid_guess,
    apply=_grid_apply,
    test=_grid_test,
    report=_grid_report,
    sites=("output",),
)
