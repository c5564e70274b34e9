"""One frame from files to a file: what ``torchdof render`` does with each image."""

import dataclasses
import math
import os
import time

import torch
from torch import Tensor

from ..depth.holes import resolve_holes
from ..depth.kinds import depth_from_values
from ..depth.relative import from_relative
from ..depth.sanity import coc_doubts, depth_doubts
from ..depth.size import at_size_of
from ..io.images import Picture, read_image, read_values, write_image
from ..io.metadata import camera_facts
from ..module import blur_by_coc, depth_of_field
from ..options import Options
from ..validation import coc_of_lens, image_and_map, same_aspect
from .doubts import Said
from .settings import RenderSettings

__all__ = ["Frame", "read_frame", "read_metres", "render_frame", "tint_focus"]

_NEAR, _SHARP, _FAR = (0.90, 0.35, 0.0), (0.0, 0.62, 0.20), (0.0, 0.30, 0.85)


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
    said: Said | None = None,
    source: Frame | None = None,
) -> str:
    """Reads an image and its depth, blurs, and writes the result whole or not at all.

    Args:
        image: Image file.
        depth: Depth file; None takes the depth channel of the image.
        out: File to write.
        settings: What the user said.
        frame: Number of the frame, for focus that moves.
        said: What was warned of in frames before; None warns of everything.
        source: What is in ``image`` and ``depth`` where it was read already.

    Returns:
        One line that says what was done, with what, and how long it took.

    Raises:
        ValueError: If input is wrong or missing, or looks like a mistake and the settings are strict.
        OSError: If a file cannot be read or written.
    """
    said = Said(settings.strict) if said is None else said
    if any(os.path.realpath(source) == os.path.realpath(out) for source in (image, depth) if source is not None):
        raise ValueError(f"{out}: is one of the inputs; write to another file")
    start = time.perf_counter()
    source = read_frame(image, depth, settings) if source is None else source
    picture, holes = source.picture, source.holes
    height, width = picture.pixels.shape[-2:]
    values = source.values.to(settings.device)
    parts: list[str] = []
    remarks: list[str] = []
    if settings.depth_kind == "coc":
        camera, coc_px = None, values
        said.say(depth or image, coc_doubts(coc_px))
    else:
        camera, remarks = settings.camera(picture.metadata, width, frame)
        if settings.focus_at is not None:
            camera = camera.focus_at(values, *settings.focus_at)
        coc_px = camera.coc_px(values, width)
        coc_of_lens(coc_px, values, settings.stated(camera))
        said.say(depth or image, depth_doubts(values, camera, settings.depth_kind, settings.depth_scale))
        focus = f"{camera.focus_m:.4g}"
        if camera.focus_range_m is not None:
            focus = " to ".join(f"{end:.4g}" for end in camera.focus_range_m)
        parts.append(
            f"focus {focus} m, f/{camera.f_number:.3g}, {camera.focal_length_mm:.4g} mm on "
            f"{camera.sensor_width_mm:.4g} mm"
        )
        for name, angle in (("tilt", camera.tilt_deg), ("swing", camera.swing_deg)):
            if angle != 0.0:
                parts.append(f"{name} {angle:.4g} degrees")
    parts.append(f"blur radius up to {float(coc_px.abs().max()):.1f} px")
    pixels = picture.pixels.to(settings.device)
    if settings.show_focus:
        pixels = tint_focus(pixels, coc_px, picture.has_alpha)
        parts.append("focus shown: near orange, sharp green, far blue")
        picture = dataclasses.replace(picture, channels=("R", "G", "B", "A")[: pixels.shape[1]])
    else:
        table = settings.table
        if picture.has_alpha and table.channels > 1:  # alpha is blurred as green is
            params = {name: torch.cat([v, v[1:2]]) for name, v in table.node_params.items()}
            table = table.replace(params=params)
        options = Options(
            table, settings.tolerance, settings.occlusion, method=settings.method, depth_edges=settings.depth_edges
        ).arguments()
        with torch.no_grad():
            if camera is None:
                pixels = blur_by_coc(pixels, coc_px, **options)
            else:
                pixels = depth_of_field(pixels, values, camera, **options)
        parts.append(f"{settings.table.name or settings.table.family}, {settings.method}")
        if settings.table.aperture is not None:
            parts.append(repr(settings.table.aperture).removeprefix("Aperture(").removesuffix(")"))
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
    image_and_map(image, "coc_px", coc_px, "in pixels")
    if image.shape[1] - has_alpha not in (1, 3):
        raise ValueError(f"image must have 1 or 3 channels of colour, got {image.shape[1] - has_alpha}")
    colour, alpha = (image[:, :-1], image[:, -1:]) if has_alpha else (image, image[:, :0])
    grey = colour.mean(dim=1, keepdim=True)
    tints = torch.tensor([_NEAR, _SHARP, _FAR], dtype=image.dtype, device=image.device)
    zone = (coc_px >= -1.0).long() + (coc_px > 1.0).long()
    tint = tints[zone[:, 0]].permute(0, 3, 1, 2)  # [B, H, W, 3] -> [B, 3, H, W]
    tinted = 0.35 * colour + 0.65 * grey * tint / tint.mean(dim=1, keepdim=True)
    return torch.cat([tinted, alpha], dim=1)


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
        raise ValueError(
            f"{image}: has no depth channel; name a depth file after it: torchdof render IMAGE DEPTH -o OUT"
        )
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
