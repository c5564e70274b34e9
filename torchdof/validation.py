"""Checks of arguments at the public boundary.

A failed check raises ``ValueError``, whose message states the expected value, the given value and the remedy. Values of
tensors are never read in a traced program.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from . import native
from .tensors import TRACEABLE, floating, has_storage, is_in_memory, is_traced

NAMED_TOLERANCES = {"draft": 8 / 255, "preview": 4 / 255, "final": 1 / 255}
"""RMS tolerances. The last difference is smaller than a step of an 8-bit display."""

WHOLE_NUMBERS = (
    *(torch.uint8, torch.uint16, torch.uint32, torch.uint64),
    *(torch.int8, torch.int16, torch.int32, torch.int64),
)

_MAX_STRETCH = 0.03  # largest change of a depth map's aspect ratio; estimators work at multiples of 14 or 64 px


def show(value: Any) -> str:
    """A short text for a value in a message; never raises."""
    if isinstance(value, Tensor) and value.is_nested:
        return f"a nested {value.dtype} tensor; pass its parts one by one, or padded"
    if isinstance(value, Tensor):
        return f"a {value.dtype} tensor of shape {list(value.shape)}"
    if isinstance(value, np.ndarray):
        advice = "use torch.from_numpy(array), and .movedim(-1, -3) for an image with channels last"
        return f"a {value.dtype} array of shape {list(value.shape)}; {advice}"
    try:
        text = repr(value)
    except Exception:  # an integer with more digits than Python prints, or an error in the object's own repr
        text = ""
    return text if 0 < len(text) <= 60 else f"{type(value).__name__} {text[:40]}...".replace(" ...", "")


def number(
    name: str, value: Any, low: float = -math.inf, high: float = math.inf, unit: str = "", infinite: bool = False
) -> float:
    """A number in the open interval ``(low, high)``, neither a bool nor NaN, as a float; ``infinite`` allows infinity.

    ``name`` is that of the argument in the message, ``unit`` the unit there, such as ``"metres"``.
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number and (low < value < high or (infinite and abs(value) == math.inf and low <= value <= high)):
        try:
            return float(value)
        except OverflowError:
            pass
    bounds = [f"> {low:g}"] * (low > -math.inf) + [f"< {high:g}"] * (high < math.inf)
    expected = " ".join(["a number", *([f"of {unit}"] * bool(unit)), " and ".join(bounds)]).rstrip()
    raise ValueError(f"{name} must be {expected}{' (inf allowed)' if infinite else ''}, got {show(value)}")


def whole(name: str, value: Any, low: int, high: int) -> int:
    """A whole number from ``low`` to ``high``; a bool is not one."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ValueError(f"{name} must be a whole number from {low} to {high}, got {show(value)}")
    return value


def choice(name: str, value: Any, choices: Collection[str]) -> None:
    """Refuse a value that is not one of some words."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {show(value)}")


def numbers(name: str, value: Any) -> Tensor:
    """Finite numbers, such as lists of them or a tensor, as a float64 tensor on the CPU."""
    if isinstance(value, Tensor):
        is_whole = value.dtype in WHOLE_NUMBERS and value.layout == torch.strided and value.device.type != "meta"
        values = (value if is_whole else real_tensor(name, value, "of numbers")).detach().to("cpu", torch.float64)
    else:
        if isinstance(value, list | tuple):
            value = [item.detach() if isinstance(item, Tensor) else item for item in value]
        try:
            values = torch.as_tensor(value, device="cpu")
            if not floating(values) and values.dtype not in WHOLE_NUMBERS:
                raise TypeError
            values = torch.as_tensor(value, dtype=torch.float64, device="cpu")  # the line above made a list float32
        except (TypeError, ValueError, RuntimeError, OverflowError):
            raise ValueError(f"{name} must be numbers, got {show(value)}") from None
    if not bool(torch.isfinite(values).all()):
        raise ValueError(f"{name} must be finite numbers, got {short(values)}")
    return values


def short(numbers: Tensor) -> str:
    """The first of some numbers, and their shape, for a message."""
    text = ", ".join(f"{x:g}" for x in numbers.flatten()[:6].tolist())
    return f"[{text}{', ...' if numbers.numel() > 6 else ''}] of shape {list(numbers.shape)}"


def fields(what: str, data: Any, required: Collection[str], optional: Collection[str] = ()) -> dict[str, Any]:
    """The fields of a dict, which must have all required ones, and no others than these and the optional ones."""
    if not isinstance(data, Mapping):
        raise ValueError(f"{what} must be a dict, got {show(data)}")
    names = (*required, *optional)
    missing, unknown = [n for n in required if n not in data], [n for n in data if n not in names]
    if missing or unknown:
        problem = f"{missing[0]} is missing" if missing else f"{show(unknown[0])} is not one of them"
        raise ValueError(f"{what} must have the fields {', '.join(names)}; {problem}")
    return dict(data)


def tolerance_of(value: Any) -> float:
    """A tolerance, one of :data:`NAMED_TOLERANCES` or a number in [0, 1), as a number."""
    if isinstance(value, str) and value in NAMED_TOLERANCES:
        return NAMED_TOLERANCES[value]
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1:
        names = ", ".join(repr(name) for name in NAMED_TOLERANCES)
        raise ValueError(f"tolerance must be a number in [0, 1), such as 1/255, or one of {names}, got {show(value)}")
    return value


def pixels_wide(width: Any) -> None:
    """Refuse a width that is not a positive number of pixels; symbols and tensors of a traced program pass."""
    if is_traced() or isinstance(width, torch.SymInt):
        return
    if isinstance(width, Tensor):
        is_stored = width.layout == torch.strided and width.device.type != "meta"
        if width.ndim or width.is_complex() or not is_stored or width.requires_grad:
            raise ValueError(f"width must be one number of pixels, without gradients, got {show(width)}")
        width = width.item()
    number("width", width, low=0, unit="pixels")


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """As :func:`torch.broadcast_shapes`, whose first call imports sympy and takes half a second."""
    return torch.broadcast_tensors(*(torch.zeros((), device="cpu").expand(tuple(shape)) for shape in shapes))[0].shape


def ends(values: Tensor) -> tuple[float, float]:
    """Smallest and largest value; both are NaN if any value is.

    Raises:
        ValueError: If they come from ``torch.func`` of a PyTorch older than 2.13, where they cannot be read.
    """
    if not TRACEABLE and torch._C._functorch.is_functorch_wrapped_tensor(values):
        raise ValueError(
            "the image, the depth or a number of the camera comes from torch.func, for which torchdof needs PyTorch "
            f"2.13 or newer, this is {torch.__version__}; use torch.autograd instead"
        )
    if values.dtype == torch.float32 and is_in_memory(values) and native.chosen():
        return native.ends(values)
    # in float32 at least: autocast supports only one half-precision dtype at a time
    dtype = torch.float64 if values.dtype == torch.float64 else torch.float32
    low, high = torch.stack([end.to(dtype) for end in torch.aminmax(values.detach())]).tolist()
    return low, high


def real_tensor(name: str, value: Any, what: str) -> Tensor:
    """A dense floating-point tensor that holds data.

    ``what`` is the expected shape and unit for the message, such as ``"[B, 1, H, W] in metres"``.
    """
    if not isinstance(value, Tensor):
        raise ValueError(f"{name} must be a tensor {what}, got {show(value)}")
    if not floating(value):
        got = show(value) if value.is_nested else f"{value.dtype}; convert it with .float()"
        raise ValueError(f"{name} must be a floating-point tensor {what}, got {got}")
    if value.layout != torch.strided:
        raise ValueError(f"{name} must be a dense tensor {what}, got {value.layout}; convert it with .to_dense()")
    if value.device.type == "meta":
        raise ValueError(f"{name} must be a tensor {what} that holds data, got one on the meta device")
    if is_traced():
        return value
    if torch.jit.is_tracing():
        raise ValueError(
            f"{name} must not be recorded by torch.jit.trace; use torch.compile or torchdof.export.to_onnx"
        )
    if not torch._C._functorch.is_functorch_wrapped_tensor(value) and not has_storage(value):
        kind = f"a {type(value).__name__} without memory of its own" if type(value) is not Tensor else "a freed storage"
        raise ValueError(
            f"{name} must be a tensor {what} that holds data, got {kind}; pass the tensor with its numbers"
        )
    return value


def _check_finite(name: str, values: Tensor) -> None:
    if not all(map(math.isfinite, ends(values))):
        bad = values.numel() - int(torch.isfinite(values).sum())
        raise ValueError(
            f"{name} must be finite, got {bad} of {values.numel()} values that are NaN or infinite; "
            "repair them, or pass check=False"
        )


def image_and_map(image: Tensor, name: str, value: Tensor, unit: str) -> None:
    """Refuse an image and a one-channel map, in a unit, whose types, sizes or devices do not fit."""
    if not isinstance(image, Tensor):
        got = show(image) if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(f"image must be a tensor [B, C, H, W] in linear light, got {got}")
    if not floating(image):
        hint = "convert it with .float()" if image.is_floating_point() else "decode it first"
        got = show(image) if image.is_nested else f"{image.dtype}; {hint}"
        raise ValueError(f"image must be floating point in linear light, of 16 bits or more, got {got}")
    if image.ndim != 4:
        hint = "; did you forget the batch dimension? use image[None]" if image.ndim == 3 else ""
        raise ValueError(f"image must be [B, C, H, W] in linear light, got {list(image.shape)}{hint}")
    if 0 in image.shape:
        raise ValueError(f"image must have at least one pixel, channel and item, got {list(image.shape)}")
    batch, _, height, width = image.shape
    expected = f"{name} must be [{batch}, 1, {height}, {width}] or [1, 1, {height}, {width}] {unit}"
    if not floating(value):
        got = show(value) if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(f"{expected} and floating point, got {got}")
    if value.ndim != 4:
        hint = "; did you forget the channel dimension?" if value.ndim == 3 else ""
        raise ValueError(f"{expected}, got {list(value.shape)}{hint}")
    if value.shape[1:] != (1, height, width) or value.shape[0] not in (1, batch):
        is_last = value.shape[-2:] == image.shape[1:3]
        hint = "; channels come before height and width: image.movedim(-1, -3)" if is_last else ""
        raise ValueError(f"{expected} as the image is {list(image.shape)}, got {list(value.shape)}{hint}")
    if value.device != image.device:
        raise ValueError(f"{name} must be on the image's device {image.device}, got {value.device}")
    if not is_traced():
        real_tensor("image", image, "[B, C, H, W]")
        real_tensor(name, value, f"[B, 1, H, W] {unit}")


def image_and_depth(image: Tensor, depth: Tensor, values: bool, name: str = "depth") -> None:
    """Refuse an image and a depth map in metres that do not fit, or, with ``values``, depth that is not positive."""
    image_and_map(image, name, depth, "in metres")
    if values and not is_traced() and not ends(depth)[0] > 0:
        bad = int((~(depth > 0)).sum())
        remedy = "check its unit and kind" if bad == depth.numel() else "fill the holes"
        raise ValueError(
            f"{name} must be > 0 (inf allowed), got {bad} of {depth.numel()} pixels that are NaN, zero or "
            f"negative; {remedy}, or pass check=False to let these pixels through sharp"
        )


def image_and_coc(image: Tensor, coc_px: Tensor, channels: int, values: bool) -> None:
    """Refuse an image and a signed circle of confusion in pixels that do not fit.

    ``channels`` is the number of kernels of the table at a node: 1, or one for each channel of the image. With
    ``values`` both must be finite.
    """
    image_and_map(image, "coc_px", coc_px, "in pixels")
    if channels not in (1, image.shape[1]):
        raise ValueError(f"the table blurs {channels} channels, the image has {image.shape[1]}")
    if values and not is_traced():
        _check_finite("coc_px", coc_px)
        _check_finite("image", image)


def coc_of_lens(coc_px: Tensor, depth: Tensor, lens: Mapping[str, Any]) -> None:
    """Refuse a circle of confusion that overflowed; the message has the numbers of the lens, floats or tensors."""
    if not is_traced() and not all(map(math.isfinite, ends(coc_px))):
        given = {n: value.flatten().tolist() if isinstance(value, Tensor) else [value] for n, value in lens.items()}
        stated = ", ".join(" ".join([name, *(f"{x:.6g}" for x in numbers)]) for name, numbers in given.items())
        raise ValueError(
            f"depth and lens must give a finite blur radius, got an infinite one: check this lens ({stated}) "
            f"and the depth, which starts at {float(depth.detach().min()):.3g} m"
        )


def background(
    image: Tensor, hidden: Tensor | None, name: str, where: Tensor | None, unit: str, values: bool = False
) -> None:
    """Refuse a background that is not like the image, or whose depth or circle of confusion ``where`` does not fit.

    ``name`` and ``unit`` are those of ``where``. With ``values`` both must be finite.
    """
    if hidden is None and where is None:
        return
    if hidden is None or where is None:
        missing = "background" if hidden is None else "background_depth (or background_coc_px)"
        raise ValueError(f"a background needs its depth, and a depth its background: {missing} is missing")
    like = (image.shape, image.dtype, image.device)
    if not floating(hidden) or (hidden.shape, hidden.dtype, hidden.device) != like:
        raise ValueError(f"background must be like the image, {show(image)}, got {show(hidden)}")
    image_and_map(image, name, where, unit)
    if not is_traced():
        real_tensor("background", hidden, "[B, C, H, W]")
        if values:
            _check_finite(name, where)
            _check_finite("background", hidden)


def stretch(image: Tensor, depth: Tensor) -> float:
    """Relative stretch of a depth map along one axis to the aspect ratio of an image; 0 for less than a pixel.

    Example:
        >>> round(stretch(torch.rand(1, 3, 1080, 1920), torch.rand(1, 1, 294, 518)), 4)  # multiples of 14
        0.009
    """
    (height, width), (rows, columns) = image.shape[-2:], depth.shape[-2:]
    across, down = height * columns, width * rows
    return abs(across - down) / min(across, down) if abs(across - down) >= max(width, columns) else 0.0


def is_resizable(image: Any, depth: Any) -> bool:
    """Whether a depth map has another size than an image, but nearly the same aspect ratio."""
    maps = all(floating(t) and t.ndim == 4 and t.numel() for t in (image, depth))
    if not maps or image.shape[-2:] == depth.shape[-2:] or image.device != depth.device:
        return False
    return depth.shape[0] in (1, image.shape[0]) and depth.shape[1] == 1 and stretch(image, depth) <= _MAX_STRETCH


def same_aspect(image: Tensor, depth: Tensor) -> None:
    """Refuse a depth map whose aspect ratio differs by more than 3 % from that of an image ``[..., H, W]``."""
    if 0 in depth.shape or stretch(image, depth) > _MAX_STRETCH:
        (height, width), (rows, columns) = image.shape[-2:], depth.shape[-2:]
        if 0 not in depth.shape and stretch(image, depth.transpose(-1, -2)) <= _MAX_STRETCH:
            hint = "turned by 90 degrees it fits: rotate one of the two"
        else:
            hint = "crop one of the two, so that both show the same area"
        raise ValueError(
            f"depth is {columns} x {rows} pixels and the image {width} x {height}: a depth map may have another size, "
            f"but must have the same aspect ratio, to within 3 %; {hint}"
        )


def stack(rgba: Tensor, depth_m: Tensor, values: bool) -> Tensor:
    """Refuse a stack of layers and depths that do not fit.

    With ``values`` coverage must lie in [0, 1] and light must be finite.

    Returns:
        The depths as ``[B or 1, N, 1, H or 1, W or 1]``.
    """
    real_tensor("rgba", rgba, "[B, N, C + 1, H, W]")
    real_tensor("depth_m", depth_m, "in metres")
    if rgba.ndim != 5 or rgba.shape[2] < 2 or 0 in rgba.shape:
        raise ValueError(f"rgba must be [B, N, C + 1, H, W], premultiplied, got {list(rgba.shape)}")
    batch, count, _, height, width = rgba.shape
    is_short = depth_m.ndim in (1, 2) and depth_m.shape[-1] == count
    depth = depth_m.reshape(-1, count, 1, 1, 1) if is_short else depth_m
    is_like_layers = depth.ndim == 5 and depth.shape[0] in (1, batch) and depth.shape[1:3] == (count, 1)
    if not is_like_layers or tuple(depth.shape[3:]) not in ((1, 1), (height, width)):
        expected = f"[{count}], [{batch}, {count}] or [B, {count}, 1, H, W] of 1 x 1 or {height} x {width} pixels"
        raise ValueError(f"depth_m must be {expected}, got {[*depth_m.shape]}")
    if values and not is_traced():
        coverage = rgba[:, :, -1]
        bad = int((~((coverage >= 0) & (coverage <= 1))).sum())
        if bad:
            raise ValueError(
                f"the last channel of rgba is coverage in [0, 1]; {bad} of {coverage.numel()} values are not"
            )
        _check_finite("rgba", rgba)
    return depth
