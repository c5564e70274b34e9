"""One frame from files to a file: what ``torchdof render`` does with each image."""

import dataclasses
import math
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from . import check
from .arguments import number, show
from .camera import Camera
from .depthmap import DepthKind, depth_from_values, resolve_holes
from .files import Picture, read_image, read_values, write_image
from .metadata import camera_facts
from .module import blur_by_coc, depth_of_field
from .sequence import focus_at_frame
from .stored import Sample
from .table import BlurTable
from .transfer import Transfer

__all__ = ["RenderSettings", "load_table", "pick_device", "render_frame", "tint_focus"]

_NEAR, _SHARP, _FAR = (0.90, 0.35, 0.0), (0.0, 0.62, 0.20), (0.0, 0.30, 0.85)
_ASSUMED = {"focal_length_mm": 50.0, "f_number": 2.8, "sensor_width_mm": 36.0}


@dataclasses.dataclass(frozen=True)
class RenderSettings:
    """What the user said; None where nothing was said.

    Args:
        focus: Keyframes (frame, metres); a plain distance is one keyframe.
        focus_at: Pixel (x, y) to focus on.
        f_number: Focal length over aperture diameter.
        focal_length_mm: Focal length in millimetres.
        sensor_width_mm: Width of the sensor in millimetres.
        fov_x_deg: Horizontal field of view in degrees, of a rendered image.
        aperture_radius_m: Radius of the aperture in metres, with ``fov_x_deg``.
        depth_kind: What the numbers of the depth map are, see :func:`torchdof.depthmap.depth_from_values`.
        depth_scale: Factor of the depth values.
        depth_offset: Added to the depth values first.
        depth_unknown: Value that means "not measured".
        depth_channel: Channel or array that holds depth.
        fill: How to fill holes in the depth; None refuses them.
        table: Blur table.
        tolerance: Accepted RMS error, as in :class:`torchdof.DepthOfField`.
        occlusion: False for the paper's single pass without occlusion.
        method: "layered" or "fold".
        device: Where to compute.
        transfer: How the image is encoded.
        out_transfer: How the result is encoded.
        sample: What the result stores a pixel as.
        layer: Layer of an EXR file.
        show_focus: Tint the image by what is in focus instead of blurring it.

    Raises:
        ValueError: If two of these contradict each other.
    """

    focus: list[tuple[int, float]] | None = None
    focus_at: tuple[float, float] | None = None
    f_number: float | None = None
    focal_length_mm: float | None = None
    sensor_width_mm: float | None = None
    fov_x_deg: float | None = None
    aperture_radius_m: float | None = None
    depth_kind: DepthKind = "z"
    depth_scale: float | None = None
    depth_offset: float = 0.0
    depth_unknown: float | None = None
    depth_channel: str | None = None
    fill: Literal["nearest", "far"] | float | None = None
    table: BlurTable = dataclasses.field(default_factory=BlurTable.disc)
    tolerance: float = 1 / 255
    occlusion: bool = True
    method: Literal["layered", "fold"] = "layered"
    device: torch.device = torch.device("cpu")
    transfer: Transfer | None = None
    out_transfer: Transfer | None = None
    sample: Sample | None = None
    layer: str | None = None
    show_focus: bool = False

    def __post_init__(self) -> None:
        if self.focus is not None and self.focus_at is not None:
            raise ValueError("--focus-m and --focus-at both say where to focus; give one of them")
        if self.depth_kind == "coc":
            camera = ("focus", "focus_at", "f_number", "focal_length_mm", "sensor_width_mm", "aperture_radius_m")
            if any(getattr(self, name) is not None for name in camera):
                raise ValueError(
                    "--depth-kind coc is the blur itself and takes no camera; leave focus and lens options out"
                )
        if self.fov_x_deg is None:
            if self.aperture_radius_m is not None:
                raise ValueError("--aperture-radius-m goes with --fov-deg; a real lens has --f-number instead")
            return
        if self.focal_length_mm is not None or self.sensor_width_mm is not None:
            raise ValueError("--fov-deg and --focal-length-mm with --sensor-width-mm say the same; give one of them")
        number("--fov-deg", self.fov_x_deg, low=0, high=180, unit="degrees")
        if self.f_number is not None and self.aperture_radius_m is not None:
            raise ValueError("--f-number and --aperture-radius-m both say how wide the lens opens; give one of them")

    def camera(self, metadata: Mapping[str, Any], width: int, frame: int) -> tuple[Camera, list[str]]:
        """The camera of one frame: what the user said, else the file's metadata, else 50 mm, f/2.8 and 36 mm.

        Returns:
            The camera (at a focus of infinity where that comes from a pixel) and remarks on what was not stated.
        """
        facts = camera_facts(metadata, width)
        remarks = []
        focus_m = math.inf
        if self.focus is not None:
            focus_m = focus_at_frame(self.focus, frame)
        elif self.focus_at is None:
            if "focus_m" not in facts:
                raise ValueError("where is the focus? give --focus-m METRES or --focus-at X,Y (the file does not say)")
            focus_m = facts["focus_m"]
            remarks.append("focus from the file")
        if self.fov_x_deg is not None:
            radius_m = self.aperture_radius_m
            if radius_m is None and self.f_number is not None:  # on the equivalent sensor, 36 mm wide
                radius_m = 18.0 / math.tan(math.radians(self.fov_x_deg) / 2) / (2000.0 * self.f_number)
            if radius_m is None:
                raise ValueError("--fov-deg needs the opening of the lens: either --aperture-radius-m or --f-number")
            return Camera.from_fov(self.fov_x_deg, radius_m, focus_m), remarks
        lens: dict[str, float] = {}
        for name, assumed in _ASSUMED.items():
            said = getattr(self, name)
            lens[name] = facts.get(name, assumed) if said is None else said
            if said is None:
                plain = name.rsplit("_", 1)[0].replace("_", " ") if name != "f_number" else "f-number"
                remarks.append(f"{plain} {'from the file' if name in facts else 'assumed'}")
        return Camera(lens["focal_length_mm"], lens["f_number"], focus_m, lens["sensor_width_mm"]), remarks


def render_frame(
    image: str | os.PathLike[str],
    depth: str | os.PathLike[str] | None,
    out: str | os.PathLike[str],
    settings: RenderSettings,
    frame: int = 0,
) -> str:
    """Reads an image and its depth, blurs, and writes the result whole or not at all.

    Args:
        image: Image file.
        depth: Depth file; None takes the depth channel of the image.
        out: File to write.
        settings: What the user said.
        frame: Number of the frame, for focus that moves.

    Returns:
        One line that says what was done, with what, and how long it took.

    Raises:
        ValueError: If input is wrong or missing.
        OSError: If a file cannot be read or written.
    """
    if any(Path(source).resolve() == Path(out).resolve() for source in (image, depth) if source is not None):
        raise ValueError(f"{out}: is one of the inputs; write to another file")
    start = time.perf_counter()
    picture = read_image(image, settings.transfer, settings.layer)
    height, width = picture.pixels.shape[-2:]
    values, holes = _depth(image, depth, picture, settings)
    values = values.to(settings.device)
    parts: list[str] = []
    remarks: list[str] = []
    if settings.depth_kind == "coc":
        camera, coc_px = None, values
    else:
        camera, remarks = settings.camera(picture.metadata, width, frame)
        if settings.focus_at is not None:
            camera = camera.focus_at(values, *settings.focus_at)
        coc_px = camera.coc_px(values, width)
        parts.append(_describe(camera))
    parts.append(f"blur radius up to {float(coc_px.abs().max()):.1f} px")
    pixels = picture.pixels.to(settings.device)
    if settings.show_focus:
        pixels = tint_focus(pixels, coc_px, picture.has_alpha)
        parts.append("focus shown: near orange, sharp green, far blue")
        picture = dataclasses.replace(picture, channels=("R", "G", "B", "A")[: pixels.shape[1]])
    else:
        table = _with_alpha(settings.table) if picture.has_alpha else settings.table
        how: dict[str, Any] = {"table": table, "tolerance": settings.tolerance}
        how |= {"occlusion": settings.occlusion, "method": settings.method}
        with torch.no_grad():
            blurred = (
                blur_by_coc(pixels, coc_px, **how) if camera is None else depth_of_field(pixels, values, camera, **how)
            )
        pixels = blurred
        parts.append(f"{settings.table.name or settings.table.family}, {settings.method}")
        if not settings.occlusion:
            parts.append("no occlusion")
    write_image(out, dataclasses.replace(picture, pixels=pixels), settings.out_transfer, settings.sample)
    if holes:
        parts.append(f"{holes} px of depth filled ({settings.fill})")
    parts += [f"{width} x {height}", f"{time.perf_counter() - start:.2f} s on {settings.device}"]
    return f"{out}: " + "; ".join(parts) + (f" [{', '.join(remarks)}]" if remarks else "")


def tint_focus(image: Tensor, coc_px: Tensor, has_alpha: bool = False) -> Tensor:
    """The image with what is in focus (blur radius of at most 1 px) green, nearer orange and farther blue.

    Args:
        image: ``[B, C, H, W]`` in linear light, C of 1 or 3, one more with alpha (premultiplied).
        coc_px: ``[B, 1, H, W]``, signed radius in pixels.
        has_alpha: Whether the last channel is alpha.

    Returns:
        ``[B, 3, H, W]``, or ``[B, 4, H, W]`` with alpha.

    Raises:
        ValueError: If shapes or types are not as described.

    Example:
        >>> tinted = tint_focus(torch.ones(1, 1, 1, 3), torch.tensor([[[[-3.0, 0.2, 5.0]]]]))
        >>> tinted[0, :, 0].argmax(dim=0)  # red, green and blue are strongest
        tensor([0, 1, 2])
    """
    check.image_and_map(image, "coc_px", coc_px, "in pixels")
    if image.shape[1] - has_alpha not in (1, 3):
        raise ValueError(f"image must have 1 or 3 channels of colour, got {image.shape[1] - has_alpha}")
    colour, alpha = (image[:, :-1], image[:, -1:]) if has_alpha else (image, image[:, :0])
    grey = colour.mean(dim=1, keepdim=True)
    tints = torch.tensor([_NEAR, _SHARP, _FAR], dtype=image.dtype, device=image.device)
    which = (coc_px >= -1.0).long() + (coc_px > 1.0).long()
    tint = tints[which[:, 0]].permute(0, 3, 1, 2)  # [B, H, W, 3] -> [B, 3, H, W]
    tinted = 0.35 * colour + 0.65 * grey * tint / tint.mean(dim=1, keepdim=True)
    return torch.cat([tinted, alpha], dim=1)


def load_table(name: str) -> BlurTable:
    """A blur table by name ("disc", "gaussian", a shipped one) or by the path of its JSON file.

    Raises:
        ValueError: If there is no such table or it is not valid.
        OSError: If the file cannot be read.
    """
    if name in ("disc", "gaussian"):
        return BlurTable.disc() if name == "disc" else BlurTable.gaussian()
    return BlurTable.load(name)


def pick_device(name: str) -> torch.device:
    """A device by name; "auto" is CUDA where there is one, else the CPU.

    Raises:
        ValueError: If there is no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if not isinstance(name, str):
        raise ValueError(f"--device must be a name such as auto, cpu or cuda:1, got {show(name)}")
    try:
        device = torch.device(name)
        torch.empty(1, device=device).sum().item()
    except (RuntimeError, AssertionError, NotImplementedError):
        raise ValueError(f"--device {name}: there is no such device here; use cpu") from None
    return device


def _depth(
    image: str | os.PathLike[str], depth: str | os.PathLike[str] | None, picture: Picture, settings: RenderSettings
) -> tuple[Tensor, int]:
    """Depth in metres (or coc) without holes, ``[1, 1, H, W]``, and how many holes there were."""
    if depth is not None:
        values = read_values(depth, settings.depth_channel)
    elif settings.depth_channel is not None:
        values = read_values(image, settings.depth_channel)
    elif picture.depth is not None:
        values = picture.depth
    else:
        raise ValueError(
            f"{image}: has no depth channel; name a depth file after it: torchdof render IMAGE DEPTH -o OUT"
        )
    name = str(depth if depth is not None else image)
    if values.shape[-2:] != picture.pixels.shape[-2:]:
        (h, w), (ih, iw) = values.shape[-2:], picture.pixels.shape[-2:]
        raise ValueError(f"{name}: depth is {w} x {h} pixels but the image is {iw} x {ih}; they must be the same")
    fov_x_deg = settings.fov_x_deg
    if settings.depth_kind == "distance" and fov_x_deg is None:
        facts = camera_facts(picture.metadata, values.shape[-1])
        focal_mm = settings.focal_length_mm or facts.get("focal_length_mm")
        sensor_mm = settings.sensor_width_mm or facts.get("sensor_width_mm")
        if focal_mm is None or sensor_mm is None:
            raise ValueError("--depth-kind distance needs --fov-deg, or --focal-length-mm and --sensor-width-mm")
        fov_x_deg = 2 * math.degrees(math.atan(sensor_mm / (2 * focal_mm)))
    result = depth_from_values(
        values,
        settings.depth_kind,
        scale=settings.depth_scale,
        offset=settings.depth_offset,
        unknown=settings.depth_unknown,
        fov_x_deg=fov_x_deg,
    )
    return resolve_holes(result, name, settings.fill)


def _with_alpha(table: BlurTable) -> BlurTable:
    """A table that blurs colours differently blurs alpha like green."""
    if table.channels == 1:
        return table
    params = {name: torch.cat([v, v[1:2]]) for name, v in table.node_params.items()}
    return BlurTable(table.family, table.coc, params, unit=table.unit, sensor_width_mm=table.sensor_width_mm)


def _describe(camera: Camera) -> str:
    lens = f"focus {camera.focus_m:.4g} m, f/{camera.f_number:.3g}, {camera.focal_length_mm:.4g} mm"
    return f"{lens} on {camera.sensor_width_mm:.4g} mm"
