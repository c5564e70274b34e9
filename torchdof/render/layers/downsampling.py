"""Blur layers at a coarser resolution: average blocks of pixels, convolve with a smaller kernel, interpolate.

A layer at every ``s``-th pixel is averaged over blocks of ``s x s`` pixels, convolved, and interpolated linearly. This
adds ``v = 1/4 - 1/(12 s^2)`` to the variance of its kernel, in squares of its pixels. So a kernel of variance ``V`` is
made smaller, by the factor ``sqrt(1 - k v / V)``.

For a Gaussian ``k`` is 1, because variances add. A disc would become too small: its visible feature is its edge. The
expected squared difference between this chain and the exact kernel, over images whose power falls with the square of
the frequency, as in photographs, is least at ``k = 1/2``, for all radii and resolutions in use.
"""

import math

import torch.nn.functional as functional
from torch import Tensor

from ...optics.kernel_bank import KernelBank

_LEAST = 0.5  # lower limit of the factor, for kernels hardly wider than the averaging itself
_OF_SMOOTH = {"gaussian": 1.0, "ring": 1.0}  # k of families without an edge


def downsampled(values: Tensor, scale: int) -> Tensor:
    """Mean of each ``scale x scale`` values: ``[B, C, H, W] -> [B, C, H / scale, W / scale]``."""
    return values if scale == 1 else functional.avg_pool2d(values, scale)


def upsampled(values: Tensor, scale: int) -> Tensor:
    """Linear interpolation to ``scale`` times the resolution: ``[B, C, H, W] -> [B, C, scale * H, scale * W]``."""
    return functional.interpolate(values, scale_factor=float(scale), mode="bilinear", align_corners=False)


def shrink(bank: KernelBank, coc_px: float, width: float, scale: int) -> float:
    """Factor, 1/2 to 1, for the coc of a kernel that is used at every ``scale``-th pixel, to undo the averaging's blur.

    ``coc_px`` is the signed coc, and ``width`` the width of the image, in pixels of the image.
    """
    if bank.is_even or scale == 1:  # of a lens with a field, the masks are shrunk instead
        return 1.0
    added = _OF_SMOOTH.get(bank.table.family, 0.5) * (1 / 4 - 1 / (12 * scale**2))
    return math.sqrt(max(1.0 - added / bank.variance_px(coc_px, width, scale), _LEAST**2))
