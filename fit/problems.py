"""Problems of a capture or a fit: an error if no reliable number can be given, otherwise a warning."""

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

Kind = Literal[
    "argument",  # an argument of a function is invalid
    "asymmetry",  # the blur is not round; `number`: share of it that depends on the angle
    "boundary",  # a parameter ended on its bound; the bound
    "camera",  # the blur or EXIF contradicts the camera's numbers and distances; fitted over expected
    "distance",  # distances do not increase, are huge, equal the focus, or make the dot vanish; the bad one, or size
    "exposure",  # the fitted gain contradicts the stated exposures; fitted over stated
    "flat profile",  # the samples do not determine a shape; a parameter's relative error, or variation over noise
    "magnification",  # the blurred dot does not have the expected size; fitted over expected
    "manifest",  # the folder's manifest is missing, unreadable, or has an invalid field
    "no dot",  # nothing exceeds the noise enough; the peak over the noise
    "not converged",  # no start converged; the number of starts
    "not finite",  # NaN or infinity in the data; the number of values
    "not in focus",  # the sharp picture is soft; sigma of the dot's edge in px
    "not linear",  # the pictures are not in linear light, or their encoding is unknown
    "outside measured",  # a table is used outside its measured range; the factor
    "residual",  # the residual is far above the noise; their ratio
    "saturated",  # pixels are clipped, or blacks are cut off; their number, or share
    "several dots",  # more than one dot where one was expected; their number
    "single distance",  # only one distance was measured and is scaled to all others; that distance in m
    "window",  # the window cuts the blur; the share of light outside
]
"""The subject of a problem, and the meaning of its `number`."""

_PACKAGE = str(Path(__file__).parent)


class _Problem(Exception):
    """A message about a subject `kind`, with the picture or manifest `file` and the measured `number`, if any."""

    def __init__(
        self, message: str, kind: Kind = "argument", *, file: str | None = None, number: float | None = None
    ) -> None:
        super().__init__(f"{file}: {message}" if file else message)
        self.kind, self.file, self.number = kind, file, number


class FitError(_Problem, ValueError):
    """A capture or a fit that cannot give a reliable number; has a `kind`, a `file` and a `number`."""


class FitWarning(_Problem, UserWarning):
    """A reason to doubt a result; has a `kind`, a `file` and a `number`."""


def warn(message: str, kind: Kind, *, file: str | None = None, number: float | None = None) -> None:
    """Warns, pointing at the caller's line outside of this package."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    warnings.warn(FitWarning(message, kind, file=file, number=number), stacklevel=level)


@contextmanager
def without_warnings() -> Iterator[None]:
    """Suppresses warnings of fits, for pictures whose final fit will give them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        yield
