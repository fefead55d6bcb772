"""(g) Diagnosis of a recording: a minute at 1 kHz end to end, one candidate, growth with length, jobs, and what pysindy
and SysIdentPy do with the same recording: they fit one model, name no physics and hold nothing out by themselves."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.row import Row, exponent, process_cpu_s

RATE_HZ = 1000.0
SECONDS = (15.0, 60.0, 240.0)
LONG_S = 1800.0
PATIENCE_S = 200.0
"""Of wall time, after which the longest recording is left out: a module is stopped after ten minutes, and that one
alone is a minute or two of CPU. ``MICRON_BENCH_LONG=1`` (make bench LONG=1) takes it in any case."""
GOAL_S = 30.0


def stack_recording(seconds: float):
    """A piezo stack under a wandering sum of sines: Bouc-Wen hysteresis (not the engine's own form), noise 0.02 um."""
    from tools.mismatch.recording import Recording, Split, TwinText

    n = round(seconds * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    rng = np.random.default_rng(1)
    slow = 1.0 + 0.4 * np.sin(2 * np.pi * 0.11 * t)
    u = 50.0 + slow * (18.0 * np.sin(2 * np.pi * 1.3 * t) + 7.0 * np.sin(2 * np.pi * 8.7 * t + 0.4))
    z = np.zeros(n)
    for k in range(1, n):
        du = u[k] - u[k - 1]
        z[k] = z[k - 1] + 0.4 * du - 0.05 * abs(du) * z[k - 1] - 0.02 * du * abs(z[k - 1])
    y = 0.13 * u + 0.03 * z + 0.02 * rng.standard_normal(n)
    return Recording(
        Path("benchmark.toml"), "benchmark", t, 1.0 / RATE_HZ, {"command": u}, {"displacement": y}, {},
        {"displacement": 0.02}, {"command": "V", "displacement": "um"}, {"command": "u", "displacement": "y"},
        TwinText("piezo_stack", {"gain_um_per_V": 0.125}, ()), Split(),
    )  # fmt: skip


def axis_recording(seconds: float):
    """A mass with drag under three sines of force, held back by dry friction that falls with speed (a smooth law, not
    the engine's): the plants that are integrated step by step are the dearest.
    """
    from tools.mismatch.recording import Recording, Split, TwinText

    n, sub = round(seconds * RATE_HZ), 8
    t = np.arange(n) / RATE_HZ
    rng = np.random.default_rng(2)
    force = 6.0 * np.sin(2 * np.pi * 1.1 * t) + 4.0 * np.sin(2 * np.pi * 2.7 * t + 1.0) + np.sin(2 * np.pi * 7.3 * t)
    v, step_s = 0.0, 1.0 / RATE_HZ / sub
    velocity = np.zeros(n)
    for k in range(1, n):
        for m in range(sub):
            push = force[k - 1] + (force[k] - force[k - 1]) * (m + 0.5) / sub
            against = (0.8 + 0.4 * math.exp(-abs(v) / 0.02)) * math.tanh(v / 2e-3)
            v += step_s * (push - against - 3.0 * v) / 0.9
        velocity[k] = v
    measured = velocity + 0.004 * rng.standard_normal(n)
    return Recording(
        Path("benchmark.toml"), "benchmark", t, 1.0 / RATE_HZ, {"force": force}, {"velocity": measured}, {},
        {"velocity": 0.004}, {"force": "N", "velocity": "m/s"}, {"force": "u", "velocity": "v"},
        TwinText("mechanical_axis", {"mass": 0.9, "damping": 3.2, "stiffness": 0.0}, ()), Split(),
    )  # fmt: skip


ORDERS = ((16, 1, 3), (64, 2, 2))
"""Numbers of states, inputs and outputs of the state spaces of which a column is measured."""


def column_s(order: int, inputs: int, outputs: int) -> tuple[float, int]:
    """(CPU s of a column of the Jacobian of the poles, linear parameters that are solved anew in each): two minutes at
    400 Hz of lightly damped modes in noise.
    """
    from tools.mismatch.engine.fit import slopes
    from tools.mismatch.engine.pose import make_split
    from tools.mismatch.engine.problem import Problem
    from tools.mismatch.engine.projected import Projected
    from tools.mismatch.recording import Recording, Split, TwinText
    from tools.mismatch.twins.make import make

    n, rate_hz, rng = 48_000, 400.0, np.random.default_rng(order)
    a = np.zeros((order, order))
    for i, w in enumerate(np.exp(np.linspace(np.log(5.0), np.log(400.0), order // 2))):
        a[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[0.0, w], [-w, -0.02 * w]]
    b, c = rng.standard_normal((order, inputs)), rng.standard_normal((outputs, order))
    signals = {f"u{i}": rng.standard_normal(n) for i in range(inputs)}
    measured = {f"y{k}": rng.standard_normal(n) for k in range(outputs)}
    names = (*signals, *measured)
    text = TwinText("state_space", {"A": a.tolist(), "B": b.tolist(), "C": c.tolist()}, ())
    recording = Recording(
        Path("benchmark.toml"), "benchmark", np.arange(n) / rate_hz, 1.0 / rate_hz, signals, measured, {},
        dict.fromkeys(measured), dict.fromkeys(names, "V"), {s: s for s in names}, text, Split(),
    )  # fmt: skip
    twin = make(recording)
    problem = Problem(recording, twin, make_split(recording, 0.3, 0, False), 0, 0, settle=True)
    model = problem.base()
    projected = Projected(problem, model, twin.outputs, 12_000 // outputs)
    residual, theta = projected.evaluate(model.start(recording))
    cpu = time.process_time()
    slopes(projected, theta, residual)
    return (time.process_time() - cpu) / len(projected.free), len(model.linear)


def measure(seconds: float, jobs: int, make: Callable[[float], Any] = stack_recording) -> tuple[float, float, int]:
    """(wall s, CPU s of this process, candidates that were screened)."""
    from tools.mismatch.infer import diagnose

    recording = make(seconds)
    wall, cpu = time.perf_counter(), time.process_time()
    report = diagnose(recording, jobs=jobs)
    return time.perf_counter() - wall, time.process_time() - cpu, len(report.tested)


def peers(recording: Any) -> Iterator[Row]:
    """The nearest general tools: one call of the kind that their documents show, on the recording's first minute."""
    import pysindy
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import AOLS

    u, y = recording.inputs["command"][:, None], recording.outputs["displacement"][:, None]

    def sindy() -> None:
        # displacement and a memory of it as states, driven by the command
        model = pysindy.SINDy(optimizer=pysindy.STLSQ(threshold=1e-4), feature_library=pysindy.PolynomialLibrary(2))
        model.fit(y, t=1.0 / RATE_HZ, u=u)

    def narx() -> None:
        # FROLS, which chooses the number of terms itself, fails with numpy 2.4 (SysIdentPy 0.2.1)
        AOLS(ylag=2, xlag=2, k=8, L=1, basis_function=Polynomial(degree=2)).fit(X=u, y=y)

    yield from (
        Row(f"mismatch, {name}", "one fit of one model: no candidates, no names, nothing held out", np.nan,
            process_cpu_s(function), name, "s", np.nan)
        for name, function in (("pysindy", sindy), ("SysIdentPy, AOLS", narx))
    )  # fmt: skip


def within_goal(what: str, wall_s: float, cpu_s: float, cores: int) -> Row:
    """The row of a minute's recording against what the engine may take."""
    reached = wall_s <= GOAL_S
    return Row(
        f"mismatch, {what}", f"all candidates, wall time with {cores} processes; CPU of one process {cpu_s:.1f} s",
        wall_s, GOAL_S, "allowed", "s", wall_s / GOAL_S, f"<= {GOAL_S:g} s", reached, must=True,
        why="" if reached else f"wall time on a shared machine: {cpu_s:.1f} s of CPU with one process",
    )  # fmt: skip


def rows() -> Iterator[Row]:
    began_s = time.perf_counter()
    for make in (stack_recording, axis_recording):
        measure(4.0, 1, make)  # kernels compiled or read
    short_s, minute_s, longer_s = SECONDS
    costs = [measure(short_s, 1)[1]]
    alone_s, cpu_s, screened = measure(minute_s, 1)
    costs.append(cpu_s)
    cores = min(2, os.cpu_count() or 1)
    wall_s = measure(minute_s, cores)[0] if cores > 1 else alone_s
    yield within_goal(f"{minute_s:g} s at 1 kHz, stack", wall_s, cpu_s, cores)
    yield Row(
        "mismatch, more processes", f"wall time with {cores} against 1; CPU of the one {cpu_s:.1f} s", wall_s, alone_s,
        "one process", "s", alone_s / wall_s,
    )  # fmt: skip
    share_s = cpu_s / max(screened, 1)
    yield Row(
        "mismatch, one candidate", f"CPU of the whole diagnosis over the {screened} effects at places that it tried",
        share_s, cpu_s, "whole diagnosis", "s", share_s / cpu_s,
    )  # fmt: skip
    axis_alone_s, axis_cpu_s, _ = measure(minute_s, 1, axis_recording)
    axis_wall_s = measure(minute_s, cores, axis_recording)[0] if cores > 1 else axis_alone_s
    yield within_goal(f"{minute_s:g} s at 1 kHz, axis with friction", axis_wall_s, axis_cpu_s, cores)
    costs.append(measure(longer_s, 1)[1])
    lengths = SECONDS
    if os.environ.get("MICRON_BENCH_LONG") == "1" or time.perf_counter() - began_s < PATIENCE_S:
        lengths = (*SECONDS, LONG_S)
        costs.append(measure(LONG_S, 1)[1])
    grows = exponent(lengths, costs)
    each = ", ".join(f"{seconds:g} s: {cost:.1f}" for seconds, cost in zip(lengths, costs, strict=True))
    left_out = "" if LONG_S in lengths else f"; {LONG_S:g} s left out on so busy a machine"
    yield Row(
        "mismatch, growth with length", f"exponent of CPU; s of CPU for {each}{left_out}", grows, 1.0, "linear", "1",
        grows, "<= 1.2", grows <= 1.2, must=True,
    )  # fmt: skip
    column_s(4, 1, 1)  # kernels compiled or read
    for order, inputs, outputs in ORDERS:
        cost, solved = column_s(order, inputs, outputs)
        yield Row(
            f"mismatch, column of order {order}",
            f"CPU of a derivative by a pole; {inputs} in, {outputs} out, {solved} linear parameters, 48 000 samples",
            1e3 * cost, np.nan, "", "ms", np.nan,
        )  # fmt: skip
    yield from peers(stack_recording(minute_s))
