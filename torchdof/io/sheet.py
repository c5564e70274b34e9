"""Pictures side by side in one file, each with a caption."""

import os

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..validation import real_tensor, show
from .images import Picture, write_image

__all__ = ["shrunk", "write_sheet"]

_MARGIN_PX, _CAPTION_PX = 8, 34  # px between panels; height of the line of captions


def shrunk(pixels: Tensor, longest: int) -> Tensor:
    """Pixels ``[1, C, H, W]`` in linear light, scaled down if the longer side exceeds ``longest`` pixels.

    Example:
        >>> shrunk(torch.ones(1, 3, 40, 80), 20).shape
        torch.Size([1, 3, 10, 20])
    """
    height, width = real_tensor("pixels", pixels, "[1, C, H, W] in linear light").shape[-2:]
    scale = longest / max(height, width)
    if scale >= 1:
        return pixels
    size = (max(1, round(scale * height)), max(1, round(scale * width)))
    return functional.interpolate(pixels, size, mode="bilinear", antialias=True)


def write_sheet(path: str | os.PathLike[str], panels: dict[str, Tensor]) -> None:
    """Writes panels side by side, each with its caption above.

    Args:
        path: Output file, as for :func:`torchdof.io.images.write_image`.
        panels: Caption -> ``[1, 3, H, W]`` in linear light, all of one size.

    Raises:
        ValueError: If the format is unknown.
        OSError: If the file cannot be written.
    """
    import OpenImageIO as oiio

    if not isinstance(panels, dict) or not panels:
        raise ValueError(f"panels must be a dict with at least one panel, caption: pixels, got {show(panels)}")
    height, width = real_tensor("a panel", next(iter(panels.values())), "[1, 3, H, W] in linear light").shape[-2:]
    lefts = range(_MARGIN_PX, len(panels) * (width + _MARGIN_PX), width + _MARGIN_PX)
    sheet = torch.full((1, 3, height + _CAPTION_PX + _MARGIN_PX, lefts.stop + _MARGIN_PX), 0.8)
    for left, panel in zip(lefts, panels.values(), strict=True):
        sheet[:, :, _CAPTION_PX : _CAPTION_PX + height, left : left + width] = panel.cpu()
    buffer = oiio.ImageBuf(sheet[0].permute(1, 2, 0).contiguous().numpy())  # [3, H, W] -> [H, W, 3]
    for left, caption in zip(lefts, panels, strict=True):
        oiio.ImageBufAlgo.render_text(buffer, left, _CAPTION_PX - 11, caption, 20, "", (0.0, 0.0, 0.0))
    pixels = torch.from_numpy(buffer.get_pixels(oiio.FLOAT)).permute(2, 0, 1)[None]
    write_image(path, Picture(pixels, sample="8", transfer="srgb"))
