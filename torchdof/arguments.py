"""Single arguments as functions need them, or a refusal that says what was expected and what came."""

import math
from typing import Any

import torch
from torch import Tensor

__all__ = ["is_traced", "number", "pixels_wide", "real_tensor", "show", "whole"]


def is_traced() -> bool:
    """Whether this code is being compiled or exported: sizes are symbols then, values cannot be looked at."""
    return torch.compiler.is_compiling() or torch.compiler.is_exporting()


def number(
    name: str, value: Any, low: float = -math.inf, high: float = math.inf, unit: str = "", infinite: bool = False
) -> float:
    """A number in the open interval ``(low, high)``.

    Args:
        name: Of the argument.
        value: What came.
        low: Below what is allowed.
        high: Above what is allowed.
        unit: For the message, such as ``"metres"``.
        infinite: Whether an infinite number counts as one.

    Raises:
        ValueError: If it is not a number (a truth value is none), NaN, or outside.

    Example:
        >>> number("f_number", 2, low=0)
        2.0
    """
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    if plain and (low < value < high or (infinite and abs(value) == math.inf and low <= value <= high)):
        try:
            return float(value)
        except OverflowError:
            pass
    bounds = [f"> {low:g}"] * (low > -math.inf) + [f"< {high:g}"] * (high < math.inf)
    wanted = " ".join(["a number", *([f"of {unit}"] * bool(unit)), " and ".join(bounds)]).rstrip()
    raise ValueError(f"{name} must be {wanted}{' (inf allowed)' if infinite else ''}, got {show(value)}")


def whole(name: str, value: Any, low: int, high: int) -> int:
    """A whole number from ``low`` to ``high``.

    Raises:
        ValueError: If it is none, or outside.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ValueError(f"{name} must be a whole number from {low} to {high}, got {show(value)}")
    return value


def pixels_wide(width: Any) -> None:
    """Refuse a width in pixels that is none; the symbols and tensors of a traced program pass.

    Raises:
        ValueError: If it is not a positive finite number, or a tensor of one.
    """
    if is_traced() or isinstance(width, torch.SymInt):
        return
    if isinstance(width, Tensor):
        if width.ndim or width.is_complex() or width.layout != torch.strided or width.device.type == "meta":
            raise ValueError(f"width must be one number of pixels, got {show(width)}")
        width = width.item()
    number("width", width, low=0, unit="pixels")


def real_tensor(name: str, value: Any, what: str) -> Tensor:
    """A dense tensor of floating-point numbers that are there.

    Args:
        name: Of the argument.
        value: What came.
        what: What is expected, such as ``"[B, 1, H, W] in metres"``.

    Raises:
        ValueError: If it is something else: another kind of object or number, sparse, or without data ("meta").
    """
    if not isinstance(value, Tensor):
        raise ValueError(f"{name} must be a tensor {what}, got {show(value)}")
    if not value.is_floating_point():
        raise ValueError(f"{name} must be a floating-point tensor {what}, got {value.dtype}; convert it with .float()")
    if value.layout != torch.strided:
        raise ValueError(f"{name} must be a dense tensor {what}, got {value.layout}; convert it with .to_dense()")
    if value.device.type == "meta":
        raise ValueError(f"{name} must be a tensor {what} that holds data, got one on the meta device")
    return value


def show(value: Any) -> str:
    """A value for a message: short, and never an error of its own."""
    if isinstance(value, Tensor):
        return f"a {value.dtype} tensor of shape {list(value.shape)}"
    try:
        text = repr(value)
    except Exception:  # an integer of more digits than Python prints, or a foreign object's own trouble
        text = ""
    return text if 0 < len(text) <= 60 else f"{type(value).__name__} {text[:40]}...".replace(" ...", "")
