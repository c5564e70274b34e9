"""Checks of arguments at the public boundary.

A failed check raises ``ValueError``, whose message states the expected value, the given value and the remedy. Values of
tensors are never read in a traced program.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Literal

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

_SAME_SHAPE = 0.03  # largest difference between aspect ratios that are meant to be equal


def show(value: Any) -> str:
    """A short text for a value in a message; never raises."""
    if isinstance(value, Tensor) and value.is_nested:
        return f"a nested {value.dtype} tensor; pass its parts one by one, or padded"
    if isinstance(value, Tensor):
        return f"a {value.dtype} tensor of shape {list(value.shape)}"
    if isinstance(value, np.ndarray):
        advice = "use torch.from_numpy(array), and .movedim(-1, -3) for an image with channels last"
        return f"a {value.dtype} array of shape {list(value.shape)}; {advice}"
    if isinstance(value, list | tuple) and value and all(isinstance(item, Tensor) and item.ndim for item in value):
        shapes = list(dict.fromkeys(str(list(item.shape)) for item in value))
        shown = f"{', '.join(shapes[:3])}{', ...' * (len(shapes) > 3)}"
        one_size = "torch.stack makes a batch of it" if len(shapes) == 1 else "render them one by one, or at one size"
        return f"a {type(value).__name__} of {len(value)} tensors of shape {shown}; {one_size}"
    try:
        text = repr(value)
    except Exception:  # an integer with more digits than Python prints, or an error in the object's own repr
        return type(value).__name__
    return text if len(text) <= 60 else f"{type(value).__name__} {text[:40]}..."


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
        values = real_tensor(name, value, "of numbers", whole=True).detach().to("cpu", torch.float64)
    else:
        try:
            if isinstance(value, list | tuple):
                value = [item.tolist() if isinstance(item, Tensor) else item for item in value]
            array = np.asarray(value)
            if array.dtype.kind not in "iuf":
                raise TypeError
        except (TypeError, ValueError, RuntimeError):
            raise ValueError(f"{name} must be numbers, got {show(value)}") from None
        values = torch.from_numpy(array.astype(np.float64))
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
    if not is_traced() and not isinstance(width, torch.SymInt):
        number("width", numbers("width", width).tolist() if isinstance(width, Tensor) else width, 0, unit="pixels")


def broadcast_shapes(*shapes: Sequence[int]) -> torch.Size:
    """As :func:`torch.broadcast_shapes`, whose first call imports sympy and takes half a second."""
    return torch.broadcast_tensors(*(torch.zeros((), device="cpu").expand(tuple(shape)) for shape in shapes))[0].shape


def ends(values: Tensor) -> tuple[float, float]:
    """Smallest and largest value; both are NaN if any value is.

    Raises:
        ValueError: If they come from ``torch.func`` of a PyTorch older than 2.13, where they cannot be read.
    """
    if not TRACEABLE and torch._C._functorch.is_functorch_wrapped_tensor(values):
        needed = f"PyTorch 2.13 or newer, this is {torch.__version__}"
        raise ValueError(f"an argument comes from torch.func, for which torchdof needs {needed}; use torch.autograd")
    if engine_reads(values):
        return native.ends(values)
    # in float32 at least: autocast supports only one half-precision dtype at a time
    dtype = torch.float64 if values.dtype == torch.float64 else torch.float32
    low, high = torch.stack([end.to(dtype) for end in torch.aminmax(values.detach())]).tolist()
    return low, high


def engine_reads(*values: Tensor, backward: bool = False) -> bool:
    """Whether the compiled engine is in use and can read tensors: float32 in CPU memory, in eager code.

    ``backward`` as in :func:`torchdof.tensors.is_in_memory`.
    """
    if is_traced() or not native.chosen():
        return False
    return all(t.dtype == torch.float32 and is_in_memory(t, backward) for t in values)


def holds(values: Tensor, test: Callable[[float, float], bool]) -> bool:
    """Whether the smallest and the largest value pass a test; True in a traced program, where they cannot be read."""
    return is_traced() or test(*ends(values))


def real_tensor(name: str, value: Any, what: str, whole: bool = False) -> Tensor:
    """A dense tensor that holds data, of floating-point numbers or, if ``whole`` allows them, of whole ones.

    ``what`` is the expected shape and unit for the message, such as ``"[B, 1, H, W] in metres"``.
    """
    if not floating(value) and not (whole and isinstance(value, Tensor) and value.dtype in WHOLE_NUMBERS):
        got = show(value)
    elif value.layout != torch.strided:
        got = f"one of layout {value.layout}"
    elif value.device.type == "meta":
        got = "one on the meta device"
    elif is_traced():
        return value
    elif torch.jit.is_tracing():
        got = "one recorded by torch.jit.trace; use torch.compile or torchdof.export.to_onnx"
    elif torch._C._functorch.is_functorch_wrapped_tensor(value) or has_storage(value):
        return value
    else:
        got = "a freed storage" if type(value) is Tensor else f"a {type(value).__name__} without memory of its own"
    raise ValueError(
        f"{name} must be a tensor {what}, floating point (.float()), dense (.to_dense()), that holds data, got {got}"
    )


def one_channel(name: str, value: Any, unit: str = "", whole: bool = False) -> None:
    """Refuse a value that is not a map ``[B, 1, H, W]`` in a unit; arguments as of :func:`real_tensor`."""
    expected = f"[B, 1, H, W] {unit}".rstrip()
    real_tensor(name, value, expected, whole)
    if value.ndim != 4 or value.shape[1] != 1 or not value.numel():
        raise ValueError(f"{name} must be {expected} with at least one pixel, got {list(value.shape)}")


def are_finite(*values: float) -> bool:
    """Whether no number is NaN or infinite."""
    return all(map(math.isfinite, values))


def finite(name: str, values: Tensor) -> None:
    """Refuse values that are NaN or infinite."""
    if not holds(values, are_finite):
        bad = values.numel() - int(torch.isfinite(values).sum())
        raise ValueError(f"{name} must be finite, got {bad} of {values.numel()} NaN or infinite (or pass check=False)")


def image_and_map(image: Tensor, name: str, value: Tensor, unit: str) -> None:
    """Refuse an image and a one-channel map, in a unit, whose types, sizes or devices do not fit."""
    real_tensor("image", image, "[B, C, H, W] in linear light")
    if image.ndim != 4 or 0 in image.shape:
        hint = "; did you forget the batch dimension? use image[None]" if image.ndim == 3 else ""
        raise ValueError(f"image must be [B, C, H, W] with at least one pixel, got {list(image.shape)}{hint}")
    batch, _, height, width = image.shape
    shared = "" if is_traced() or batch == 1 else f"or [1, 1, {height}, {width}] "  # no comparison in a traced graph
    expected = f"[{batch}, 1, {height}, {width}] {shared}{unit} beside this image"
    real_tensor(name, value, expected)
    if value.ndim != 4 or value.shape[1:] != (1, height, width) or value.shape[0] not in (1, batch):
        hint = "; did you forget the channel dimension?" if value.ndim == 3 else ""
        if value.shape[-2:] == image.shape[1:3]:
            hint = "; channels come before height and width: image.movedim(-1, -3)"
        raise ValueError(f"{name} must be {expected}, got {list(value.shape)}{hint}")
    if value.device != image.device:
        raise ValueError(f"{name} must be on the image's device {image.device}, got {value.device}")


def image_and_depth(image: Tensor, depth: Tensor, values: bool, name: str = "depth") -> None:
    """Refuse an image and a depth map in metres that do not fit, or, with ``values``, depth that is not positive."""
    image_and_map(image, name, depth, "in metres")
    if values:
        positive(name, depth)


def positive(name: str, depth: Tensor) -> None:
    """Refuse depth in metres that is NaN or not positive."""
    if not holds(depth, lambda nearest, _: nearest > 0):
        bad = int((~(depth > 0)).sum())
        remedy = "check its unit and kind" if bad == depth.numel() else "fill the holes"
        remedy += ", or leave these pixels sharp with check=False"
        got = f"{bad} of {depth.numel()} pixels that are NaN, zero or negative"
        raise ValueError(f"{name} must be > 0 (inf allowed), got {got}; {remedy}")


def scene(
    image: Tensor,
    kind: Literal["depth", "coc_px"],
    where: Tensor,
    background: Tensor | None = None,
    background_where: Tensor | None = None,
    *,
    channels: int = 1,
    values: bool = True,
) -> None:
    """Check an image, its map and a known background with its map: all shapes, then with ``values`` all values.

    ``kind`` is that of both maps: ``where`` is a depth in metres, which must be positive, or a signed circle of
    confusion in pixels, which must be finite. ``channels`` is the number of kernels of the table at a node: 1, or one
    for each channel of the image.
    """
    unit, background_name = "in metres" if kind == "depth" else "in pixels", f"background_{kind}"
    image_and_map(image, kind, where, unit)
    if channels not in (1, image.shape[1]):
        raise ValueError(f"the table blurs {channels} channels, the image has {image.shape[1]}")
    images, maps = {"image": image}, {str(kind): where}
    if background is not None and background_where is not None:
        real_tensor("background", background, "like the image")
        if (background.shape, background.dtype, background.device) != (image.shape, image.dtype, image.device):
            got = f"{show(background)} on {background.device}"
            raise ValueError(f"background must be like the image, {show(image)}, got {got}")
        image_and_map(image, background_name, background_where, unit)
        images, maps = images | {"background": background}, maps | {background_name: background_where}
    elif background is not None or background_where is not None:
        got = background_name if background is None else "background"
        raise ValueError(f"background and {background_name} need each other, got only {got}")
    if values:
        for name, values_of_map in maps.items():
            (positive if kind == "depth" else finite)(name, values_of_map)
        for name, light in images.items():
            finite(name, light)


def coverage(image: Tensor, matte: Tensor, values: bool) -> None:
    """Refuse a matte that does not fit an image, or, with ``values``, whose numbers are not in [0, 1]."""
    image_and_map(image, "matte", matte, "of coverage in [0, 1]")
    if values and not holds(matte, lambda low, high: 0.0 <= low <= high <= 1.0):
        low, high = ends(matte)
        remedy = "divide by 255 or 65535 if it comes from a file" if high > 1 else "clamp it, and fill in NaN"
        raise ValueError(f"matte must be coverage in [0, 1], got {low:g} to {high:g}; {remedy}")


def stretch(image: Any, depth: Any) -> float | None:
    """Relative stretch of a depth map along one axis to the aspect ratio of an image, 0 for less than a pixel.

    None if one of the two is not a map ``[B, C, H, W]``.

    Example:
        >>> round(stretch(torch.rand(1, 3, 1080, 1920), torch.rand(1, 1, 294, 518)), 4)  # multiples of 14
        0.009
    """
    if not all(isinstance(t, Tensor) and not t.is_nested and t.ndim == 4 and t.numel() for t in (image, depth)):
        return None
    (height, width), (rows, columns) = image.shape[-2:], depth.shape[-2:]
    across, down = height * columns, width * rows
    return abs(across - down) / min(across, down) if abs(across - down) >= max(width, columns) else 0.0


def upright(image: Tensor, depth: Tensor) -> None:
    """Refuse a depth map that would fit its image only after a turn by 90 degrees; all others can be stretched."""
    as_it_is, turned = stretch(image, depth), stretch(image, depth.mT)
    if as_it_is is not None and turned is not None and turned <= _SAME_SHAPE < as_it_is:
        (height, width), (rows, columns) = image.shape[-2:], depth.shape[-2:]
        sizes = f"depth is {columns} x {rows} pixels and the image {width} x {height}"
        raise ValueError(f"{sizes}: turned by 90 degrees it fits; it needs the orientation of the image: rotate one")


def stretched(image: Tensor, depth: Tensor) -> str:
    """A note that a depth map is stretched to the shape of its image; "" for a map of the same shape."""
    share = stretch(image, depth)
    return f"depth of {depth.shape[-1]} x {depth.shape[-2]} px stretched by {share:.1%}" if share else ""
