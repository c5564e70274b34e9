"""Reads a frame for ``torchdof render`` and other commands: an image and its depth in metres."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..depth.holes import resolve_holes
from ..depth.kinds import depth_from_values
from ..depth.relative import from_relative
from ..depth.sanity import Mistake, coc_mistakes, depth_mistakes, whole_numbers
from ..depth.sentinels import without_sentinels
from ..io.estimates import Estimate, estimate_of
from ..io.images import Picture, read_image, read_map
from ..optics.camera import Camera
from ..render.surfaces.resample import resampled
from ..validation import one_channel, stretched, upright
from .lens import Area, Lens
from .options import INTEGER_TYPES, Scene
from .output import Notices


@dataclasses.dataclass(frozen=True)
class Frame:
    """An image and its depth, as read."""

    name: str  # file with the depth
    scene: Scene  # the options, with the guess in the place of "auto"
    picture: Picture
    area: Area  # place of the picture in the frame to which lens and points refer
    values: Tensor  # [1, 1, H, W], depth in metres, or signed radius in pixels for coc
    filled: int  # number of filled holes, in pixels
    remarks: list[str]  # changes of the depth, and assumptions about it, that no option states
    guess: str  # message about the guessed kind of depth, or empty
    fov_x_deg: float | None = None  # horizontal field of view that the depth file states
    matte: Tensor | None = None  # [1, 1, H, W], coverage by a subject

    def mistakes(self, camera: Camera) -> list[Mistake]:
        """Likely mistakes in the depth, given the camera."""
        kind: Any = self.scene.depth_kind
        meant = ["blur"] * (self.scene.blur is not None)  # --blur states it, so that no unit is wrong
        meant += ["gap"] * (len(self.scene.focus_m or []) > 1)  # a focus pull passes between surfaces
        mistakes = depth_mistakes(self.values, camera, kind, self.scene.depth_scale)
        return [mistake for mistake in mistakes if mistake.name not in meant]


def read_frame(
    image: Path | Picture,
    depth: Path | Tensor | None,
    scene: Scene,
    holes: bool = False,
    place: tuple[int, int] | None = None,
    **encoding: Any,
) -> Frame:
    """Reads an image, with arguments of ``read_image``, and its depth; ``holes`` that no option fills stay NaN.

    Both may be in memory already; depth is then the numbers of a map.
    ``place`` is the index of the image in its sequence, and their number, for a file with a map for each of them.
    """
    picture = image if isinstance(image, Picture) else read_image(image, **encoding)
    image = Path("image") if isinstance(image, Picture) else image
    source = Path("depth") if isinstance(depth, Tensor) else depth or image
    values, meaning = _stored(image, depth, picture, scene, place)
    is_file = isinstance(depth, Path) and depth.is_file()
    estimate = estimate_of(source, values.shape[-1], place) if is_file else Estimate()
    scene, values, remarks, guess = _understood(scene, values, source, meaning, estimate, holes)
    height, width = picture.pixels.shape[-2:]
    window = picture.window if image.suffix.lower() == ".exr" else None
    x, y, full_x, full_y, *size = window or (0, 0, 0, 0, width, height)
    area = Area(x - full_x, y - full_y, *size)
    is_coc = scene.depth_kind == "coc"
    try:
        remarks += filter(None, [_refused_or_stretched(picture, values, is_coc)])
        values = _in_metres(scene, values, picture, area, "along_ray" in meaning, estimate.fov_x_deg)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None
    values, filled = values if is_coc else resampled(picture.pixels, values), 0
    fill_by: Any = scene.fill_depth
    if fill_by is not None or not holes:
        values, filled = resolve_holes(values, str(source), fill_by, scene.depth_kind in ("relative", "coc"))
    if scene.depth_kind == "relative" and None in (scene.near_m, scene.far_m):
        remarks.append("depth from {:g} to {:g} m assumed".format(*scene.ends_m))
    return Frame(str(source), scene, picture, area, values, filled, remarks, guess, estimate.fov_x_deg)


def _stored(
    image: Path, depth: Path | Tensor | None, picture: Picture, scene: Scene, place: tuple[int, int] | None
) -> tuple[Tensor, Mapping[str, Any]]:
    """The numbers of a map as they are stored, and what a phone states of them."""
    if isinstance(depth, Tensor):
        one_channel("depth", depth, whole=True)
        return depth.detach().cpu().float(), {}
    if depth is not None or scene.depth_channel is not None:
        return read_map(depth or image, scene.depth_channel, place, picture)
    if picture.depth is not None:
        return picture.depth, picture.depth_meaning
    if picture.depth_problem:
        raise ValueError(f"{image}: {picture.depth_problem}")
    is_exr = image.suffix.lower() == ".exr"
    if is_exr and picture.other_layers:
        return read_map(image)  # whose error lists the channels
    hint = "" if is_exr else ", which a network such as Depth Anything makes of it"
    raise ValueError(f"{image}: has no depth channel; name a depth file after it: IMAGE DEPTH{hint}")


def _understood(
    scene: Scene, values: Tensor, source: Path, meaning: Mapping[str, Any], estimate: Estimate, holes: bool
) -> tuple[Scene, Tensor, list[str], str]:
    """Interprets a map: the options with guessed ones, the numbers without marks of holes, remarks, and the guess."""
    scene, guess = scene.with_meaning(meaning) if meaning else (scene, "")
    known = values if scene.depth_unknown is None else values.masked_fill(values == scene.depth_unknown, math.nan)
    known, sentinels = without_sentinels(known)
    if scene.depth_kind == "auto":
        is_metric = bool(scene.given(Lens) & {"focus_m", "focus_range", "aperture_radius_m"})
        stated_fill = scene.fill_depth
        scene, guess = scene.guessed(known, source, is_metric)
        scene = dataclasses.replace(scene, fill_depth=stated_fill) if holes else scene
        if estimate.metric_scale is not None and scene.depth_kind == "z" and scene.depth_scale is None:
            guess += f"; of the metric model of Depth Anything 3: --depth-scale {estimate.metric_scale:.4g}"
    kind = scene.depth_kind
    is_whole = source.suffix.lower() in INTEGER_TYPES or whole_numbers(known[known.isfinite()])
    is_sky = kind in ("z", "distance") and not is_whole  # a renderer writes a large distance where nothing is
    if not sentinels or is_sky or kind == "coc" or scene.value_range is not None:
        sentinels = ""
    else:
        values = known
        scene = scene if holes or scene.strict else dataclasses.replace(scene, fill_depth=scene.fill_depth or "far")
    if kind == "relative" and scene.relative_kind == "depth":  # -inf is too near to be measured
        values = torch.where(values == -math.inf, torch.where(known.isfinite(), known, math.inf).min(), values)
    return scene, values, [sentinels] if sentinels else [], guess


def _refused_or_stretched(picture: Picture, values: Tensor, is_coc: bool) -> str:
    """Refuses a map that does not fit the image; a remark if it is stretched to the image's shape."""
    (height, width), (rows, columns) = picture.pixels.shape[-2:], values.shape[-2:]
    if is_coc and (rows, columns) != (height, width):
        sizes = f"{columns} x {rows} pixels but the image is {width} x {height}"
        raise ValueError(f"coc is {sizes}; they must be the same")
    upright(picture.pixels, values)
    return stretched(picture.pixels, values)


def _in_metres(
    scene: Scene, values: Tensor, picture: Picture, area: Area, along_ray: bool, fov_x_deg: float | None
) -> Tensor:
    """Depth in metres from the numbers of a map, or the coc in pixels, of the image's part of the frame."""
    kind: Any = scene.depth_kind
    given: dict[str, Any] = {"unknown": scene.depth_unknown}
    part: Any = (...,)
    is_along_ray = kind == "distance" or (kind == "relative" and along_ray)
    if is_along_ray:
        height, width = picture.pixels.shape[-2:]
        centred_width = width + abs(area.width - 2 * area.x - width)
        given["fov_x_deg"] = scene.view_deg(picture.metadata, centred_width, area, fov_x_deg)
        values, part = area.centred(values, (height, width))
    if kind != "relative":
        return depth_from_values(values, kind, scale=scene.depth_scale, offset=scene.depth_offset, **given)[part]
    view_deg = given.pop("fov_x_deg", None)
    values = from_relative(
        values, *scene.ends_m, scene.relative_kind or "disparity", value_range=scene.value_range, **given
    )
    return (depth_from_values(values, "distance", fov_x_deg=view_deg) if is_along_ray else values)[part]


def coc_of(
    frame: Frame, notices: Notices, number: int = 0, is_still: bool = True
) -> tuple[Tensor, Camera | None, list[str]]:
    """Signed radius ``[1, 1, H, W]`` in pixels, the camera (None for ``--depth-kind coc``), and remarks on both."""
    scene, values = frame.scene, frame.values
    if scene.depth_kind == "coc":
        notices.warn(frame.name, coc_mistakes(values))
        return values, None, []
    camera, remarks = scene.camera(frame, number, is_still)
    coc_px = frame.area.coc_px(camera, values)
    camera.refuse_overflow(coc_px, values)
    if frame.guess:
        notices.note("guess", f"{frame.name}: {frame.guess}")
    notices.warn(frame.name, frame.mistakes(camera))
    return coc_px, camera, remarks + frame.remarks
