"""What can be wrong with a capture or a fit: an error where no honest number can be given, else a warning."""

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

Kind = Literal[
    "argument",  # an argument of a function is not what it must be
    "asymmetry",  # the blur is not round; `number`: share of its contrast that depends on the angle
    "boundary",  # a parameter ended on its bound; the bound
    "camera",  # the blur, or EXIF, contradicts the camera's numbers and distances; fitted over promised
    "distance",  # distances do not increase, equal the focus, or leave nothing of the dot; the first bad one, the size
    "exposure",  # the fitted gain contradicts the stated exposures; fitted over stated
    "flat profile",  # the samples do not fix a parameter, or no shape at all; its relative error, variation over noise
    "magnification",  # the blurred dot has not the expected size; fitted over expected
    "manifest",  # the folder's manifest is missing, unreadable, or has a wrong field
    "no dot",  # nothing stands out from the background; the peak over the noise
    "not converged",  # no start converged; the number of starts
    "not finite",  # NaN or infinity in the data; how many
    "not in focus",  # the sharp picture is soft; sigma of the dot's edge in px
    "not linear",  # the pictures are not in linear light, or nobody said whether they are
    "outside measured",  # a table is used beyond what was measured; the factor
    "residual",  # the residual is far above the noise; their ratio
    "saturated",  # pixels are clipped, or blacks are cut off; how many, or their share
    "several dots",  # more than one dot where one was expected; how many
    "single distance",  # one distance was measured, and is scaled to all others; that distance in m
    "window",  # the window cuts the blur; the share of the light that falls outside
]
"""What a problem is about, and what its `number` then is."""

_PACKAGE = str(Path(__file__).parent)


class _Problem(Exception):
    """A message that begins with the file it is about.

    Attributes:
        kind: what it is about.
        file: the picture or manifest, or None when only arrays were given.
        number: the measured quantity that led to it, or None.
    """

    def __init__(
        self, message: str, kind: Kind = "argument", *, file: str | None = None, number: float | None = None
    ) -> None:
        super().__init__(f"{file}: {message}" if file else message)
        self.kind, self.file, self.number = kind, file, number


class FitError(_Problem, ValueError):
    """A capture or a fit that cannot give an honest number; has a `kind`, a `file` and a `number`."""


class FitWarning(_Problem, UserWarning):
    """A number is given, but here is why to doubt it; has a `kind`, a `file` and a `number`."""


def warn(message: str, kind: Kind, *, file: str | None = None, number: float | None = None) -> None:
    """Warn, pointing at the line outside of this package that led here."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        level, frame = level + 1, frame.f_back
    warnings.warn(FitWarning(message, kind, file=file, number=number), stacklevel=level)


@contextmanager
def unheard() -> Iterator[None]:
    """In which fits do not warn: another fit of the same pictures does."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        yield
