"""The ComfyUI node: an image and its depth in, the photograph of a real lens out."""

import importlib.resources
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchdof import BlurTable, Camera, blur_by_coc
from torchdof.depth import at_size_of, fill_holes, from_relative
from torchdof.depth.inspect import tint_focus
from torchdof.io.transfer import decode, encode
from torchdof.optics.aperture import Aperture

__all__ = ["NODE_CLASS_MAPPINGS", "NODE_DISPLAY_NAME_MAPPINGS", "DepthOfFieldNode"]

_NEAR_IS_WHITE, _FAR_IS_WHITE, _METRES = "white is near", "white is far", "metres"
_POINT, _DISTANCE = "point", "metres"
_DEPTH_TYPES = "IMAGE,MASK,MOGE_GEOMETRY,DA3_GEOMETRY"  # the last two are dicts of ComfyUI's own MoGe and DA3 nodes
_SKY = 0.5  # probability of sky above which a pixel of Depth Anything 3 is infinitely far
_SHAPES = {"as the lens": None, **{f"{count} blades": count for count in range(5, 10)}}


def _lenses() -> list[str]:
    """Names of lenses: the ideal ones, then the tables that come with torchdof."""
    folder = importlib.resources.files("torchdof.optics") / "tables"
    return ["disc", "gaussian", *sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".json"))]


def _number(default: float, low: float, high: float, step: float, tooltip: str) -> tuple[str, dict[str, Any]]:
    return "FLOAT", {"default": default, "min": low, "max": high, "step": step, "tooltip": tooltip}


def _progress(images: int) -> Callable[[], object]:
    """A function that moves ComfyUI's progress bar by one image; without ComfyUI it does nothing."""
    try:
        from comfy.utils import ProgressBar  # type: ignore[import-not-found]
    except ImportError:
        return lambda: None
    bar = ProgressBar(images)
    return lambda: bar.update(1)


class DepthOfFieldNode:
    """Blurs an image by its depth as a lens would, focused on a point or at a distance."""

    DESCRIPTION = "The photograph that a real lens would have taken, from an all-in-focus image and its depth."
    CATEGORY = "image/filters"
    FUNCTION = "render"
    RETURN_TYPES = ("IMAGE", "IMAGE")
    RETURN_NAMES = ("image", "focus")
    OUTPUT_TOOLTIPS = ("The photograph.", "The sharp image, near orange, in focus green, far blue.")

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, dict[str, tuple[Any, ...]]]:  # noqa: N802 (ComfyUI's name)
        """Inputs of the node, in ComfyUI's format."""
        return {
            "required": {
                "image": ("IMAGE", {"tooltip": "All in focus."}),
                "depth": (
                    _DEPTH_TYPES,
                    {"tooltip": "Its depth, of any size; another shape is stretched to the image's."},
                ),
                "depth_kind": (
                    [_NEAR_IS_WHITE, _FAR_IS_WHITE, _METRES],
                    {
                        "tooltip": "Depth Anything and MiDaS paint near white, Marigold far; or the values are metres. "
                        "A geometry has metres, or is scaled to near_m and far_m."
                    },
                ),
                "near_m": _number(
                    1.0, 0.05, 1000.0, 0.05, "Distance of the nearest value in metres, if not in metres."
                ),
                "far_m": _number(10.0, 0.1, 1e5, 0.1, "Distance of the farthest value in metres, if not in metres."),
                "focus": ([_POINT, _DISTANCE], {"tooltip": "Focus on the surface at a point, or at a distance."}),
                "focus_x": _number(0.5, 0.0, 1.0, 0.001, "The point: 0 is left, 1 is right."),
                "focus_y": _number(0.5, 0.0, 1.0, 0.001, "The point: 0 is the top, 1 the bottom."),
                "focus_m": _number(2.0, 0.1, 1e5, 0.01, "The distance in metres."),
                "f_number": _number(1.8, 0.1, 64.0, 0.1, "Opening of the lens; smaller blurs more."),
                "focal_length_mm": _number(50.0, 1.0, 2000.0, 1.0, "Focal length; longer blurs more."),
                "sensor_width_mm": _number(36.0, 1.0, 200.0, 0.1, "Width of the sensor that the image fills."),
                "lens": (_lenses(), {"tooltip": "How the lens blurs: ideal, or measured from a real one."}),
                "shape": ([*_SHAPES], {"tooltip": "Shape of points out of focus: the lens's own, or a polygon."}),
                "rotation_deg": _number(0.0, -180.0, 180.0, 1.0, "Turns the polygon counter-clockwise."),
                "squeeze": _number(1.0, 0.5, 2.0, 0.05, "Height of the blur over its width: 2 for an anamorphic lens."),
                "quality": (["final", "preview", "draft"], {"tooltip": "Accepted error: 1, 4 or 8 of 255."}),
            }
        }

    def render(
        self,
        image: Tensor,
        depth: Tensor | dict[str, Any],
        depth_kind: str,
        near_m: float,
        far_m: float,
        focus: str,
        focus_x: float,
        focus_y: float,
        focus_m: float,
        f_number: float,
        focal_length_mm: float,
        sensor_width_mm: float,
        lens: str,
        shape: str,
        rotation_deg: float,
        squeeze: float,
        quality: Any,
    ) -> tuple[Tensor, Tensor]:
        """Renders; the inputs are explained in :meth:`INPUT_TYPES`.

        ``depth`` is an image ``[B or 1, h, w, C]``, a mask ``[B or 1, h, w]`` or a geometry. All images of a batch
        share the range of its values, so that the focus of a clip does not pulse. Pixels without depth (NaN, and in
        metres 0) take that of the surface behind them.

        Returns:
            Two images ``[B, H, W, 3 or 4]`` and ``[B, H, W, 3]``, encoded for display as ComfyUI passes images.

        Raises:
            ValueError: If an input is not as described, or the focus point has no depth.
        """
        if not bool(image.isfinite().all()):
            raise ValueError("image has pixels that are NaN or infinite; look for the node that makes them")
        encoded = image.float().movedim(-1, 1)
        has_alpha = encoded.shape[1] == 4
        light = decode(encoded, "srgb", has_alpha, straight=True)
        values, is_distance = _values(depth)
        if len(values) not in (1, len(image)):
            raise ValueError(f"depth must be one image, or one for each of the {len(image)} images, got {len(values)}")
        values = _metres(values, depth_kind, is_distance, near_m, far_m)
        metres = at_size_of(light, values)
        camera = Camera(focal_length_mm, f_number, focus_m, sensor_width_mm)
        height, width = light.shape[-2:]
        if focus == _POINT:
            camera = camera.focus_at(metres, min(focus_x * width, width - 0.5), min(focus_y * height, height - 0.5))
        ideal = {"disc": BlurTable.disc, "gaussian": BlurTable.gaussian}
        table = ideal[lens]() if lens in ideal else BlurTable.load(lens)
        if _SHAPES[shape] or squeeze != 1.0:
            table = table.replace(aperture=Aperture(_SHAPES[shape] or 0, rotation_deg, squeeze=squeeze))
        coc_px = camera.coc_px(metres, width).expand(len(light), -1, -1, -1)
        advance, rendered = _progress(len(light)), []
        with torch.no_grad():
            for picture, radius in zip(light.split(1), coc_px.split(1), strict=True):
                rendered.append(blur_by_coc(picture, radius, table=table, tolerance=quality))
                advance()
        out = torch.cat(rendered)
        tinted = tint_focus(light, coc_px, has_alpha)[:, :3]
        pictures = encode(out.clamp_min(0.0), "srgb", has_alpha, straight=True), encode(tinted, "srgb", False, False)
        return pictures[0].clamp(0.0, 1.0).movedim(1, -1), pictures[1].clamp(0.0, 1.0).movedim(1, -1)


def _values(depth: Tensor | dict[str, Any]) -> tuple[Tensor, bool]:
    """Values ``[B or 1, 1, h, w]`` of the depth input, and whether larger ones are known to be farther."""
    if isinstance(depth, dict):
        if "depth" not in depth:
            raise ValueError("the geometry has no depth; connect the node that runs MoGe or Depth Anything 3")
        values = depth["depth"].float()
        is_far = ~depth["mask"].bool() if "mask" in depth else torch.zeros_like(values, dtype=torch.bool)
        if "sky" in depth:
            is_far = is_far | (depth["sky"] > _SKY)
        return torch.where(is_far, torch.inf, values)[:, None], True
    values = depth.float()
    if values.ndim == 4:  # an image
        return values[..., :3].mean(-1)[:, None], False
    return values.reshape(-1, 1, *values.shape[-2:]), False  # a mask


def _metres(values: Tensor, depth_kind: str, is_distance: bool, near_m: float, far_m: float) -> Tensor:
    """Metres without holes from the values of the depth input; infinitely far pixels have ``far_m`` or infinity."""
    known = values[values.isfinite() & ((values > 0) | (depth_kind != _METRES))]
    if not len(known):
        raise ValueError("depth has no pixel with a depth, only NaN, infinite or (in metres) zero ones")
    if depth_kind == _METRES:
        metres = torch.where(values > 0, values, torch.nan)
    else:
        extremes = (float(known.min()), float(known.max()))
        if not extremes[0] < extremes[1]:
            raise ValueError(f"depth must have different values, near and far, got {extremes[0]:g} everywhere")
        kind: Any = "disparity" if depth_kind == _NEAR_IS_WHITE and not is_distance else "depth"
        if kind == "depth":
            values = torch.where(values == torch.inf, extremes[1], values)
        metres = from_relative(values, near_m, far_m, kind, value_range=extremes)
    # a frame of a clip without any depth is as far as its farthest frame
    farthest = metres[~metres.isnan()].max()
    return torch.cat([fill_holes(m, "far" if not bool(m.isnan().all()) else float(farthest)) for m in metres.split(1)])


NODE_CLASS_MAPPINGS = {"TorchdofDepthOfField": DepthOfFieldNode}
NODE_DISPLAY_NAME_MAPPINGS = {"TorchdofDepthOfField": "Depth of Field (torchdof)"}
