"""Least squares by SciPy from several starts; failures raise errors."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import least_squares

from .problems import FitError
from .result import Array

_ROUGH_TOLERANCE = 1e-3
_ACCEPTED_TOLERANCE = 1e-5
_TOLERANCE = 1e-13  # well-posed data without noise give ten digits
_MAX_EVALUATIONS = 400


def best_of(
    model: Callable[[Array], Array],
    data: Array,
    starts: Sequence[Sequence[float] | Array],
    bounds: tuple[Sequence[float], Sequence[float]],
    *,
    jacobian: Callable[[Array], Array] | None = None,
    tolerance: float = _TOLERANCE,
) -> Array:
    """Fits roughly from every start, finishes from the best, and returns the parameters, or raises "not converged".

    The model maps parameters `[p]` to a prediction of the data `[n]`, its jacobian to `[n, p]`; all are of order 1.
    """
    low, high = (np.asarray(bound, dtype=np.float64) for bound in bounds)
    # starts on a bound would be stuck: the trust region vanishes there
    margin = np.where(np.isfinite(high - low), 1e-6 * (high - low), 1e-9)

    def descend(start: Sequence[float] | Array, tolerance: float) -> tuple[float, Array]:
        result = least_squares(
            lambda p: model(p) - data,
            np.clip(np.asarray(start, dtype=np.float64), low + margin, high - margin),
            jac=jacobian or "3-point",
            bounds=(low, high),
            x_scale="jac",
            max_nfev=_MAX_EVALUATIONS,
            **dict.fromkeys(("ftol", "xtol", "gtol"), tolerance),
        )
        return (result.cost if result.success and np.isfinite(result.cost) else np.inf), result.x

    rough = min((descend(start, max(tolerance, _ROUGH_TOLERANCE)) for start in starts), key=lambda fit: fit[0])
    if rough[0] == np.inf:
        raise FitError(f"none of {len(starts)} starts converged; is this a picture of a blurred dot?", "not converged")
    refined = descend(rough[1], tolerance)
    if refined[0] == np.inf:  # in a long narrow valley the last digits may take too many steps
        refined = descend(rough[1], max(tolerance, _ACCEPTED_TOLERANCE))
    return min(refined, rough, key=lambda fit: fit[0])[1]


def inverse(information: Array) -> Array:
    """Inverse of an information matrix; directions without information get infinite variance instead of an error."""
    scale = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    is_lost = values <= 1e-13 * max(values.max(), 1e-300)
    inverse_values = np.where(is_lost, 0.0, 1.0 / np.where(is_lost, 1.0, values))
    result = (vectors * inverse_values) @ vectors.T / np.outer(scale, scale)
    affected = (np.abs(vectors[:, is_lost]) > 1e-3).any(axis=1)
    result[affected, affected] = np.inf
    return np.asarray(result, dtype=np.float64)
