"""What can be wrong with a capture or a fit: one name each, with the file and the number that showed it.

An error means that no honest number can be given; a warning means that one is given, and what to doubt about it.
"""

from __future__ import annotations

import warnings

__all__ = [
    "AsymmetryWarning",
    "BoundaryWarning",
    "CameraError",
    "CameraWarning",
    "DistanceError",
    "DotNotFoundError",
    "ExposureWarning",
    "FitError",
    "FitWarning",
    "FlatProfileError",
    "FlatProfileWarning",
    "MagnificationWarning",
    "ManifestError",
    "NonFiniteError",
    "NotConvergedError",
    "NotInFocusWarning",
    "NotLinearWarning",
    "OutsideMeasuredWarning",
    "ResidualWarning",
    "SaturatedError",
    "SaturatedWarning",
    "SeveralDotsError",
    "SingleDistanceWarning",
    "WindowError",
    "WindowWarning",
    "warn",
]


class FitError(ValueError):
    """A capture or a fit that cannot give an honest number.

    Attributes:
        file: the picture or manifest it is about, or None when only arrays were given.
        number: the measured quantity that led to the refusal (its meaning is in the message).
    """

    def __init__(self, message: str, *, file: str | None = None, number: float | None = None) -> None:
        """Keep file and number beside the message, which is prefixed with the file."""
        super().__init__(f"{file}: {message}" if file else message)
        self.file = file
        self.number = number


class FitWarning(UserWarning):
    """A number is given, but here is why to doubt it. Carries `file` and `number` like `FitError`."""

    def __init__(self, message: str, *, file: str | None = None, number: float | None = None) -> None:
        """Keep file and number beside the message, which is prefixed with the file."""
        super().__init__(f"{file}: {message}" if file else message)
        self.file = file
        self.number = number


class ManifestError(FitError):
    """The folder's manifest is missing, unreadable, or has a wrong field."""


class NonFiniteError(FitError):
    """NaN or infinity in the data; `number` counts them."""


class DotNotFoundError(FitError):
    """No dot stands out from the background; `number` is the peak in units of the noise."""


class SeveralDotsError(FitError):
    """More than one dot where one was expected; `number` counts them."""


class SaturatedError(FitError):
    """Too much of the dot is clipped to fit the rest; `number` is the share of its pixels."""


class SaturatedWarning(FitWarning):
    """Clipped pixels were left out, and `number` counts them; or blacks are cut off, in `number` of the paper."""


class WindowError(FitError):
    """The window cuts the blur; `number` is the share of the light that falls outside."""


class WindowWarning(FitWarning):
    """A little of the blur falls outside the window; `number` is its share of the light."""


class DistanceError(FitError):
    """Distances are not increasing, not positive, or equal to the focus; `number` is the first bad one.

    Or one is so large that nothing of the dot would be seen; `number` is then the dot's magnification.
    """


class FlatProfileError(FitError):
    """The profile has no shape to fit; `number` is its variation in units of the noise."""


class FlatProfileWarning(FitWarning):
    """The profile is too flat to fix a parameter (often r_c); `number` is its standard error over its value."""


class NotConvergedError(FitError):
    """No start converged; `number` counts the starts."""


class BoundaryWarning(FitWarning):
    """A parameter ended on its bound, so its value is a limit; `number` is the bound."""


class NotInFocusWarning(FitWarning):
    """The sharp picture is soft; `number` is the width (sigma) of the dot's edge in px."""


class NotLinearWarning(FitWarning):
    """The pictures are not in linear light, or nobody said whether they are; the message says what `number` is."""


class ResidualWarning(FitWarning):
    """The residual is far above the noise; `number` is their ratio."""


class AsymmetryWarning(FitWarning):
    """The blur is not round; `number` is the share of its contrast that depends on the angle."""


class MagnificationWarning(FitWarning):
    """The blurred dot has not the expected size; `number` is fitted over expected."""


class CameraError(FitError):
    """The fitted blur is far from what camera and distances promise; `number` is fitted over promised."""


class CameraWarning(FitWarning):
    """The fitted blur, or EXIF, contradicts the camera's numbers; `number` is fitted over promised."""


class ExposureWarning(FitWarning):
    """The fitted gain contradicts the stated exposures; `number` is fitted over stated."""


class SingleDistanceWarning(FitWarning):
    """One distance was measured; the thin lens scales it to all others. `number` is that distance in m."""


class OutsideMeasuredWarning(FitWarning):
    """A table is used beyond what was measured; `number` is the factor."""


def warn(warning: FitWarning, stacklevel: int = 3) -> None:
    """Issue a warning object, pointing at the caller of the function that found it."""
    warnings.warn(warning, stacklevel=stacklevel)
