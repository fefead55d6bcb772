"""Tests if a residual follows a signal: curves are regressed with coloured errors.

Residual and curve pass the same whitening filter (generalised least squares; Cochrane and Orcutt, JASA 44, 1949):
the F statistic counts independent innovations and not the samples of a slow wander. The filter is estimated on the
residual itself, which attributes part of a true dependence to colour: the test is conservative.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f as f_distribution

from hal.arrays import Array
from tools.mismatch.engine.colour import Whitener, fit_whitener, whiten
from tools.mismatch.engine.features import Feature

Span = tuple[int, int]


@dataclass(frozen=True)
class Dependence:
    """Holds the ``p_value`` of the null hypothesis that a residual does not follow a feature, and the ``strength``.

    ``strength`` is the cross-fitted share of the variance, 0..1, that a curve of the feature predicts on held-out
    blocks.
    """

    signal: str
    feature: str
    p_value: float
    strength: float
    memory: bool


def whitened_f(e_white: Array, columns_white: Array) -> float:
    """Return the p-value of the F test that ``columns_white`` (m, k) and a constant do not explain ``e_white`` (m,)."""
    m, k = columns_white.shape
    if m < 4 * (k + 1):
        return 1.0
    x = columns_white - columns_white.mean(axis=0)
    e = e_white - e_white.mean()
    gain, rank = projected_energy(e, x)
    rest = float(e @ e) - gain
    if rank == 0 or rest <= 0:
        return 1.0 if rank == 0 else 0.0
    # the F statistic is approximate for heavy tails; excess kurtosis enters by k/m only
    return float(f_distribution.sf(gain / rank / (rest / (m - rank - 1)), rank, m - rank - 1))


def _axes(x: Array) -> Array:
    """Return a matrix (k, rank) that maps ``x`` (m, k) to an orthonormal basis of its columns.

    It uses the eigenvectors of the Gram matrix of the scaled columns, which take a tenth of the time of a QR
    factorisation of so tall a matrix.
    """
    size = np.sqrt(np.einsum("ij,ij->j", x, x))
    usable = size > 1e-9 * float(size.max(initial=0.0))
    scale = np.where(usable, 1.0 / np.where(usable, size, 1.0), 0.0)
    gram = (x.T @ x) * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(gram)
    keep = values > 1e-11 * max(float(values[-1]), 1e-300) if values.size else np.zeros(0, bool)
    return scale[:, None] * vectors[:, keep] / np.sqrt(values[keep])


def projected_energy(e: Array, x: Array) -> tuple[float, int]:
    """Return (sum of squares of the projection of ``e`` (m,) on the columns of ``x`` (m, k), their rank)."""
    axes = _axes(x)
    return float(np.sum((axes.T @ (x.T @ e)) ** 2)), axes.shape[1]


def cross_fitted_share(e: Array, columns: Array, blocks: list[Span]) -> float:
    """Return the share of the variance of ``e`` (n,) that a curve fitted on the other half of the blocks predicts.

    Sums of products per half of the blocks suffice: the columns are read once and not copied.
    """
    k = columns.shape[1] + 1
    gram, cross = np.zeros((2, k, k)), np.zeros((2, k))
    count, square = np.zeros(2), np.zeros(2)
    e = e - e.mean()  # avoids cancellation for a level far from zero
    for number, (a, b) in enumerate(blocks):
        half, x, y = number % 2, columns[a:b], e[a:b]
        gram[half, 1:, 1:] += x.T @ x
        gram[half, 0, 1:] += x.sum(axis=0)
        cross[half, 1:] += x.T @ y
        cross[half, 0] += y.sum()
        count[half] += b - a
        square[half] += y @ y
    lost = total = 0.0
    for fitted, held in ((0, 1), (1, 0)):
        if count[fitted] < 3 * k or not count[held]:
            return 0.0
        for g, number in ((gram[fitted], count[fitted]), (gram[held], count[held])):
            g[1:, 0] = g[0, 1:]
            g[0, 0] = number
        stiff = gram[fitted].copy()
        stiff[np.diag_indices(k)] *= 1 + 1e-6
        weight = np.linalg.lstsq(stiff, cross[fitted], rcond=None)[0]
        lost += float(square[held] - 2 * weight @ cross[held] + weight @ gram[held] @ weight)
        mean = cross[fitted][0] / count[fitted]
        total += float(square[held] - 2 * mean * cross[held][0] + count[held] * mean * mean)
    return float(np.clip(1 - lost / total, 0.0, 1.0)) if total > 0 else 0.0


def dependences(
    e: Array,
    features: list[Feature],
    *,
    stretches: list[Span] | None = None,
    blocks: list[Span] | None = None,
    whitener: Whitener | None = None,
    own_colour: bool = False,
) -> list[Dependence]:
    """Test every feature against the residual ``e`` (n,); p-values are Holm-corrected; strongest first.

    With ``own_colour`` the filter of each test is estimated on the residual of its curve (Cochrane and Orcutt), which
    has more power against a slow signal; two independent wanders leave a wander and stay unrelated.
    """
    stretches = stretches or [(0, e.size)]
    if blocks is None:
        edges = np.linspace(0, e.size, 25).astype(int)
        blocks = [(int(a), int(b)) for a, b in itertools.pairwise(edges)]
    model = whitener or fit_whitener(e, stretches=stretches)
    white = _without_outliers(whiten(model, e, stretches))
    found: list[Dependence] = []
    for feature in features:
        if own_colour:
            p = _after_its_curve(e, feature.columns, stretches)
        else:
            p = whitened_f(white, whiten(model, feature.columns, stretches))
        share = cross_fitted_share(e, feature.columns, blocks)
        found.append(Dependence(feature.signal, feature.kind, p, share, feature.memory))
    return sorted(_corrected(found), key=lambda d: (-d.strength, d.p_value))


def _without_outliers(white: Array) -> Array:
    limit = 8.0 * float(np.median(np.abs(white))) * 1.4826
    return np.clip(white, -limit, limit) if limit > 0 else white


def _corrected(found: list[Dependence]) -> list[Dependence]:
    """Return the dependences with p-values that are corrected for their number (Holm 1979)."""
    order = np.argsort([d.p_value for d in found])
    corrected = np.ones(len(found))
    running = 0.0
    for rank, i in enumerate(order):
        running = max(running, found[i].p_value * (len(found) - rank))
        corrected[i] = min(running, 1.0)
    return [replace(d, p_value=float(p)) for d, p in zip(found, corrected, strict=True)]


def follows_course(course: Array, features: list[Feature]) -> list[Dependence]:
    """Return the features that a slow ``course`` (n,) follows, the most significant first.

    Each curve is fitted by generalised least squares, so that an independent wander gets none by chance, which plain
    regression of two wanders does (Granger and Newbold, J. Econometrics 2, 1974). ``strength`` is the variance of
    that curve over the variance of the course.
    """
    stretches = [(0, course.size)]
    model = fit_whitener(course, stretches=stretches)
    white = _without_outliers(whiten(model, course, stretches))
    power = float(np.var(course))
    found: list[Dependence] = []
    for feature in features:
        columns = whiten(model, feature.columns, stretches)
        x = columns - columns.mean(axis=0)
        axes = _axes(x)
        followed = feature.columns @ (axes @ (axes.T @ (x.T @ (white - white.mean()))))
        share = float(np.var(followed)) / power if power > 0.0 else 0.0
        found.append(Dependence(feature.signal, feature.kind, whitened_f(white, columns), share, feature.memory))
    return sorted(_corrected(found), key=lambda d: d.p_value)


def _after_its_curve(e: Array, columns: Array, stretches: list[Span]) -> float:
    """Return the p-value of a curve, whitened by the colour of its residual."""
    design = np.column_stack([np.ones(e.size), columns])
    size = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    left = e - design @ (np.linalg.lstsq(design / size, e, rcond=1e-8)[0] / size)
    model = fit_whitener(left, stretches=stretches)
    return whitened_f(_without_outliers(whiten(model, e, stretches)), whiten(model, columns, stretches))


def needs_memory(
    e: Array, present: list[Feature], past: list[Feature], *, stretches: list[Span] | None = None
) -> float:
    """Return the p-value that the past adds nothing to the present; a small one means a missing state.

    ``present``: features of values and rates now; ``past``: features with memory (Hooker and Ellner, Annals of
    Applied Statistics 9, 2015: a forcing that its state does not explain but its history does).
    """
    stretches = stretches or [(0, e.size)]
    if not past:
        return 1.0
    model = fit_whitener(e, stretches=stretches)
    now = whiten(model, np.column_stack([f.columns for f in present]), stretches) if present else None
    then = whiten(model, np.column_stack([f.columns for f in past]), stretches)
    white = whiten(model, e, stretches)
    if now is not None and now.size:
        basis = np.column_stack([np.ones(now.shape[0]), now])
        basis = basis / np.maximum(np.linalg.norm(basis, axis=0), 1e-300)
        q = basis @ _axes(basis)
        white = white - q @ (q.T @ white)
        then = then - q @ (q.T @ then)
        scale = np.linalg.norm(then, axis=0)
        then = then[:, scale > 1e-6 * scale.max()] if scale.max() > 0 else then[:, :0]
    return whitened_f(white, then) if then.shape[1] else 1.0
