"""Checks at the public boundary: what was expected, what came, what to do."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from .arguments import is_traced, real_tensor, show
from .camera import Camera
from .render.plan import Plan
from .table import BlurTable
from .tolerance import tolerance_of

__all__ = [
    "Border",
    "Method",
    "Options",
    "attention",
    "background",
    "both_or_none",
    "image_and_coc",
    "image_and_depth",
    "image_and_map",
    "plan",
    "stack",
    "state",
]

Method = Literal["layered", "fold"]
Border = Literal["normalize", "extend"]


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of a rendering; their meaning is told at :class:`torchdof.DepthOfField`.

    Raises:
        ValueError: Naming the option that makes no sense.
    """

    table: BlurTable
    tolerance: float
    occlusion: bool
    normalize: bool
    method: Method
    border: Border
    max_coc_px: float
    check: bool

    def __post_init__(self) -> None:
        if not isinstance(self.table, BlurTable):
            got = type(self.table).__name__
            raise ValueError(f"table must be a torchdof.BlurTable, got {got}; read a file with BlurTable.load()")
        tolerance_of(self.tolerance)
        for name in ("occlusion", "normalize", "check"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be True or False, got {show(getattr(self, name))}")
        if not isinstance(self.method, str) or self.method not in ("layered", "fold"):
            raise ValueError(f"method must be 'layered' or 'fold', got {show(self.method)}")
        if not isinstance(self.border, str) or self.border not in ("normalize", "extend"):
            raise ValueError(f"border must be 'normalize' or 'extend', got {show(self.border)}")
        if self.occlusion and not self.normalize:
            raise ValueError("normalize=False is the plain sum of occlusion=False; set occlusion=False as well")
        reach = self.max_coc_px
        if isinstance(reach, bool) or not isinstance(reach, int | float) or not 0.5 < reach < 1e300:
            raise ValueError(f"max_coc_px must be a radius above 0.5 pixels, got {show(reach)}")


def plan(layers: Plan | None) -> None:
    """Refuse what is not a plan, or one without layers in order.

    Raises:
        ValueError: If it is none.
    """
    if layers is None:
        return
    if not isinstance(layers, Plan):
        raise ValueError(
            f"plan must be a Plan, as DepthOfField.plan(image, depth) gives, or None, got {show(layers)}; "
            "leave it out to plan for this image"
        )
    nodes = layers.nodes
    plain = isinstance(nodes, tuple) and all(isinstance(x, int | float) and math.isfinite(x) for x in nodes)
    if not plain or not nodes or any(low >= high for low, high in zip(nodes, nodes[1:], strict=False)):
        raise ValueError(f"plan must hold layers as a tuple of strictly increasing numbers, got {show(nodes)}")


def attention(where: object, layers: Plan | None) -> None:
    """Refuse attention where it cannot be paid.

    Raises:
        ValueError: If a plan, which holds one tolerance, comes with it, or code is traced.
    """
    if where is None:
        return
    if layers is not None:
        raise ValueError("attention plans for two tolerances; leave plan out, or attention")
    if is_traced():
        raise ValueError("attention chooses its work by where the viewer looks; a compiled or exported graph cannot")


def state(given: Any) -> tuple[Camera, Options]:
    """What a module's state describes.

    Returns:
        The camera, and the options with the table.

    Raises:
        ValueError: Naming the field that is missing, unknown or makes no sense.
    """
    names = ["camera", *(field.name for field in dataclasses.fields(Options))]
    if not isinstance(given, Mapping):
        raise ValueError(f"the state of a DepthOfField must be a dict, as state_dict() gives, got {show(given)}")
    _fields("the state of a DepthOfField", given, names)
    camera = given["camera"]
    if not isinstance(camera, Mapping):
        raise ValueError(f"camera of the state must be a dict, got {show(camera)}")
    _fields("camera of the state", camera, list(Camera.__dataclass_fields__))
    try:
        made = Camera(**camera)
    except ValueError as error:
        raise ValueError(f"camera of the state: {error}") from error
    try:
        table = BlurTable.from_dict(given["table"])
    except ValueError as error:
        raise ValueError(f"table of the state: {error}") from error
    try:
        return made, Options(**{**{name: given[name] for name in names[1:]}, "table": table})
    except ValueError as error:
        raise ValueError(f"the state of a DepthOfField: {error}") from error


def _fields(what: str, given: Mapping[str, Any], names: list[str]) -> None:
    missing, unknown = [n for n in names if n not in given], [n for n in given if n not in names]
    if missing or unknown:
        wrong = f"{missing[0]!r} is missing" if missing else f"{show(unknown[0])} is not one of them"
        raise ValueError(f"{what} must have the fields {', '.join(names)}; {wrong}")


def image_and_depth(image: Tensor, depth: Tensor, values: bool) -> None:
    """Refuse an image and a depth map that do not belong together.

    Raises:
        ValueError: If shapes or types are wrong, or, with ``values``, a depth is NaN or not positive.
    """
    image_and_map(image, "depth", depth, "in metres")
    if values and not is_traced():
        bad = int((~(depth > 0)).sum())
        if bad:
            raise ValueError(
                f"depth must be > 0 (inf allowed), got {bad} of {depth.numel()} pixels that are NaN, zero or negative; "
                "fill the holes, or pass check=False to let these pixels through sharp"
            )


def image_and_coc(image: Tensor, coc_px: Tensor, table: BlurTable, values: bool) -> None:
    """Refuse an image and a map of the circle of confusion that do not belong together.

    Raises:
        ValueError: If shapes or types are wrong, the table has other channels than the image, or, with ``values``, a
            coc or a pixel is not finite.
    """
    image_and_map(image, "coc_px", coc_px, "in pixels")
    if table.channels not in (1, image.shape[1]):
        raise ValueError(f"the table blurs {table.channels} channels, the image has {image.shape[1]}")
    if values and not is_traced():
        for name, tensor in (("coc_px", coc_px), ("image", image)):
            if bool(torch.isfinite(tensor.sum())):  # one look at each value; a sum that overflows tells nothing
                continue
            bad = tensor.numel() - int(torch.isfinite(tensor).sum())
            if bad:
                raise ValueError(
                    f"{name} must be finite, got {bad} of {tensor.numel()} values that are NaN or infinite; "
                    "mend them, or pass check=False"
                )


def both_or_none(background: Tensor | None, where: Tensor | None) -> None:
    """Refuse a background without its place, or a place without its background.

    Raises:
        ValueError: Saying which is missing.
    """
    if (background is None) != (where is None):
        missing = "background" if background is None else "background_depth (or background_coc_px)"
        raise ValueError(f"a background needs its depth, and a depth its background: {missing} is missing")


def background(
    image: Tensor, behind: Tensor | None, coc_px: Tensor | None, table: BlurTable, options: Options
) -> tuple[Tensor, Tensor] | None:
    """Refuse a background that does not belong to an image.

    Returns:
        It and its circle of confusion; None if there is none.

    Raises:
        ValueError: If one of both is missing, shapes or types are wrong, or nothing hides anything.
    """
    both_or_none(behind, coc_px)
    if behind is None or coc_px is None:
        return None
    if not options.occlusion:
        raise ValueError("without occlusion nothing is hidden: a background needs occlusion=True")
    if (
        not isinstance(behind, Tensor)
        or not isinstance(coc_px, Tensor)
        or behind.shape != image.shape
        or behind.dtype != image.dtype
    ):
        got = f"{behind.dtype} {list(behind.shape)}" if isinstance(behind, Tensor) else type(behind).__name__
        raise ValueError(f"background must be as the image is, {image.dtype} {list(image.shape)}, got {got}")
    image_and_coc(behind, coc_px, table, values=options.check)
    return behind, coc_px


def stack(rgba: Tensor, depth_m: Tensor, values: bool) -> Tensor:
    """Refuse a stack of layers and depths that do not belong together.

    Returns:
        The depths as ``[B, N, 1, H, W]``, each axis but N of its size or 1.

    Raises:
        ValueError: If shapes or types are wrong, or, with ``values``, a coverage is outside [0, 1].
    """
    for name, value in (("rgba", rgba), ("depth_m", depth_m)):
        if not isinstance(value, Tensor) or not value.is_floating_point():
            got = f"a {value.dtype} tensor" if isinstance(value, Tensor) else type(value).__name__
            raise ValueError(f"{name} must be a floating-point tensor, got {got}")
    if rgba.ndim != 5 or rgba.shape[2] < 2 or 0 in rgba.shape:
        raise ValueError(f"rgba must be [B, N, C + 1, H, W], premultiplied, got {list(rgba.shape)}")
    batch, count, _, height, width = rgba.shape
    depth = depth_m
    if depth.ndim in (1, 2) and depth.shape[-1] == count:
        depth = depth.reshape(-1, count, 1, 1, 1)
    if depth.ndim != 5 or depth.shape[0] not in (1, batch) or depth.shape[1:3] != (count, 1):
        raise ValueError(
            f"depth_m must be [{count}], [{batch}, {count}] or [B, {count}, 1, H, W], got {[*depth_m.shape]}"
        )
    if tuple(depth.shape[3:]) not in ((1, 1), (height, width)):
        raise ValueError(f"depth_m must have the layers' size {height} x {width}, got {list(depth_m.shape)}")
    if values and not is_traced():
        real_tensor("rgba", rgba, "[B, N, C + 1, H, W]")
        real_tensor("depth_m", depth_m, "in metres")
        cover = rgba[:, :, -1]
        bad = int((~((cover >= 0) & (cover <= 1))).sum())
        if bad:
            raise ValueError(
                f"the last channel of rgba is coverage, in [0, 1]; {bad} of {cover.numel()} values are not"
            )
    return depth


def image_and_map(image: Tensor, name: str, value: Tensor, unit: str) -> None:
    """Refuse an image and a map of one number a pixel whose kinds, sizes or devices do not fit.

    Raises:
        ValueError: Naming the one that is wrong.
    """
    _image(image)
    _map(name, unit, value, image)
    if not is_traced():  # there a tensor has no data yet
        real_tensor("image", image, "[B, C, H, W]")
        real_tensor(name, value, f"[B, 1, H, W] {unit}")


def _image(image: Tensor) -> None:
    if not isinstance(image, Tensor):
        raise ValueError(f"image must be a tensor [B, C, H, W] in linear light, got {type(image).__name__}")
    if not image.is_floating_point():
        raise ValueError(f"image must be floating point in linear light, got {image.dtype}; decode it first")
    if image.ndim != 4:
        hint = "; did you forget the batch dimension? use image[None]" if image.ndim == 3 else ""
        raise ValueError(f"image must be [B, C, H, W] in linear light, got {list(image.shape)}{hint}")
    if 0 in image.shape:
        raise ValueError(f"image must have at least one pixel, channel and item, got {list(image.shape)}")


def _map(name: str, unit: str, value: Tensor, image: Tensor) -> None:
    batch, _, height, width = image.shape
    expected = f"{name} must be [{batch}, 1, {height}, {width}] or [1, 1, {height}, {width}] {unit}"
    if not isinstance(value, Tensor) or not value.is_floating_point():
        got = f"a {value.dtype} tensor" if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(f"{expected} and floating point, got {got}")
    if value.ndim != 4:
        hint = "; did you forget the channel dimension?" if value.ndim == 3 else ""
        raise ValueError(f"{expected}, got {list(value.shape)}{hint}")
    if value.shape[1:] != (1, height, width) or value.shape[0] not in (1, batch):
        raise ValueError(f"{expected} as the image is {list(image.shape)}, got {list(value.shape)}")
    if value.device != image.device:
        raise ValueError(f"{name} must be on the image's device {image.device}, got {value.device}")
