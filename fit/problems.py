"""Problems of an argument, a capture or a fit: an error if no reliable number can be given, otherwise a warning."""

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from torchdof.validation import show

from .result import Array

Kind = Literal[  # the subject of a problem
    "argument",  # an argument of a function is invalid
    "asymmetry",  # the blur is not round
    "boundary",  # a parameter ended on its bound
    "camera",  # the blur or EXIF contradicts the camera's numbers and distances
    "distance",  # distances do not increase, are huge, equal the focus, or make the dot vanish
    "exposure",  # the fitted gain contradicts the stated exposures
    "flat profile",  # the samples do not determine a shape
    "magnification",  # the blurred dot does not have the expected size
    "manifest",  # the folder's manifest is missing, unreadable, or has an invalid field
    "no dot",  # nothing exceeds the noise enough
    "not converged",  # no start converged
    "not finite",  # NaN or infinity in the data
    "not in focus",  # the sharp picture is soft
    "not linear",  # the pictures are not in linear light, or their encoding is unknown
    "residual",  # the residual is far above the noise
    "saturated",  # pixels are clipped, or blacks are cut off
    "several dots",  # more than one dot where one was expected
    "single distance",  # only one distance was measured and is scaled to all others
    "window",  # the window cuts the blur
]

_PACKAGE = str(Path(__file__).parent)
_BRIGHTEST, _DARKEST = 1e30, 1e-30  # the fourth powers of levels are summed

Value = TypeVar("Value")


class _Problem(Exception):
    """A message about a subject `kind`, with the picture or manifest `file`, if any."""

    def __init__(self, message: str, kind: Kind = "argument", file: str | None = None) -> None:
        super().__init__(f"{file}: {message}" if file else message)
        self.kind, self.file = kind, file


class FitError(_Problem, ValueError):
    """A capture or a fit that cannot give a reliable number; has a `kind` and a `file`."""


class FitWarning(_Problem, UserWarning):
    """A reason to doubt a result; has a `kind` and a `file`."""


def warn(message: str, kind: Kind, file: str | None = None) -> None:
    """Warns, pointing at the caller's line outside of this package."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    warnings.warn(FitWarning(message, kind, file), stacklevel=level)


@contextmanager
def without_warnings() -> Iterator[None]:
    """Suppresses warnings of fits, for pictures whose final fit will give them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        yield


def checked(check: Callable[..., Value], name: str, value: Any, *limits: Any, **options: Any) -> Value:
    """Checks an argument by a function of `torchdof.validation`, whose `ValueError` becomes a `FitError`."""
    try:
        return check(name, value.item() if isinstance(value, np.generic) else value, *limits, **options)
    except ValueError as error:
        raise FitError(str(error)) from None


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
        raise FitError(f"{bad} of {array.size} values of {name} are NaN or infinite", "not finite", file)
    largest = float(np.abs(array).max(initial=0.0))
    if largest > _BRIGHTEST or 0 < largest < _DARKEST:
        text = f"{name} must lie within {_DARKEST:g} and {_BRIGHTEST:g}, got up to {largest:g}; take another unit"
        raise FitError(text, file=file)
    return array


def a_picture(name: str, picture: ArrayLike, smallest: int, file: str | None = None) -> Array:
    """A picture `[H, W]` of finite numbers with at least `smallest` pixels on each side, or a `FitError`."""
    array = real_numbers(name, picture, "[H, W] of one colour", file)
    if min(array.shape) < smallest:
        raise FitError(f"{name} must be [H, W], at least {smallest} pixels on a side, got {[*array.shape]}", file=file)
    return array
