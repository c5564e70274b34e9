"""Arguments as the fits need them, or a refusal that says what was expected and what came."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from torchdof.validation import number, show, whole

from .problems import FitError, NonFiniteError
from .result import Array

__all__ = ["a_count", "a_number", "a_picture"]

_BRIGHTEST, _DARKEST = 1e30, 1e-30  # squares of levels, and their squares, are summed


def a_number(name: str, value: Any, low: float, high: float = np.inf, unit: str = "", infinite: bool = False) -> float:
    """A number in the open interval (low, high).

    Raises:
        FitError: it is none, or outside.
    """
    value = value.item() if isinstance(value, np.generic) else value
    try:
        return number(name, value, low, high, unit, infinite)
    except ValueError as error:
        raise FitError(str(error), number=value if isinstance(value, float) else None) from None


def a_count(name: str, value: Any, low: int, high: int) -> int:
    """A whole number from low to high.

    Raises:
        FitError: it is none, or outside.
    """
    value = value.item() if isinstance(value, np.generic) else value
    try:
        return whole(name, value, low, high)
    except ValueError as error:
        raise FitError(str(error)) from None


def a_picture(name: str, picture: ArrayLike, smallest: int, file: str | None = None) -> Array:
    """A picture `[H, W]` of finite numbers.

    Args:
        name: of the argument.
        picture: what came.
        smallest: least pixels on a side.
        file: named in errors.

    Raises:
        FitError: it is not an array of real numbers, too small, or so bright or dark that squares overflow.
        NonFiniteError: NaN or infinity among its pixels.
    """
    try:
        array = np.asarray(picture)
        if array.dtype == bool or not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
            raise TypeError
        array = array.astype(np.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        text = f"{name} must be an array of real numbers [H, W] in linear light, got {show(picture)}"
        raise FitError(text, file=file) from None
    if array.ndim != 2 or min(array.shape) < smallest:
        raise FitError(
            f"{name} must be [H, W] with at least {smallest} pixels on a side, got {list(array.shape)}; "
            "fit the colours of a picture one by one",
            file=file,
        )
    bad = int(np.sum(~np.isfinite(array)))
    if bad:
        raise NonFiniteError(f"{bad} pixels of {name} are NaN or infinite", file=file, number=float(bad))
    largest = float(np.abs(array).max())
    if largest > _BRIGHTEST or 0 < largest < _DARKEST:
        text = f"levels of {name} must lie within {_DARKEST:g} and {_BRIGHTEST:g}, got up to {largest:g}; scale them"
        raise FitError(text, file=file, number=largest)
    return array
