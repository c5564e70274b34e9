"""Least squares by `scipy.optimize.curve_fit` from several starts; its silent failures become named errors."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

import numpy as np

from .problems import NotConvergedError
from .result import Array

__all__ = ["best_of", "information_criterion", "one_thread"]

_ROUGH = 1e-3
_LAST = 1e-5
_TIGHT = 1e-13  # well-posed noise-free data should come back to ten digits


def one_thread() -> AbstractContextManager[object]:
    """In which numpy, SciPy and PyTorch compute in one thread: a fit's steps are small, and threads cost more."""
    import scipy.linalg  # noqa: F401  # only what is loaded can be limited
    from threadpoolctl import threadpool_limits

    return threadpool_limits(limits=1)


def best_of(
    model: Callable[..., Array],
    data: Array,
    starts: Sequence[Sequence[float]],
    bounds: tuple[Sequence[float], Sequence[float]],
    *,
    jacobian: Callable[..., Array] | None = None,
    tolerance: float = _TIGHT,
    attempts: int = 400,
    loyalty: float = 0.0,
) -> Array:
    """Fit roughly from every start, finish from the best, and return the parameters.

    Args:
        model: `model(x, *params) -> [n]`; `x` is the sample's index and may be ignored.
        data: `[n]`, more samples than parameters, of order 1.
        starts: parameter vectors, of order 1; moved into the bounds.
        bounds: lower and upper bounds, as for `curve_fit`.
        jacobian: `jacobian(x, *params) -> [n, p]`; three-point differences when None.
        tolerance: relative change of cost, parameters and gradient at which to stop.
        attempts: the most evaluations for each start.
        loyalty: the first start is finished unless another one's sum of squares is smaller by more than this share.

    Returns:
        The parameters `[p]`.

    Raises:
        NotConvergedError: when no start converged.
    """
    from scipy.optimize import OptimizeWarning, curve_fit

    low, high = (np.asarray(side, dtype=np.float64) for side in bounds)
    # keep starts off the bounds, where the trust region cannot move
    margin = np.where(np.isfinite(high - low), 1e-6 * (high - low), 1e-9)
    index = np.arange(data.size, dtype=np.float64)

    def descend(start: Array, tolerance: float) -> tuple[float, Array] | None:
        try:
            with warnings.catch_warnings():
                # it warns where its own covariance has no inverse; the caller computes one, and reports it
                warnings.simplefilter("ignore", OptimizeWarning)
                params, _ = curve_fit(
                    model,
                    index,
                    data,
                    p0=np.clip(start, low + margin, high - margin),
                    bounds=(low, high),
                    jac=jacobian if jacobian is not None else "3-point",
                    method="trf",
                    x_scale="jac",
                    ftol=tolerance,
                    xtol=tolerance,
                    gtol=tolerance,
                    max_nfev=attempts,
                )
        except RuntimeError:  # out of evaluations
            return None
        squares = float(np.sum((model(index, *params) - data) ** 2))
        return (squares, np.asarray(params, dtype=np.float64)) if np.isfinite(squares) else None

    rough = [descend(np.asarray(start, dtype=np.float64), max(tolerance, _ROUGH)) for start in starts]
    reached = [r for r in rough if r is not None]
    if not reached:
        raise NotConvergedError(
            f"none of {len(starts)} starts converged; is this a picture of a blurred dot?", number=float(len(starts))
        )
    best = min(reached, key=lambda r: r[0])
    if rough[0] is not None and rough[0][0] <= best[0] * (1 + loyalty):
        best = rough[0]
    # a long narrow valley may take too many steps for the last digits; its floor is a solution all the same
    finished = descend(best[1], tolerance) or descend(best[1], max(tolerance, _LAST)) or best
    return min(finished, best, key=lambda r: r[0])[1]


def information_criterion(squares: float, count: int, parameters: int) -> float:
    """Bayesian information criterion of a least-squares fit, up to a constant of the data."""
    return count * float(np.log(max(squares, np.finfo(float).tiny) / count)) + parameters * float(np.log(count))
