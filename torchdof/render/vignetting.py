"""Cat's eyes: what a lens's own barrel cuts off its blur, the more the farther from the middle of the frame.

Seen from off the axis, a lens opens through circles that no longer lie behind each other: the aperture's, that of a rim
in front of it and that of one behind it. A ray through the point ``u`` of the aperture, to a place ``p`` in the frame
(from its middle, in half diagonals), passes where ``|u + 2 front p| <= 1`` and ``|u - 2 rear p| <= 1``. So behind the
focus plane the front rim cuts off the side away from the middle of the frame, in front of it the other one, and the
rear rim opposite. The kernel of a place is the table's own with what does not pass left out, and its light made whole
again: how much darker corners are, the sharp image shows already.

The border of what passes is a pixel wide. Kernels are those of where light lands, block by block; highlights take that
of where they come from. Pixels of one block, 4 x 16 of its layer's resolution, share a kernel: beyond a few blocks it
changes by parts of a pixel.
"""

import dataclasses

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..optics.aperture import Aperture

__all__ = ["BLOCK", "CatsEye", "passed"]

BLOCK = (4, 16)
"""Rows and columns of a layer whose pixels share a kernel."""

_LEAST = 1e-6  # of a kernel; where less passes it stays whole


def passed(kernel: Tensor, aperture: Aperture, coc_px: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """Kernels of places in the frame.

    Args:
        kernel: ``[..., C, k, k]``, of the middle of the frame.
        aperture: Whose vignetting and squeeze count.
        coc_px: Signed, in the kernel's pixels, ``[...]``.
        y: Places ``[...]``, in half diagonals down from the middle of the frame.
        x: The same to the right.

    Returns:
        ``[..., C, k, k]``, each with as much light as before.
    """
    step = torch.arange(kernel.shape[-1], dtype=kernel.dtype, device=kernel.device) - kernel.shape[-1] // 2
    coc, y, x = (t.to(kernel.dtype)[..., None, None] for t in (coc_px, y, x))
    front, rear = aperture.rims
    inside = []  # pixels from each rim's edge
    for shift in (2.0 * front * coc, -2.0 * rear * coc):
        # a rim that is shifted by less than a pixel cuts off less: kernels of the middle stay as they are
        slack = 4.0 * (coc.abs() + 1.0) * (1.0 - shift.abs() * _length(y, x)).clamp_min(0.0)
        away = _length(step[:, None] + shift * y, step * aperture.squeeze + shift * x)
        inside.append(coc.abs() + 0.5 + slack - away)
    share = torch.minimum(*inside).clamp(0.0, 1.0).unsqueeze(-3)
    cut = kernel * share
    light, left = (k.sum((-2, -1), keepdim=True) for k in (kernel, cut))
    return torch.where(left > _LEAST * light, cut * (light / left.clamp_min(1e-30)), kernel)


def _length(y: Tensor, x: Tensor) -> Tensor:
    """Length of a vector, with a gradient at 0."""
    return torch.sqrt(y * y + x * x + 1e-12)


@dataclasses.dataclass(frozen=True)
class CatsEye:
    """How the kernel of a layer changes across a frame.

    Args:
        aperture: Whose vignetting counts.
        coc_px: Of the layer, signed, in its own pixels.
        scale: Every so many pixels of the image are one of the layer's.
        size: Height and width of the image.
    """

    aperture: Aperture
    coc_px: float
    scale: int
    size: tuple[int, int]

    def scattered(self, light: Tensor, kernel: Tensor, half: int) -> Tensor:
        """A layer's light scattered with the kernel of where it lands.

        Args:
            light: ``[B, C, h, w]``; it begins ``half`` pixels before the frame, and one more at coarser resolutions.
            kernel: ``[1 or C, k, k]``, of the middle of the frame.
            half: Pixels on each side that are not in the result ``[B, C, h - 2 half, w - 2 half]``.
        """
        high, wide = BLOCK
        (batch, channels), (rows, columns) = light.shape[:2], (n - 2 * half for n in light.shape[2:])
        light = functional.pad(light, (0, -columns % wide, 0, -rows % high))
        weights = kernel.expand(channels, -1, -1) if len(kernel) > 1 else kernel
        x = self._places(columns, wide, self.size[1], light)
        coc = torch.full_like(x, self.coc_px)
        bands = []
        for band, y in enumerate(self._places(rows, high, self.size[0], light)):
            kernels = passed(weights, self.aperture, coc, y.expand_as(x), x)  # [blocks, 1 or C, k, k]
            window = light[:, :, band * high : (band + 1) * high + 2 * half]
            blocks = window.unfold(-1, wide + 2 * half, wide).permute(0, 3, 1, 2, 4)  # [B, blocks, C, rows, columns]
            kernels = kernels.expand(-1, channels, -1, -1).flatten(0, 1).flip(-2, -1).unsqueeze(1)
            spread = functional.conv2d(blocks.flatten(1, 2), kernels, groups=len(kernels))
            bands.append(spread.unflatten(1, (len(x), channels)).permute(0, 2, 3, 1, 4).flatten(3))
        return torch.cat(bands, 2)[:, :, :rows, :columns].reshape(batch, channels, rows, columns)

    def _places(self, count: int, block: int, size: int, like: Tensor) -> Tensor:
        """Middles of the blocks along an axis, in half diagonals from the middle of the frame."""
        middle = torch.arange(0, count, block, dtype=like.dtype, device=like.device) + block / 2
        before = 1 if self.scale > 1 else 0  # pixels in front of the frame, to interpolate from
        half_diagonal = 0.5 * (self.size[0] ** 2 + self.size[1] ** 2) ** 0.5
        return ((middle - before) * self.scale - size / 2) / half_diagonal
