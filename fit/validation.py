"""Validation of arguments; errors contain the expected and the given value."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from torchdof.validation import number, show, whole

from .problems import FitError
from .result import Array

_BRIGHTEST, _DARKEST = 1e30, 1e-30  # the fourth powers of levels are summed


def a_number(name: str, value: Any, low: float, high: float = np.inf, unit: str = "") -> float:
    """A number in the open interval (low, high), or a `FitError`."""
    try:
        return number(name, _python_number(value), low, high, unit)
    except ValueError as error:
        raise FitError(str(error), number=value if isinstance(value, float) else None) from None


def a_count(name: str, value: Any, low: int, high: int) -> int:
    """A whole number from low to high, or a `FitError`."""
    try:
        return whole(name, _python_number(value), low, high)
    except ValueError as error:
        raise FitError(str(error)) from None


def a_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Raises a `FitError` if the value is not one of the choices."""
    if not isinstance(value, str) or value not in choices:
        raise FitError(f"{name} must be one of {', '.join(choices)}, got {show(value)}")


def real_numbers(value: ArrayLike) -> Array | None:
    """An array of real numbers as float64; None if the value is not one."""
    try:
        array = np.asarray(value)
        is_real = array.dtype != bool and np.issubdtype(array.dtype, np.number) and not np.iscomplexobj(array)
        return array.astype(np.float64) if is_real else None
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return None


def a_picture(name: str, picture: ArrayLike, smallest: int, file: str | None = None) -> Array:
    """A picture `[H, W]` of finite numbers with at least `smallest` pixels on each side.

    Raises:
        FitError: it is not an array of real numbers, too small, or so bright or dark that squares overflow; of kind
            "not finite" for NaN or infinity among its pixels.
    """
    array = real_numbers(picture)
    if array is None:
        text = f"{name} must be an array of real numbers [H, W] in linear light, got {show(picture)}"
        raise FitError(text, file=file)
    if array.ndim != 2 or min(array.shape) < smallest:
        raise FitError(
            f"{name} must be [H, W] with at least {smallest} pixels on a side, got {list(array.shape)}; "
            "fit the colours of a picture one by one",
            file=file,
        )
    if bad := int(np.sum(~np.isfinite(array))):
        raise FitError(f"{bad} pixels of {name} are NaN or infinite", "not finite", file=file, number=float(bad))
    largest = float(np.abs(array).max())
    if largest > _BRIGHTEST or 0 < largest < _DARKEST:
        text = f"levels of {name} must lie within {_DARKEST:g} and {_BRIGHTEST:g}, got up to {largest:g}; scale them"
        raise FitError(text, file=file, number=largest)
    return array


def _python_number(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
