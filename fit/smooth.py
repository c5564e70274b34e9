"""Parameters of neighbouring nodes made as alike as their errors allow."""

from __future__ import annotations

import numpy as np

from .result import Array

__all__ = ["smoothed"]

_STRENGTHS = 10.0 ** np.arange(-6.0, 7.0, 0.5)
_LEAST_ERROR = 1e-6  # of a parameter's size: noise-free captures still have a rounding


def smoothed(where: Array, values: Array, covariances: Array) -> Array:
    """Node values pulled towards straight lines between their neighbours, as far as their errors allow.

    The bends are made as small as they can be while what is taken away from the fitted values is no more than their
    own noise (chi squared at its expected value). Exact data thus stay as they are.

    Args:
        where: place of the nodes `[n]`, increasing.
        values: fitted values `[n, p]`, of order 1.
        covariances: their covariances `[n, p, p]`; infinite variances mark what was not determined.

    Returns:
        Values `[n, p]`.
    """
    n, p = values.shape
    if n < 3:
        return values
    precision = np.stack([_precision(c, v) for c, v in zip(covariances, values, strict=True)])
    bends = np.zeros((n - 2, n))
    for i in range(n - 2):
        left, right = where[i + 1] - where[i], where[i + 2] - where[i + 1]
        # deviation of the middle node from the line between its neighbours
        bends[i, i : i + 3] = [-right / (left + right), 1.0, -left / (left + right)]
    size = np.maximum(np.abs(values).max(axis=0), 1e-9)
    penalty = np.kron(bends.T @ bends, np.diag(size**-2.0))
    fidelity = np.zeros((n * p, n * p))
    for i in range(n):
        fidelity[i * p : (i + 1) * p, i * p : (i + 1) * p] = precision[i]
    right_side = fidelity @ values.ravel()
    weights, directions = np.linalg.eigh(fidelity)
    informed = weights > 1e-12 * max(weights.max(), 1e-300)
    white = np.sqrt(weights[informed])[:, None] * directions[:, informed].T
    best = values
    for strength in _STRENGTHS:
        solver = np.linalg.pinv(fidelity + strength * penalty, rcond=1e-15, hermitian=True)
        tried = solver @ right_side
        away = white @ (tried - values.ravel())
        # what chi squared would be if all that was taken away were noise
        expected = float(np.sum((np.eye(len(white)) - white @ solver @ white.T) ** 2))
        if float(away @ away) > expected + 1e-9:
            break
        best = tried.reshape(n, p)
    return best


def _precision(covariance: Array, values: Array) -> Array:
    known = np.isfinite(np.diag(covariance))
    floor = (_LEAST_ERROR * np.maximum(np.abs(values), 1e-3)) ** 2
    result = np.zeros_like(covariance)
    inner = covariance[np.ix_(known, known)] + np.diag(floor[known])
    result[np.ix_(known, known)] = np.linalg.pinv(inner, rcond=1e-12, hermitian=True)
    return result
