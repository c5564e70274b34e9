"""Least squares by SciPy from several starts, and what is told of a solution; silent failures become named errors."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

import numpy as np
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from .problems import FitError
from .result import Array

_ROUGH = 1e-3
_LAST = 1e-5
_TIGHT = 1e-13  # well-posed noise-free data should come back to ten digits
_ATTEMPTS = 400


def one_thread() -> AbstractContextManager[object]:
    """In which numpy, SciPy and PyTorch compute in one thread: a fit's steps are small, and threads cost more."""
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
    """Fit roughly from every start, finish from the best, and return the parameters.

    Args:
        model: from parameters `[p]` to what is held against the data `[n]`.
        data: `[n]`, more samples than parameters, of order 1.
        starts: parameter vectors, of order 1; moved into the bounds.
        bounds: lower and upper bounds.
        jacobian: the model's derivatives `[n, p]`; three-point differences when None.
        tolerance: relative change of cost, parameters and gradient at which to stop.
        loyalty: the first start is finished unless another one's sum of squares is smaller by more than this share.

    Raises:
        FitError: of kind "not converged" when no start did.
    """
    low, high = (np.asarray(side, dtype=np.float64) for side in bounds)
    # keep starts off the bounds, where the trust region cannot move
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
    # a long narrow valley may take too many steps for the last digits; its floor is a solution all the same
    finished = descend(best[1], tolerance) or descend(best[1], max(tolerance, _LAST)) or best
    return np.asarray(min(finished, best, key=lambda r: r[0])[1])


def inverse(information: Array) -> Array:
    """Inverse of an information matrix; a direction without information gets an infinite variance, not an error."""
    scale = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    lost = values <= 1e-13 * max(values.max(), 1e-300)
    kept = np.where(lost, 0.0, 1.0 / np.where(lost, 1.0, values))
    result = (vectors * kept) @ vectors.T / np.outer(scale, scale)
    touched = (np.abs(vectors[:, lost]) > 1e-3).any(axis=1)
    result[touched, touched] = np.inf
    return np.asarray(result, dtype=np.float64)


def information_criterion(squares: float, count: int, parameters: int) -> float:
    """Bayesian information criterion of a least-squares fit, up to a constant of the data."""
    return count * float(np.log(max(squares, np.finfo(float).tiny) / count)) + parameters * float(np.log(count))
