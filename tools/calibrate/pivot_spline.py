"""Fits the angles of a swung body as uniform quintic splines together with a few global parameters, by least squares.

Unknowns: coefficients (K, 3) of three angles and globals (G,). Residuals depend on the angles, their first and second
derivative at one instant and on the globals, so the normal matrix is a band with a border; the band is eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded

from hal.arrays import Array

DEGREE = 5
SPAN = DEGREE + 1
"""Coefficients that one instant depends on."""
BAND = 3 * SPAN


@dataclass(frozen=True)
class Basis:
    """Holds ``weights`` (3, n, SPAN) of value, first and second derivative at n instants, and the ``first`` coefficient
    (n,)."""

    weights: Array
    first: NDArray[np.intp]
    count: int

    def curves(self, coefficients: Array) -> Array:
        """Return value, first and second derivative (3, n, 3) from coefficients (K, 3)."""
        near = coefficients[self.first[:, None] + np.arange(SPAN)]
        return np.einsum("dnj,nja->dna", self.weights, near)

    def fit(self, values: Array) -> Array:
        """Return the coefficients (K, 3) of the least-squares spline through values (n, 3)."""
        band, right = np.zeros((SPAN, self.count)), np.zeros((self.count, 3))
        for i in range(SPAN):
            np.add.at(right, self.first + i, self.weights[0][:, i, None] * values)
            for j in range(i + 1):
                np.add.at(band[i - j], self.first + j, self.weights[0][:, i] * self.weights[0][:, j])
        band[0] += 1e-9 * band[0].max()
        return np.asarray(solveh_banded(band, right, lower=True))


def uniform_basis(t_s: Array, knot_s: float) -> Basis:
    """Return the basis with knots every ``knot_s`` over the instants ``t_s`` (n,)."""
    place = (t_s - t_s[0]) / knot_s
    last = max(1, int(np.ceil(place[-1])))
    first = np.minimum(place.astype(np.intp), last - 1)
    inside = place - first
    bump = BSpline.basis_element(np.arange(SPAN + 1, dtype=np.float64))
    weights = np.empty((3, len(t_s), SPAN))
    for d in range(3):
        curve = bump if d == 0 else bump.derivative(d)
        for j in range(SPAN):
            weights[d, :, j] = curve(np.clip(inside + DEGREE - j, 0.0, SPAN)) / knot_s**d
    return Basis(weights, first, last + DEGREE)


@dataclass(frozen=True)
class Step:
    """Holds one Gauss-Newton step. ``projected`` (n, R, G) is the part of the globals' slope that the splines cannot
    fit."""

    coefficients: Array
    globals_: Array
    information: Array
    projected: Array


def gauss_newton(basis: Basis, residual: Array, by_curve: Array, by_global: Array, prior: Array, away: Array) -> Step:
    """Step from residuals (n, R), slopes (n, R, 3, 3) by derivative and angle and (n, R, G), all in units of noise.

    ``prior`` (G,) is 1 / variance of each global, ``away`` (G,) how far it is from its expected value.
    """
    n = len(residual)
    slopes = np.einsum("nrda,dnj->nrja", by_curve, basis.weights).reshape(n, -1, BAND)
    size = 3 * basis.count
    band, border, right = np.zeros((BAND, size)), np.zeros((size, by_global.shape[2])), np.zeros(size)
    square = np.einsum("nri,nrk->nik", slopes, slopes)
    across = np.einsum("nri,nrg->nig", slopes, by_global)
    pull = np.einsum("nri,nr->ni", slopes, residual)
    for i in range(BAND):
        np.add.at(right, 3 * basis.first + i, pull[:, i])
        np.add.at(border, 3 * basis.first + i, across[:, i])
        for k in range(i + 1):
            np.add.at(band[i - k], 3 * basis.first + k, square[:, i, k])
    band[0] += 1e-12 * band[0].max()
    solved = solveh_banded(band, np.column_stack([right, border]), lower=True)
    information = np.einsum("nrg,nrh->gh", by_global, by_global) + np.diag(prior) - border.T @ solved[:, 1:]
    wanted = np.einsum("nrg,nr->g", by_global, residual) - prior * away - border.T @ solved[:, 0]
    globals_ = np.linalg.solve(information, wanted)
    coefficients = (solved[:, 0] - solved[:, 1:] @ globals_).reshape(-1, 3)
    near = solved[:, 1:][(3 * basis.first)[:, None] + np.arange(BAND)]
    return Step(coefficients, globals_, information, by_global - np.einsum("nri,nig->nrg", slopes, near))
