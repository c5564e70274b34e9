"""Validation of arguments; errors contain the expected and the given value."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from torchdof.validation import show

from .problems import FitError
from .result import Array

_BRIGHTEST, _DARKEST = 1e30, 1e-30  # the fourth powers of levels are summed

Value = TypeVar("Value")


def checked(check: Callable[..., Value], name: str, value: Any, *limits: Any, **options: Any) -> Value:
    """Checks an argument by a function of `torchdof.validation`, whose `ValueError` becomes a `FitError`."""
    value = value.item() if isinstance(value, np.generic) else value
    try:
        return check(name, value, *limits, **options)
    except ValueError as error:
        raise FitError(str(error), number=value if isinstance(value, float) else None) from None


def real_numbers(name: str, value: ArrayLike, axes: str, file: str | None = None) -> Array:
    """An array of finite real numbers as float64, with axes such as "[H, W]", or a `FitError`."""
    expected = f"{name} must be an array of real numbers {axes}, got"
    try:
        array = np.asarray(value)
        if array.dtype == bool or not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
            raise TypeError
        array = array.astype(np.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise FitError(f"{expected} {show(value)}", file=file) from None
    if array.ndim != len(axes.split(",")):
        raise FitError(f"{expected} {list(array.shape)}", file=file)
    if bad := int(np.sum(~np.isfinite(array))):
        text = f"{bad} of {array.size} values of {name} are NaN or infinite"
        raise FitError(text, "not finite", file=file, number=float(bad))
    largest = float(np.abs(array).max(initial=0.0))
    if largest > _BRIGHTEST or 0 < largest < _DARKEST:
        text = f"{name} must lie within {_DARKEST:g} and {_BRIGHTEST:g}, got up to {largest:g}; take another unit"
        raise FitError(text, file=file, number=largest)
    return array


def a_picture(name: str, picture: ArrayLike, smallest: int, file: str | None = None) -> Array:
    """A picture `[H, W]` of finite numbers with at least `smallest` pixels on each side, or a `FitError`."""
    array = real_numbers(name, picture, "[H, W] of one colour", file)
    if min(array.shape) < smallest:
        text = f"{name} must be [H, W] with at least {smallest} pixels on a side, got {list(array.shape)}"
        raise FitError(text, file=file)
    return array
