"""Small symmetric matrices: the only place that symmetrises, adds jitter or takes a log-determinant.

The scalar helpers serve kernels; the array functions serve everything whose cost does not grow with tracks.
"""

from __future__ import annotations

import math

import numpy as np

from trackers.compiled import helper, kernel

LOG_TWO_PI = float(np.log(2.0 * np.pi))
JITTER = 1e-12
"""Relative size of the diagonal term that keeps a factorisation going when rounding made a pivot non-positive."""


def symmetrize(matrix):
    """(A + Aᵀ) / 2 for matrices [..., d, d]."""
    return 0.5 * (matrix + np.swapaxes(matrix, -1, -2))


@helper
def cholesky_in_place(a):
    """Lower Cholesky factor of a [d, d], overwriting its lower triangle; a non-positive pivot is lifted by jitter."""
    d = a.shape[0]
    for j in range(d):
        scale = abs(a[j, j])
        pivot = a[j, j]
        for k in range(j):
            pivot -= a[j, k] * a[j, k]
        pivot = max(pivot, JITTER * scale + 1e-300)
        a[j, j] = np.sqrt(pivot)
        for i in range(j + 1, d):
            s = a[i, j]
            for k in range(j):
                s -= a[i, k] * a[j, k]
            a[i, j] = s / a[j, j]


@helper
def _pivot(value, diagonal):
    return math.sqrt(max(value, JITTER * abs(diagonal) + 1e-300))


@helper
def cholesky_3(A, L):
    """Fill the lower triangle of L [3, 3] with the factor of A [3, 3]; returns its diagonal's reciprocals."""
    L[0, 0] = _pivot(A[0, 0], A[0, 0])
    a = 1.0 / L[0, 0]
    L[1, 0], L[2, 0] = A[1, 0] * a, A[2, 0] * a
    L[1, 1] = _pivot(A[1, 1] - L[1, 0] * L[1, 0], A[1, 1])
    b = 1.0 / L[1, 1]
    L[2, 1] = (A[2, 1] - L[2, 0] * L[1, 0]) * b
    L[2, 2] = _pivot(A[2, 2] - L[2, 0] * L[2, 0] - L[2, 1] * L[2, 1], A[2, 2])
    return a, b, 1.0 / L[2, 2]


@helper
def cholesky_4(P):
    """Lower factor of P [4, 4] as ten numbers, row by row: no scratch."""
    l00 = _pivot(P[0, 0], P[0, 0])
    l10, l20, l30 = P[1, 0] / l00, P[2, 0] / l00, P[3, 0] / l00
    l11 = _pivot(P[1, 1] - l10 * l10, P[1, 1])
    l21, l31 = (P[2, 1] - l20 * l10) / l11, (P[3, 1] - l30 * l10) / l11
    l22 = _pivot(P[2, 2] - l20 * l20 - l21 * l21, P[2, 2])
    l32 = (P[3, 2] - l30 * l20 - l31 * l21) / l22
    l33 = _pivot(P[3, 3] - l30 * l30 - l31 * l31 - l32 * l32, P[3, 3])
    return l00, l10, l11, l20, l21, l22, l30, l31, l32, l33


@helper
def mahalanobis_4(L, d):
    """dᵀ(LLᵀ)⁻¹d for the ten numbers of `cholesky_4` and d [4]."""
    l00, l10, l11, l20, l21, l22, l30, l31, l32, l33 = L
    a = d[0] / l00
    b = (d[1] - l10 * a) / l11
    c = (d[2] - l20 * a - l21 * b) / l22
    e = (d[3] - l30 * a - l31 * b - l32 * c) / l33
    return a * a + b * b + c * c + e * e


@helper
def invert_3(A, inverse):
    """Fill `inverse` [3, 3] with A⁻¹ of symmetric positive definite A [3, 3]; returns det A."""
    l00 = _pivot(A[0, 0], A[0, 0])
    a = 1.0 / l00
    l10, l20 = A[1, 0] * a, A[2, 0] * a
    l11 = _pivot(A[1, 1] - l10 * l10, A[1, 1])
    b = 1.0 / l11
    l21 = (A[2, 1] - l20 * l10) * b
    l22 = _pivot(A[2, 2] - l20 * l20 - l21 * l21, A[2, 2])
    c = 1.0 / l22
    d, e = -l10 * a * b, -l21 * b * c
    f = -(l20 * a + l21 * d) * c
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = a * a + d * d + f * f, b * b + e * e, c * c
    inverse[0, 1] = inverse[1, 0] = d * b + f * e
    inverse[0, 2] = inverse[2, 0] = f * c
    inverse[1, 2] = inverse[2, 1] = e * c
    return (l00 * l11 * l22) ** 2


@helper
def solve_with_factor(factor, b):
    """Overwrite b [d] by (LLᵀ)⁻¹b for a lower factor [d, d]."""
    d = b.shape[0]
    for i in range(d):
        for k in range(i):
            b[i] -= factor[i, k] * b[k]
        b[i] /= factor[i, i]
    for i in range(d - 1, -1, -1):
        for k in range(i + 1, d):
            b[i] -= factor[k, i] * b[k]
        b[i] /= factor[i, i]


@helper
def mahalanobis_with_factor(factor, x):
    """xᵀ(LLᵀ)⁻¹x for a lower factor [d, d]; x [d] is overwritten by L⁻¹x."""
    d = x.shape[0]
    total = 0.0
    for i in range(d):
        s = x[i]
        for k in range(i):
            s -= factor[i, k] * x[k]
        x[i] = s / factor[i, i]
        total += x[i] * x[i]
    return total


@kernel("(d),(d,d)->()")
def _mahalanobis(x, cov, out):
    factor = cov.copy()
    cholesky_in_place(factor)
    out[0] = mahalanobis_with_factor(factor, x.copy())


def mahalanobis_squared(x, cov):
    """Squared Mahalanobis length xᵀP⁻¹x.

    Args:
        x: [..., d].
        cov: [..., d, d], symmetric positive definite; a numerically indefinite one is lifted by a relative jitter.
    Returns:
        [...], finite and non-negative.
    """
    return _mahalanobis(x, cov)


def psd_solve(matrix, rhs):
    """A⁻¹b for symmetric positive definite A [..., d, d] and b [..., d, k], through Cholesky."""
    factor = np.linalg.cholesky(symmetrize(matrix))
    return np.linalg.solve(np.swapaxes(factor, -1, -2), np.linalg.solve(factor, rhs))


def psd_inverse(matrix):
    """A⁻¹, symmetric, for symmetric positive definite A [..., d, d]."""
    return symmetrize(psd_solve(matrix, np.broadcast_to(np.eye(matrix.shape[-1]), matrix.shape)))


def log_det(matrix):
    """log det A [...] for symmetric positive definite A [..., d, d]."""
    factor = np.linalg.cholesky(symmetrize(matrix))
    return 2.0 * np.log(np.diagonal(factor, axis1=-2, axis2=-1)).sum(-1)
