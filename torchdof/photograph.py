"""What ``torchdof render`` does with a photograph, as a function."""

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from .validation import show

if TYPE_CHECKING:
    from .io.images import Picture
    from .optics.camera import Camera

__all__ = ["Photo", "photo"]

_OF_FILES = {"image", "depth", "out", "sheet", "frames", "steady", "resume", "as_json", "out_transfer", "bits"}


@dataclasses.dataclass(frozen=True)
class Photo:
    """The result of :func:`photo`.

    Args:
        picture: The photograph after rendering, which :func:`torchdof.io.images.write_image` writes.
        depth: The depth that was used, ``[1, 1, H, W]`` in metres (the signed blur radius in pixels for
            ``depth_kind="coc"``).
        coc_px: Signed blur radius, ``[1, 1, H, W]``, in pixels.
        camera: The camera that was used; None for ``depth_kind="coc"``.
        notes: Guesses, assumptions and warnings, as the command prints them.
    """

    picture: "Picture"
    depth: Tensor
    coc_px: Tensor
    camera: "Camera | None"
    notes: tuple[str, ...]

    @property
    def pixels(self) -> Tensor:
        """The picture ``[1, C, H, W]`` in linear light."""
        return self.picture.pixels


def photo(
    image: str | os.PathLike[str] | Tensor,
    depth: str | os.PathLike[str] | Tensor | None = None,
    **options: Any,
) -> Photo:
    """Blurs a photograph by its depth as ``torchdof render`` does: guesses the kind of depth, the subject, the blur.

    Args:
        image: A file, or ``[1, C, H, W]`` in linear light with 1 or 3 channels, or with alpha at the end.
        depth: A file, or the numbers of a map, ``[1, 1, h, w]`` of any kind; None for an EXR with Z or a portrait.
        **options: Those of the command, with underscores: ``focus_m=2.0``, ``focus_at=(320, 200)``, ``f_number=1.8``,
            ``blur=0.03`` (the largest blur radius over the width), ``equivalent=(85, 1.4)``, ``matte="mask.png"`` (or
            coverage ``[1, 1, H, W]``), ``depth_kind="z"``, ``depth_scale=0.001``, ``near_m=1.0``, ``table="sato_j15"``,
            ``tolerance="draft"``, ``device="cuda"``, ...

    Returns:
        The picture, and the depth, blur, camera and assumptions with which it was rendered.

    Raises:
        OSError: If a file cannot be read.
        ValueError: If an option is unknown or contradicts another one, or as the command refuses it.

    Example:
        >>> import torch
        >>> depth = torch.linspace(1, 0, 48).reshape(1, 1, 48, 1).expand(1, 1, 48, 64)  # relative, larger is nearer
        >>> result = photo(torch.rand(1, 3, 48, 64), depth, blur=0.05)
        >>> round(float(result.coc_px.abs().max()), 1), len(result.notes) > 0
        (3.2, True)
    """
    from .cli.output import Notices
    from .cli.render import Render
    from .cli.renderer import Renderer  # these import Click and Kornia

    names = {field.name for field in dataclasses.fields(Render)} - _OF_FILES
    if unknown := sorted(set(options) - names):
        raise ValueError(f"unknown options {', '.join(unknown)}; expected some of {', '.join(sorted(names))}")
    if isinstance(options.get("focus_m"), int | float):
        options["focus_m"] = [(0, float(options["focus_m"]))]
    if (points := options.get("focus_at")) and isinstance(points[0], int | float):
        options["focus_at"] = (tuple(points),)  # one point; several give a range of focus
    if (share := options.get("blur")) is not None and not (isinstance(share, int | float) and 0 < share <= 0.5):
        raise ValueError(f"blur must be a share of the width, above 0 and at most 0.5, such as 0.02, got {show(share)}")
    picture, source = _picture(image) if isinstance(image, Tensor) else Path(image), Path("image")
    command = Render(image=source, depth=None, out=Path("out"), **options)
    command.refuse_keyframes()
    renderer = Renderer(command, is_still=True)
    renderer.notices = Notices(command.strict, is_printed=False)
    map_or_file = depth if depth is None or isinstance(depth, Tensor) else Path(depth)
    frame, rendered, coc_px, camera = renderer.rendered(renderer.read(picture, map_or_file))
    return Photo(rendered, frame.values, coc_px, camera, (*renderer.notices.lines, *frame.remarks))


def _picture(pixels: Tensor) -> "Picture":
    from .io.images import Picture

    channels = {1: ("Y",), 2: ("Y", "A"), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}
    if pixels.ndim != 4 or pixels.shape[0] != 1 or pixels.shape[1] not in channels:
        raise ValueError(f"image must be [1, C, H, W] with 1 to 4 channels in linear light, got {list(pixels.shape)}")
    return Picture(pixels, channels[pixels.shape[1]])
