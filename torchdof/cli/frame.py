"""One frame from files to a file: what ``torchdof render`` does with each image."""

import dataclasses
import math
import os
import time
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..depth.holes import resolve_holes
from ..depth.kinds import depth_from_values
from ..depth.relative import from_relative
from ..depth.sanity import coc_mistakes, depth_mistakes
from ..depth.size import at_size_of
from ..io.images import Picture, read_image, read_values, write_image
from ..io.metadata import camera_facts
from ..module import blur_by_coc, depth_of_field
from ..optics.camera import Camera
from ..options import Options
from ..validation import coc_of_lens, image_and_map, same_aspect
from .settings import RenderSettings
from .warn_once import WarnOnce

__all__ = ["Frame", "Rendered", "read_frame", "read_metres", "render_frame", "tint_focus"]

_NEAR, _SHARP, _FAR = (0.90, 0.35, 0.0), (0.0, 0.62, 0.20), (0.0, 0.30, 0.85)
_FAINT, _CLEAR = 0.2, 0.6  # change of light to the next pixel, of the brighter one: begins to be an outline, and is one
_DARKEST = 0.05  # of the mean light: what is darker has no outlines of its own


@dataclasses.dataclass(frozen=True)
class Frame:
    """An image and its depth, as read.

    Args:
        picture: The image.
        values: ``[1, 1, H, W]``, depth in metres (signed pixels for coc) without holes.
        holes: How many holes were filled.
    """

    picture: Picture
    values: Tensor
    holes: int


@dataclasses.dataclass(frozen=True)
class Rendered:
    """What was done to a frame, with what, and how long it took; ``str`` says it in one line.

    Args:
        out: The file that was written.
        settings: What the user said.
        camera: The camera; None where the depth map was the circle of confusion itself.
        largest_coc_px: Largest radius of the blur in pixels.
        size: Width and height in pixels.
        holes: How many pixels of depth were filled.
        seconds: From reading to writing.
        remarks: What was not stated: the focus from the file, the lens from the file or assumed.
    """

    out: str
    settings: RenderSettings
    camera: Camera | None
    largest_coc_px: float
    size: tuple[int, int]
    holes: int
    seconds: float
    remarks: tuple[str, ...]

    @property
    def table(self) -> str:
        """Name of the blur table, or its family where it has none."""
        return self.settings.table.name or self.settings.table.family

    def __str__(self) -> str:
        settings, parts = self.settings, []
        if self.camera is not None:
            ends = self.camera.focus_range_m or (self.camera.focus_m,)
            parts.append(
                f"focus {' to '.join(f'{end:.4g}' for end in ends)} m, f/{self.camera.f_number:.3g}, "
                f"{self.camera.focal_length_mm:.4g} mm on {self.camera.sensor_width_mm:.4g} mm"
            )
            angles = {"tilt": self.camera.tilt_deg, "swing": self.camera.swing_deg}
            parts += [f"{name} {angle:.4g} degrees" for name, angle in angles.items() if angle != 0.0]
        parts.append(f"blur radius up to {self.largest_coc_px:.1f} px")
        if settings.show_focus:
            parts.append("focus shown: near orange, sharp green, far blue")
        else:
            parts.append(f"{self.table}, {settings.method}")
            if settings.table.aperture is not None:
                parts.append(repr(settings.table.aperture).removeprefix("Aperture(").removesuffix(")"))
            parts += [] if settings.occlusion else ["no occlusion"]
        if self.holes:
            parts.append(f"{self.holes} px of depth filled ({settings.fill})")
        parts += [f"{self.size[0]} x {self.size[1]}", f"{self.seconds:.2f} s on {settings.device}"]
        return f"{self.out}: " + "; ".join(parts) + (f" [{', '.join(self.remarks)}]" if self.remarks else "")

    def facts(self) -> dict[str, Any]:
        """The same for programs, as JSON-like data."""
        settings, names = self.settings, ("focus_m", "f_number", "focal_length_mm", "sensor_width_mm")
        camera: dict[str, Any] | None = None
        if self.camera is not None:
            camera = {name: float(getattr(self.camera, name)) for name in names}
            ends = self.camera.focus_range_m
            camera |= {"focus_range_m": None if ends is None else [float(end) for end in ends]}
            camera |= {"tilt_deg": float(self.camera.tilt_deg), "swing_deg": float(self.camera.swing_deg)}
        facts: dict[str, Any] = {"out": self.out, "camera": camera, "assumed": self.remarks}
        facts |= {"largest_coc_px": self.largest_coc_px, "width": self.size[0], "height": self.size[1]}
        facts |= {"filled_px": self.holes, "show_focus": settings.show_focus}
        if not settings.show_focus:
            aperture = settings.table.aperture
            facts |= {"table": self.table, "aperture": None if aperture is None else aperture.to_dict()}
            facts |= {"method": settings.method, "occlusion": settings.occlusion}
            facts |= {"tolerance": settings.tolerance, "attention": settings.attention}
        return facts | {"seconds": self.seconds, "device": str(settings.device)}


def read_frame(image: str | os.PathLike[str], depth: str | os.PathLike[str] | None, settings: RenderSettings) -> Frame:
    """Reads an image and its depth.

    Args:
        image: Image file.
        depth: Depth file; None takes the depth channel of the image.
        settings: What the user said.

    Raises:
        ValueError: If input is wrong or missing.
        OSError: If a file cannot be read.
    """
    picture = read_image(image, settings.transfer, settings.layer)
    values = read_metres(image, depth, picture, settings)
    return Frame(picture, *resolve_holes(values, str(image if depth is None else depth), settings.fill))


def render_frame(
    image: str | os.PathLike[str],
    depth: str | os.PathLike[str] | None,
    out: str | os.PathLike[str],
    settings: RenderSettings,
    frame: int = 0,
    warned: WarnOnce | None = None,
    source: Frame | None = None,
) -> Rendered:
    """Reads an image and its depth, blurs, and writes the result whole or not at all.

    Args:
        image: Image file.
        depth: Depth file; None takes the depth channel of the image.
        out: File to write.
        settings: What the user said.
        frame: Number of the frame, for focus that moves.
        warned: What was warned of in frames before; None warns of everything.
        source: What is in ``image`` and ``depth`` where it was read already.

    Returns:
        What was done, with what, and how long it took.

    Raises:
        ValueError: If input is wrong or missing, or looks like a mistake and the settings are strict.
        OSError: If a file cannot be read or written.
    """
    warned = WarnOnce(settings.strict) if warned is None else warned
    if any(os.path.realpath(source) == os.path.realpath(out) for source in (image, depth) if source is not None):
        raise ValueError(f"{out}: is one of the inputs; write to another file")
    start = time.perf_counter()
    source = read_frame(image, depth, settings) if source is None else source
    picture, holes = source.picture, source.holes
    height, width = picture.pixels.shape[-2:]
    values = source.values.to(settings.device)
    camera: Camera | None = None
    remarks: list[str] = []
    if settings.depth_kind == "coc":
        coc_px = values
        warned.warn(depth or image, coc_mistakes(coc_px))
    else:
        camera, remarks = settings.camera(picture.metadata, width, frame)
        if settings.focus_at is not None:
            camera = camera.focus_at(values, *settings.focus_at)
        coc_px = camera.coc_px(values, width)
        coc_of_lens(coc_px, values, settings.stated(camera))
        warned.warn(depth or image, depth_mistakes(values, camera, settings.depth_kind, settings.depth_scale))
    pixels = picture.pixels.to(settings.device)
    if settings.show_focus:
        pixels = tint_focus(pixels, coc_px, picture.has_alpha)
        picture = dataclasses.replace(picture, channels=("R", "G", "B", "A")[: pixels.shape[1]])
    else:
        table = settings.table
        if picture.has_alpha and table.channels > 1:  # alpha is blurred as green is
            params = {name: torch.cat([v, v[1:2]]) for name, v in table.node_params.items()}
            field = table.field
            if field is not None:
                field = dataclasses.replace(field, light=torch.cat([field.light, field.light[1:2]]))
            table = table.replace(params=params, field=field)
        options = Options(
            table, settings.tolerance, settings.occlusion, method=settings.method, depth_edges=settings.depth_edges
        ).arguments()
        with torch.no_grad():
            if camera is None:
                pixels = blur_by_coc(pixels, coc_px, attention=settings.attention, **options)
            else:
                pixels = depth_of_field(pixels, values, camera, attention=settings.attention, **options)
    write_image(out, dataclasses.replace(picture, pixels=pixels), settings.out_transfer, settings.sample)
    largest, seconds = float(coc_px.abs().max()), time.perf_counter() - start
    return Rendered(str(out), settings, camera, largest, (width, height), holes, seconds, tuple(remarks))


def tint_focus(image: Tensor, coc_px: Tensor, has_alpha: bool = False) -> Tensor:
    """The image with outlines in colour: green in focus (radius of at most 1 px), orange nearer, blue farther.

    Everything else keeps its colours. Outlines are where the image's light changes by more than a third from pixel to
    pixel, and where one of the three zones meets another.

    Args:
        image: ``[B, C, H, W]`` in linear light, C of 1 or 3, one more with alpha (premultiplied).
        coc_px: ``[B, 1, H, W]``, signed radius in pixels.
        has_alpha: Whether the last channel is alpha.

    Returns:
        ``[B, 3, H, W]``, or ``[B, 4, H, W]`` with alpha.

    Raises:
        ValueError: If shapes or types are not as described.

    Example:
        >>> coc_px = torch.tensor([-3.0, -3.0, 0.2, 5.0, 5.0])[None, None, None]
        >>> tinted = tint_focus(torch.ones(1, 3, 1, 5), coc_px)
        >>> tinted[0, :, 0, 1:4].argmax(dim=0)  # red, green and blue are strongest where zones meet
        tensor([0, 1, 2])
        >>> tinted[0, :, 0, 0]
        tensor([1., 1., 1.])
    """
    image_and_map(image, "coc_px", coc_px, "in pixels")
    if image.shape[1] - has_alpha not in (1, 3):
        raise ValueError(f"image must have 1 or 3 channels of colour, got {image.shape[1] - has_alpha}")
    colour, alpha = (image[:, :-1], image[:, -1:]) if has_alpha else (image, image[:, :0])
    tints = torch.tensor([_NEAR, _SHARP, _FAR], dtype=image.dtype, device=image.device)
    zone = (coc_px >= -1.0).long() + (coc_px > 1.0).long()
    tint = tints[zone[:, 0]].permute(0, 3, 1, 2)  # [B, H, W, 3] -> [B, 3, H, W]
    grey = colour.mean(dim=1, keepdim=True)
    brightest, darkest = _largest_around(grey), -_largest_around(-grey)
    zones = zone.to(image.dtype)
    meets_another = _largest_around(zones) + _largest_around(-zones) > 0
    contrast = (brightest - darkest) / brightest.clamp(min=_DARKEST * grey.mean().clamp(min=1e-12))
    outline = torch.where(meets_another, 1.0, ((contrast - _FAINT) / (_CLEAR - _FAINT)).clamp(0.0, 1.0))
    shown = tint / tint.amax(dim=1, keepdim=True) * brightest.clamp(min=grey.mean())
    tinted = torch.lerp(colour.expand_as(shown), shown, outline.expand_as(shown))
    return torch.cat([tinted, alpha], dim=1)


def _largest_around(values: Tensor) -> Tensor:
    """Largest of a pixel and its eight neighbours, ``[B, 1, H, W]``."""
    return functional.max_pool2d(values, 3, stride=1, padding=1)


def read_metres(
    image: str | os.PathLike[str], depth: str | os.PathLike[str] | None, picture: Picture, settings: RenderSettings
) -> Tensor:
    """Depth in metres (signed pixels for coc) as the file has it, ``[1, 1, H, W]``, NaN in holes.

    Args:
        image: Image file.
        depth: Depth file; None takes the depth channel of the image.
        picture: What is in the image file.
        settings: What the user said.

    Raises:
        ValueError: If input is wrong or missing.
        OSError: If a file cannot be read.
    """
    if depth is not None:
        values = read_values(depth, settings.depth_channel)
    elif settings.depth_channel is not None:
        values = read_values(image, settings.depth_channel)
    elif picture.depth is not None:
        values = picture.depth
    else:
        raise ValueError(f"{image}: has no depth channel; name a depth file after it: IMAGE DEPTH")
    name = str(depth if depth is not None else image)
    kind = settings.depth_kind
    (h, w), (ih, iw) = values.shape[-2:], picture.pixels.shape[-2:]
    if kind == "coc" and (h, w) != (ih, iw):
        raise ValueError(f"{name}: coc is {w} x {h} pixels but the image is {iw} x {ih}; they must be the same")
    try:
        same_aspect(picture.pixels, values)
        if kind == "relative":
            metres = from_relative(
                values,
                settings.near_m or 0.0,  # the settings refuse to be without
                settings.far_m or 0.0,
                settings.relative_kind or "disparity",
                value_range=settings.value_range,
                unknown=settings.depth_unknown,
            )
            return at_size_of(picture.pixels, metres)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    fov_x_deg = settings.fov_x_deg
    if kind == "distance" and fov_x_deg is None:
        facts = camera_facts(picture.metadata, iw)
        focal_mm = settings.focal_length_mm or facts.get("focal_length_mm")
        sensor_mm = settings.sensor_width_mm or facts.get("sensor_width_mm")
        if focal_mm is None or sensor_mm is None:
            raise ValueError("--depth-kind distance needs --fov-deg, or --focal-length-mm and --sensor-width-mm")
        fov_x_deg = 2 * math.degrees(math.atan(sensor_mm / (2 * focal_mm)))
    metres = depth_from_values(
        values,
        kind,
        scale=settings.depth_scale,
        offset=settings.depth_offset,
        unknown=settings.depth_unknown,
        fov_x_deg=fov_x_deg,
    )
    return metres if kind == "coc" else at_size_of(picture.pixels, metres)
