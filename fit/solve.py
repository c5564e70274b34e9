"""Least squares by SciPy from several starts, and statistics of a solution; failures raise errors."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

import numpy as np
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from .problems import FitError
from .result import Array

_ROUGH = 1e-3
_LAST = 1e-5
_TIGHT = 1e-13  # well-posed data without noise give ten digits
_ATTEMPTS = 400


def one_thread() -> AbstractContextManager[object]:
    """Limits numpy, SciPy and PyTorch to one thread: the steps of a fit are too small for more."""
    return threadpool_limits(limits=1)


def best_of(
    model: Callable[[Array], Array],
    data: Array,
    starts: Sequence[Sequence[float] | Array],
    bounds: tuple[Sequence[float], Sequence[float]],
    *,
    jacobian: Callable[[Array], Array] | None = None,
    tolerance: float = _TIGHT,
    loyalty: float = 0.0,
) -> Array:
    """Fits roughly from every start, finishes from the best, and returns the parameters.

    Args:
        model: maps parameters `[p]` to a prediction of the data `[n]`.
        data: `[n]`, more samples than parameters, of order 1.
        starts: parameter vectors, of order 1; moved inside the bounds.
        bounds: lower and upper bounds.
        jacobian: the model's derivatives `[n, p]`; None uses three-point differences.
        tolerance: relative change of cost, parameters and gradient that ends the iteration.
        loyalty: the first start is used unless another one reduces the sum of squares by more than this share.

    Raises:
        FitError: of kind "not converged" if no start converged.
    """
    low, high = (np.asarray(side, dtype=np.float64) for side in bounds)
    # starts on a bound would be stuck: the trust region vanishes there
    margin = np.where(np.isfinite(high - low), 1e-6 * (high - low), 1e-9)

    def descend(start: Sequence[float] | Array, tolerance: float) -> tuple[float, Array] | None:
        found = least_squares(
            lambda p: model(p) - data,
            np.clip(np.asarray(start, dtype=np.float64), low + margin, high - margin),
            jac=jacobian or "3-point",
            bounds=(low, high),
            x_scale="jac",
            ftol=tolerance,
            xtol=tolerance,
            gtol=tolerance,
            max_nfev=_ATTEMPTS,
        )
        return (found.cost, found.x) if found.success and np.isfinite(found.cost) else None

    rough = [descend(start, max(tolerance, _ROUGH)) for start in starts]
    reached = [r for r in rough if r is not None]
    if not reached:
        text = f"none of {len(starts)} starts converged; is this a picture of a blurred dot?"
        raise FitError(text, "not converged", number=float(len(starts)))
    best = min(reached, key=lambda r: r[0])
    if rough[0] is not None and rough[0][0] <= best[0] * (1 + loyalty):
        best = rough[0]
    # in a long narrow valley the last digits may take too many steps; a less exact solution is then accepted
    finished = descend(best[1], tolerance) or descend(best[1], max(tolerance, _LAST)) or best
    return np.asarray(min(finished, best, key=lambda r: r[0])[1])


def inverse(information: Array) -> Array:
    """Inverse of an information matrix; directions without information get infinite variance instead of an error."""
    scale = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    lost = values <= 1e-13 * max(values.max(), 1e-300)
    kept = np.where(lost, 0.0, 1.0 / np.where(lost, 1.0, values))
    result = (vectors * kept) @ vectors.T / np.outer(scale, scale)
    touched = (np.abs(vectors[:, lost]) > 1e-3).any(axis=1)
    result[touched, touched] = np.inf
    return np.asarray(result, dtype=np.float64)


def information_criterion(squares: float, count: int, parameters: int) -> float:
    """Bayesian information criterion of a least-squares fit, up to a constant that depends on the data only."""
    return count * float(np.log(max(squares, np.finfo(float).tiny) / count)) + parameters * float(np.log(count))
