"""How much error a caller accepts: a number, or the name of a setting."""

from typing import Any, Literal

from .arguments import show

__all__ = ["NAMED", "Tolerance", "from_text", "tolerance_of"]

Tolerance = float | Literal["draft", "preview", "final"]
"""RMS difference, display-encoded, from the same rendering with exact kernels, dense layers and full resolution."""

NAMED = {"draft": 8 / 255, "preview": 4 / 255, "final": 1 / 255}
"""For looking around, for judging a picture, and one that differs by less than a display shows."""


def tolerance_of(value: Any) -> float:
    """The number behind a tolerance.

    Raises:
        ValueError: If it is neither a name nor a number from 0 to below 1.

    Example:
        >>> tolerance_of("preview") == 4 / 255
        True
    """
    if isinstance(value, str) and value in NAMED:
        return NAMED[value]
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1:
        names = ", ".join(repr(name) for name in NAMED)
        raise ValueError(f"tolerance must be a number in [0, 1), such as 1/255, or one of {names}, got {show(value)}")
    return value


def from_text(text: str) -> float:
    """The same of a command line's words.

    Raises:
        ValueError: As :func:`tolerance_of`.

    Example:
        >>> from_text("0.01"), from_text("final") == 1 / 255
        (0.01, True)
    """
    try:
        return tolerance_of(float(text))
    except ValueError:
        return tolerance_of(text)
