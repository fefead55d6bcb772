"""Simulates linear time-invariant plants: exact discretisation, compiled runs, start states from measured samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from hal.compiled import kernel
from sim_devices.physics.effect import Array
from sim_devices.physics.exponential import exponential
from tools.mismatch.twins.memo import remember, stored

if TYPE_CHECKING:
    from tools.mismatch.twins.base import Path, Run

Hold = Literal["zero", "linear", "smooth", "discrete"]
"""Course of an input between its samples: held, straight, or without content above half the sampling rate."""

SIDE_TAPS = 12
BAND = 0.9
"""Share of the band below half the sampling rate in which a smooth input is reproduced."""


@cache
def smooth_taps() -> tuple[float, ...]:
    """Return the filter (2 ``SIDE_TAPS`` + 1) after which straight lines between samples have the input's spectrum.

    Lines multiply a spectrum by sinc^2 (A. V. Oppenheim, R. W. Schafer, Discrete-Time Signal Processing, 3rd ed.,
    section 4.8.3); the taps fit its inverse by least squares over the ``BAND`` and leave a constant unchanged.
    """
    w = np.linspace(0.0, BAND * np.pi, 1024)
    waves = 2.0 * (np.cos(np.outer(w, np.arange(1, SIDE_TAPS + 1))) - 1.0)
    side = np.linalg.lstsq(waves, np.sinc(w / (2 * np.pi)) ** -2 - 1.0, rcond=None)[0]
    return (*side[::-1].tolist(), 1.0 - 2.0 * float(side.sum()), *side.tolist())


def between_samples(u: Array, hold: Hold) -> Array:
    """Return the samples (n,) between which an input of this ``hold`` may be taken as straight or held."""
    if hold != "smooth":
        return u
    return np.convolve(np.pad(u, SIDE_TAPS, mode="edge"), smooth_taps(), "valid")


@dataclass(frozen=True)
class Discrete:
    """Holds ``x[k+1] = ad x[k] + g0 u[k] + g1 u[k+1]`` for one input; ad (s, s), g0 and g1 (s,)."""

    ad: Array
    g0: Array
    g1: Array


def discretise(a: Array, b: Array, dt: float, hold: Hold) -> Discrete:
    """Discretise exactly for an input that is held or linear between samples.

    A smooth input must have passed ``between_samples`` first. Van Loan, IEEE Trans. Automatic Control 23 (1978) 395:
    blocks of one matrix exponential. ``discrete``: a and b are already those of the difference equation.
    """
    s = a.shape[0]
    if hold == "discrete":
        return Discrete(np.ascontiguousarray(a), np.ascontiguousarray(b), np.zeros(s))
    m = np.zeros((s + 2, s + 2))
    m[:s, :s] = a * dt
    m[:s, s] = b * dt
    m[s, s + 1] = 1.0
    e = exponential(m)
    held, ramp = e[:s, s], e[:s, s + 1]
    ad = np.ascontiguousarray(e[:s, :s])
    if hold == "zero":
        return Discrete(ad, np.ascontiguousarray(held), np.zeros(s))
    return Discrete(ad, np.ascontiguousarray(held - ramp), np.ascontiguousarray(ramp))


@kernel
def run_states(ad, g0, g1, u, x0, starts):
    """Return states (n, s) for one input (n,); the state is ``x0[i]`` (starts, s) at the i-th start."""
    n, s = u.size, ad.shape[0]
    out = np.empty((n, s))
    if s == 2:
        # the usual case without inner loops: five times faster
        a00, a01, a10, a11 = ad[0, 0], ad[0, 1], ad[1, 0], ad[1, 1]
        b0, b1, c0, c1 = g0[0], g0[1], g1[0], g1[1]
        p = 0.0
        q = 0.0
        at = 0
        for k in range(n):
            if at < starts.size and k == starts[at]:
                p = x0[at, 0]
                q = x0[at, 1]
                at += 1
            else:
                v = a00 * p + a01 * q + b0 * u[k - 1] + c0 * u[k]
                q = a10 * p + a11 * q + b1 * u[k - 1] + c1 * u[k]
                p = v
            out[k, 0] = p
            out[k, 1] = q
        return out
    if s == 3:
        a = ad.copy()
        b = g0.copy()
        c = g1.copy()
        p = 0.0
        q = 0.0
        r = 0.0
        at = 0
        for k in range(n):
            if at < starts.size and k == starts[at]:
                p = x0[at, 0]
                q = x0[at, 1]
                r = x0[at, 2]
                at += 1
            else:
                before = u[k - 1]
                v = b[0] * before + c[0] * u[k] + a[0, 0] * p + a[0, 1] * q + a[0, 2] * r
                w = b[1] * before + c[1] * u[k] + a[1, 0] * p + a[1, 1] * q + a[1, 2] * r
                r = b[2] * before + c[2] * u[k] + a[2, 0] * p + a[2, 1] * q + a[2, 2] * r
                p = v
                q = w
            out[k, 0] = p
            out[k, 1] = q
            out[k, 2] = r
        return out
    x = np.zeros(s)
    y = np.zeros(s)
    at = 0
    for k in range(n):
        if at < starts.size and k == starts[at]:
            for i in range(s):
                x[i] = x0[at, i]
            at += 1
        else:
            for i in range(s):
                v = g0[i] * u[k - 1] + g1[i] * u[k]
                for j in range(s):
                    v += ad[i, j] * x[j]
                y[i] = v
            for i in range(s):
                x[i] = y[i]
        for i in range(s):
            out[k, i] = x[i]
    return out


@kernel
def run_pair(ad, g0, g1, c, u, starts):
    """Return ``c @ x`` (n,) of a second-order plant for an input (n,), from zero state at each start."""
    n = u.size
    out = np.empty(n)
    a00, a01, a10, a11 = ad[0, 0], ad[0, 1], ad[1, 0], ad[1, 1]
    b0, b1, d0, d1 = g0[0], g0[1], g1[0], g1[1]
    p = 0.0
    q = 0.0
    at = 0
    for k in range(n):
        if at < starts.size and k == starts[at]:
            p = 0.0
            q = 0.0
            at += 1
        else:
            v = a00 * p + a01 * q + b0 * u[k - 1] + d0 * u[k]
            q = a10 * p + a11 * q + b1 * u[k - 1] + d1 * u[k]
            p = v
        out[k] = c[0] * p + c[1] * q
    return out


@kernel
def run_output(ad, g0, g1, c, u, starts):
    """Return ``c @ x`` (n,) for one input (n,) and one output row c (s,), from zero state at each start."""
    n, s = u.size, ad.shape[0]
    out = np.empty(n)
    x = np.zeros(s)
    y = np.zeros(s)
    at = 0
    for k in range(n):
        if at < starts.size and k == starts[at]:
            for i in range(s):
                x[i] = 0.0
            at += 1
        else:
            for i in range(s):
                v = g0[i] * u[k - 1] + g1[i] * u[k]
                for j in range(s):
                    v += ad[i, j] * x[j]
                y[i] = v
            for i in range(s):
                x[i] = y[i]
        w = 0.0
        for i in range(s):
            w += c[i] * x[i]
        out[k] = w
    return out


def free_response(ad: Array, c: Array, length: int) -> Array:
    """Return ``c @ ad^k`` for k = 0..length-1, (length, s): the output for each unit start state."""
    s = ad.shape[0]
    x0 = np.eye(s)
    zero = np.zeros(length)
    nothing = np.zeros(s)
    start = np.zeros(1, np.int64)
    out = np.empty((length, s))
    for i in range(s):
        out[:, i] = run_states(ad, nothing, nothing, zero, x0[i : i + 1], start) @ c
    return out


@kernel
def add_free(y, free, x0):
    """Add ``free @ x0`` (m,) to the first samples of ``y`` (n,) in place; free (m, s), x0 (s,)."""
    m, s = free.shape
    if s == 2:
        p = x0[0]
        q = x0[1]
        for k in range(m):
            y[k] += free[k, 0] * p + free[k, 1] * q
        return
    for k in range(m):
        v = 0.0
        for i in range(s):
            v += free[k, i] * x0[i]
        y[k] += v


Blocks = tuple[tuple[int, int], ...]


def blocks_of(ad: Array, blocks: Blocks) -> Blocks:
    """Return the blocks of ``ad``, first row and last row + 1 of each; a single one if none are named."""
    return blocks or ((0, ad.shape[0]),)


def poles_of(ad: Array, blocks: Blocks) -> NDArray[np.complex128]:
    """Return the eigenvalues of a block-diagonal ``ad``; infinite for one beyond all numbers, a trial of the search."""
    if not np.all(np.isfinite(ad)):
        return np.full(ad.shape[0], np.inf, np.complex128)
    return np.concatenate([np.linalg.eigvals(ad[a:b, a:b]) for a, b in blocks_of(ad, blocks)]).astype(np.complex128)


def felt_at_most(ad: Array, longest: int, blocks: Blocks = ()) -> int:
    """Return a bound on the samples after which a free response is below 1e-12 of its largest, at most ``longest``."""
    slowest = float(np.max(np.abs(poles_of(ad, blocks)), initial=0.0))
    if slowest >= 1.0:
        return longest
    # repeated poles grow by powers of time before they decay
    return min(longest, 50 * (ad.shape[0] + 1) + int(42.0 * ad.shape[0] / -np.log(max(slowest, 1e-12))))


def forgets(ad: Array, samples: int, blocks: Blocks = ()) -> bool:
    """Return True if no mode integrates or grows within so many samples: each decays, or swings without growth."""
    poles = poles_of(ad, blocks)
    size = np.abs(poles)
    swings = (size <= 1.0 + 1e-12) & (np.abs(np.angle(poles)) * samples > 1.0)
    return bool(np.all((size**samples < FORGOTTEN) | swings))


FORGOTTEN = 0.6
"""Ratio of a free response at the end of a stretch to that at its start, below which it is not an integrator's."""


@kernel
def felt_samples(free):
    """Return the number of samples after which a free response (m, s) is below 1e-12 of its largest."""
    m, s = free.shape
    most = 0.0
    for k in range(m):
        for i in range(s):
            most = max(most, abs(free[k, i]))
    for k in range(m - 1, -1, -1):
        for i in range(s):
            if abs(free[k, i]) > 1e-12 * most:
                return k + 1
    return 0


@dataclass(frozen=True)
class StartState:
    """Sets the state at each start by least squares over some measured samples, for every column alike.

    ``free[o]`` (while felt, s) of each block; ``samples`` of each start that may set its state, and ``solvers``
    (s, outputs * samples): the least-squares inverse of the stacked, weighted free responses there. ``shared`` is the
    cache of the view. ``paths``: of the outputs that were measured behind linear effects.
    """

    outputs: tuple[str, ...]
    blocks: Blocks
    free: dict[str, tuple[Array, ...]]
    weight: dict[str, float]
    spans: tuple[tuple[int, int], ...]
    samples: tuple[NDArray[np.int64], ...]
    solvers: tuple[Array, ...]
    ad: Array
    shared: dict[object, object] = field(compare=False, repr=False)
    paths: Mapping[str, Path] = field(compare=False, repr=False)
    memo: dict[object, Array] = field(default_factory=dict[object, Array], compare=False, repr=False)

    def inverses(self, rows: Mapping[str, Array], rough: float, window: int) -> tuple[Array, ...]:
        """Return the inverse (s, outputs * samples) of the free responses at each start; equal ones are one array.

        ``rows[o]`` (s,) shows output o; ``rough``: see ``held_inverse``; ``window``: samples that an integrator counts.
        """
        stretch = max(b - a for a, b in self.spans)
        settles = forgets(self.ad, stretch, self.blocks)
        horizon = min(stretch, felt_at_most(self.ad, stretch, self.blocks)) if settles else window

        def shape_of(c: Array, a: int, b: int) -> Array:
            block, row = np.ascontiguousarray(self.ad[a:b, a:b]), np.ascontiguousarray(c[a:b])
            key = ("shape", block.tobytes(), row.tobytes(), horizon)
            return remember(self.shared, key, lambda: response_shape(block, row, horizon))

        shapes = {o: np.concatenate([shape_of(c, a, b) for a, b in self.blocks], axis=1) for o, c in rows.items()}
        shape = np.concatenate([x * self.weight[o] for o, x in shapes.items()])
        behind = {o: self.behind(o) for o in rows if o in self.paths}
        known: dict[bytes, Array] = {}
        solvers: list[Array] = []
        for i, ((a, _), samples) in enumerate(zip(self.spans, self.samples, strict=True)):
            since = samples - a
            name = since.tobytes() if not behind else samples.tobytes()
            if name not in known:
                seen = [
                    (behind[o][i % 2][samples] if o in behind else _padded(self.free[o], since, self.shared))
                    * self.weight[o]
                    for o in rows
                ]
                known[name] = held_inverse(np.concatenate(seen), shape, rough)
            solvers.append(known[name])
        return tuple(solvers)

    def behind(self, output: str) -> tuple[Array, Array]:
        """Return what is measured of the free responses to unit start states (n, s) of every other stretch.

        The response of a stretch goes on behind its end, so that neighbours are carried apart.
        """
        n, s = self.spans[-1][1], self.ad.shape[0]
        out = np.zeros((2, n, s))
        for i, (a, b) in enumerate(self.spans):
            for (first, last), free in zip(self.blocks, self.free[output], strict=True):
                felt = free[: b - a]
                out[i % 2, a : a + felt.shape[0], first:last] = felt
        for part in out[: min(len(self.spans), 2)]:
            for k in range(s):
                part[:, k] = self.paths[output].carry(np.ascontiguousarray(part[:, k]))
        return out[0], out[1]

    def measured(self, y: Mapping[str, Array]) -> dict[str, Array]:
        """Return what is measured (n,) of outputs ``y``."""
        return {o: self.paths[o].carry(x) if o in self.paths else x for o, x in y.items()}

    def met(self, y: Mapping[str, Array], wanted: Mapping[str, Array]) -> Array:
        """Return start states (starts, s) with which outputs, ``y`` (n,) from rest, are measured as ``wanted`` (n,)."""
        seen = self.measured(y)
        x0 = self.states({o: wanted[o] - seen[o] for o in self.outputs})
        if self.paths and len(self.spans) > 1:
            # a stretch begins with what its predecessor leaves in the effects
            seen = self.measured({o: self.added(y[o].copy(), x0, o) for o in self.outputs})
            x0 = x0 + self.states({o: wanted[o] - seen[o] for o in self.outputs})
        return x0

    def states(self, need: dict[str, Array]) -> Array:
        """Return start states (starts, s) whose free response fits ``need`` (n,) per output at the samples."""
        rows: list[Array] = []
        for at, solver in zip(self.samples, self.solvers, strict=True):
            stacked = np.concatenate([need[o][at] * self.weight[o] for o in self.outputs])
            rows.append(solver @ stacked)
        return np.stack(rows)

    def states_of(self, need: Mapping[str, Sequence[Array]]) -> Array:
        """Return the states (starts, s, columns) of ``states`` for every column of ``need``."""
        found: list[Array] = []
        for at, solver in zip(self.samples, self.solvers, strict=True):
            stacked = [np.stack([c[at] for c in need[o]]) * self.weight[o] for o in self.outputs]
            found.append(solver @ np.concatenate(stacked, axis=1).T)
        return np.stack(found)

    def steady(self, y: Mapping[str, Array], period: int) -> Array:
        """Return start states (starts, s) that make responses ``y`` (n,) to periodic inputs periodic.

        From rest, ``y`` differs one period later by the free response of the state x that it has reached by then; the
        steady state starts from x / (1 - A^period).
        """
        key = ("steady", period)
        if key not in self.memo:
            length = min(max(f.shape[0] for parts in self.free.values() for f in parts), MOST_SETTING)
            least = min(length, *(b - a - period for a, b in self.spans))
            seen = np.concatenate(
                [_padded(self.free[o], np.arange(least), self.shared) * self.weight[o] for o in self.outputs]
            )
            inverse = held_inverse(seen, seen, ROUGH_OF_A_PERIOD)
            full = np.linalg.matrix_power(self.ad, period)
            solved = np.linalg.lstsq(np.eye(full.shape[0]) - full, inverse, rcond=1e-14)[0]
            self.memo[key] = np.asarray(solved, np.float64)
        solver = self.memo[key]
        m = solver.shape[1] // len(self.outputs)
        rows = [
            solver
            @ np.concatenate(
                [(y[o][a + period : a + period + m] - y[o][a : a + m]) * self.weight[o] for o in self.outputs]
            )
            for a, _ in self.spans
        ]
        return np.stack(rows)

    def response(self, states: Array, output: str, n: int) -> Array:
        """Return the free response (n,) of an output for states (starts, s)."""
        return self.added(np.zeros(n), states, output)

    def added(self, y: Array, states: Array, output: str) -> Array:
        """Add the free response of an output to ``y`` (n,) in place while it is not negligible; return ``y``."""
        for (a, b), x0 in zip(self.spans, states, strict=True):
            for (i, j), free in zip(self.blocks, self.free[output], strict=True):
                add_free(y[a:b], free[: b - a], x0[i:j])
        return y

    def at(self, wanted: NDArray[np.int64], output: str) -> tuple[Array, ...]:
        """Return the responses (samples, s) of an output to the unit start states of each stretch, at its ``wanted``
        samples.

        ``wanted``: sorted sample numbers, all behind the first start.
        """
        edges = np.searchsorted(wanted, [a for a, _ in self.spans] + [self.spans[-1][1]])
        return tuple(
            _padded(self.free[output], wanted[i:j] - a, self.shared)
            for (a, _), i, j in zip(self.spans, edges[:-1], edges[1:], strict=True)
        )


MOST_SETTING = 4000
"""Largest number of samples that set a start state; of more, as many at irregular distances are selected."""


def start_state(ad: Array, rows: dict[str, Array], run: Run, *, whole: bool = True, blocks: Blocks = ()) -> StartState:
    """Prepare the least squares for output rows c (s,) of the outputs that may set the state.

    The first samples after each start (``run.start_window``) set its state; with ``run.setting`` those of them that lie
    behind the start do, as long as the start is felt. Without ``whole``, free responses reach over the windows
    only: states can be had, responses cannot. ``blocks``: of a block-diagonal ``ad``.
    """
    starts, n, window, setting, memo = run.starts, run.t.size, run.start_window, run.setting, run.lasting
    how = ("set", setting.size) if setting is not None else ("window", window)
    paths = {o: p for o, p in run.paths.items() if o in rows}
    passed = tuple((o, p.token) for o, p in paths.items())
    key = ("start state", ad.tobytes(), tuple((o, c.tobytes()) for o, c in rows.items()), starts, n, how, whole, passed)
    found = memo.get(key)
    if isinstance(found, StartState):
        return found
    spans = tuple(zip(starts, (*starts[1:], n), strict=True))
    stretch = max(b - a for a, b in spans)
    parts = blocks_of(ad, blocks)
    free = {
        o: tuple(_free(ad, c, part, stretch if whole else window, window, memo) for part in parts)
        for o, c in rows.items()
    }
    felt = max(f.shape[0] for responses in free.values() for f in responses)
    read = ("setting", starts, n, felt, *how)
    at = memo.get(read)
    if not isinstance(at, tuple):
        at = memo[read] = tuple(_setting(a, min(b, a + felt), window, setting) for a, b in spans)
    weight = dict.fromkeys(rows, 1.0)
    if len(rows) > 1:
        # outputs of different units weigh alike over the samples that may set the state
        seen = np.concatenate(at)
        weight = {o: 1.0 / (float(np.std(run.scale[o][seen])) or 1.0) for o in rows}
    rough = max(
        LEAST_ROUGH if setting is not None else LEAST_ROUGH_OF_A_WINDOW,
        *(roughness(run.scale[o], memo, o) for o in rows),
    )
    # outputs that show the states alike share the inverse
    same = ("solvers", ad.tobytes(), tuple((c.tobytes(), weight[o]) for o, c in rows.items()), rough, *key[3:])
    solvers = memo.get(same)
    made = StartState(tuple(rows), parts, free, weight, spans, at, (), ad, memo, paths)
    if not isinstance(solvers, tuple):
        solvers = made.inverses(rows, rough, window)
        stored(memo, same, solvers, sum({id(x): x.nbytes for x in solvers}.values()))
    made = replace(made, solvers=solvers)
    memo[key] = made
    return made


def _free(ad: Array, c: Array, part: tuple[int, int], longest: int, window: int, memo: dict[object, object]) -> Array:
    """Return the free response of one block while it is felt, at least over ``window``; cached."""
    a, b = part
    block, row = np.ascontiguousarray(ad[a:b, a:b]), np.ascontiguousarray(c[a:b])

    def make() -> Array:
        length = max(window, felt_at_most(block, longest))
        free = free_response(block, row, length)
        return free[: max(window, felt_samples(free))]

    return remember(memo, ("free", block.tobytes(), row.tobytes(), longest, window), make)


LEAST_ROUGH = 0.01
"""Least assumed misfit of a simulation, as a fraction of the recorded range, in the regularisation of start states."""
ROUGH_OF_A_PERIOD = 1e-6
"""Assumed misfit for a start state that follows from the period: it involves rounding, but no measurement."""
LEAST_ROUGH_OF_A_WINDOW = 0.03
"""Least assumed misfit where only the first samples set a state: the twin may be unfitted."""
NUMERICAL_RANK = 1e-10
"""Relative response below which combinations of start states are numerically indistinguishable."""


def held_inverse(seen: Array, whole: Array, rough: float) -> Array:
    """Return the regularised inverse (s, rows) of free responses; undetermined combinations of states stay at zero.

    ``seen`` (rows, s): the responses to unit start states at the samples that set the state; ``whole`` (m, s): at
    samples of the whole stretch; ``rough``: misfit over recorded range. A combination of start states is determined
    where a misfit of that size at the samples moves its response nowhere by more than the range. The weight of a
    combination falls with the fourth power of that ratio (filter factors, steeper than Tikhonov's: P. C. Hansen,
    Rank-Deficient and Discrete Ill-Posed Problems, 1998). It is smooth in the poles, and combinations that the data
    determine have no bias. The result does not depend on the coordinates of the state.
    """
    if not np.all(np.isfinite(whole)) or not np.all(np.isfinite(seen)):
        return np.zeros((seen.shape[1], seen.shape[0]))  # a trial that runs away shows nothing
    size = np.maximum(np.max(np.abs(whole), axis=0, initial=0.0), 1e-300)
    responses, strength, combine = np.linalg.svd(whole / size, full_matrices=False)
    kept = strength > NUMERICAL_RANK * strength[0]
    to_state = combine[kept].T / strength[kept] / size[:, None]
    left, sensitivity, right = np.linalg.svd(seen @ to_state, full_matrices=False)
    peak = np.max(np.abs(responses[:, kept] @ right.T), axis=0)
    ratio = rough * peak / np.maximum(sensitivity, 1e-300)
    gain = 1.0 / (np.maximum(sensitivity, 1e-300) * (1.0 + np.minimum(ratio, 1e60) ** 4))
    return np.ascontiguousarray((to_state @ right.T * gain) @ left.T)


def response_shape(ad: Array, c: Array, length: int) -> Array:
    """Return ``free_response`` (m, s) at all first samples, then at every second, fourth and so on up to ``length``."""
    parts = [free_response(ad, c, min(length, 2 * OCTAVE))]
    stride = 1
    while 2 * OCTAVE * stride < length:
        stride *= 2
        ad = ad @ ad
        count = min(2 * OCTAVE, -(-length // stride))
        parts.append(free_response(ad, c, count)[OCTAVE:])
    return np.concatenate(parts)


OCTAVE = 128
"""Number of samples of a free response in every octave of time since its start."""


def roughness(x: Array, memo: dict[object, object], output: str) -> float:
    """Return the noise of a record over its range, by the median of its second differences; cached."""
    key = ("roughness", output)
    found = memo.get(key)
    if not isinstance(found, float):
        size = float(np.ptp(x))
        rough = 1.4826 * float(np.median(np.abs(np.diff(x, 2)))) / np.sqrt(6.0) if x.size > 2 else 0.0
        found = memo[key] = rough / size if size > 0.0 else 0.0
    return found


def _setting(start: int, stop: int, window: int, setting: NDArray[np.int64] | None) -> NDArray[np.int64]:
    """Return the sample numbers from ``start`` to ``stop`` that may set the state at ``start``."""
    first = np.arange(start, min(start + window, stop))
    if setting is None:
        return first
    inside = setting[np.searchsorted(setting, start) : np.searchsorted(setting, stop)]
    if inside.size < min(window, LEAST_SETTING):
        return first
    if inside.size > MOST_SETTING:
        edges = np.linspace(0, inside.size, MOST_SETTING + 1).astype(np.int64)
        width = np.diff(edges)
        # a regular stride would alias lines of the spectrum
        inside = inside[edges[:-1] + (width * np.random.default_rng(inside.size).random(width.size)).astype(np.int64)]
    return inside


LEAST_SETTING = 8
"""Least number of samples that may set a state; with fewer, the first samples after the start do."""


def _padded(free: Sequence[Array], since: NDArray[np.int64], memo: dict[object, object]) -> Array:
    """Return rows (sorted ``since``) of the free responses of all blocks, zero where one has decayed.

    Those of each block are cached in ``memo`` as long as its response, which is identified by its place in memory.
    """
    which = since.tobytes()

    def rows_of(f: Array) -> Array:
        key = ("rows", id(f), which)
        known = memo.get(key)
        if isinstance(known, tuple):
            return known[1]
        felt = int(np.searchsorted(since, f.shape[0]))
        out = np.zeros((since.size, f.shape[1]))
        out[:felt] = f[since[:felt]]
        stored(memo, key, (f, out), out.nbytes)
        return out

    return np.concatenate([rows_of(f) for f in free], axis=1)
