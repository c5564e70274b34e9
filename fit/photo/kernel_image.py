"""A kernel as a picture, for shapes that no round family has: polygons, cat's eyes, coma, scratched or dusty lenses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..problems import FitError
from ..result import Array
from ..solve import one_thread
from ..validation import a_picture
from .deconvolution import estimate
from .diagnostics import signal_pixels
from .pair import prepared_pair
from .radial import solve_round

__all__ = ["KernelImage", "fit_kernel_image"]


@dataclass(frozen=True)
class KernelImage:
    """A fitted kernel image.

    Attributes:
        kernel: `[k, k]`, k odd, not negative, sums to 1; row 0 is the top of the picture. It is the blur of the picture
            it was fitted to: behind the focus as it stands, in front of it point-reflected against a table's.
        gain: exposure ratio of the pictures.
        background: level under the blurred dot.
        residual: norm of (data - model) over norm of the light.
        noise: the same norm expected of the noise.
    """

    kernel: Array
    gain: float
    background: float
    residual: float
    noise: float


def fit_kernel_image(
    sharp: ArrayLike,
    blurred: ArrayLike,
    *,
    magnification: float = 1.0,
    white: float | None = None,
    files: tuple[str | None, str | None] = (None, None),
) -> KernelImage:
    """Estimate the kernel between a sharp and a defocused picture of a dot without assuming a shape.

    Detail finer than the dot cannot be seen: use a dot of a third of the blur's size or less.

    Args:
        sharp: `[H, W]`, linear light, the dot in focus on a dark ground.
        blurred: `[H, W]`, linear light, the same dot out of focus, the whole blur inside the window.
        magnification: expected size of the dot in the blurred picture over its size in the sharp one.
        white: level at and above which a pixel is clipped; None looks for a plateau.
        files: names of the two pictures, for errors and warnings.

    Raises:
        FitError: wrong shapes, or one of its kinds, named after what is wrong with the capture.

    Example:
        >>> import torch
        >>> from torchdof.optics import psf
        >>> sharp = torch.nn.functional.pad(psf.disc(3.0), (20, 20, 20, 20))  # a picture of a dot
        >>> blurred = torch.nn.functional.conv2d(sharp[None, None], psf.disc(6.0)[None, None], padding=6)[0, 0]
        >>> image = fit_kernel_image(sharp.numpy(), blurred.numpy())
        >>> bool(image.kernel.min() >= 0), round(float(image.kernel.sum()), 6)
        (True, 1.0)
    """
    still, data = a_picture("sharp", sharp, 15, files[0]), a_picture("blurred", blurred, 15, files[1])
    if still.shape != data.shape:
        raise FitError(f"sharp and blurred must have the same shape, got {list(still.shape)} and {list(data.shape)}")
    with one_thread():
        pair = prepared_pair(still, data, "auto", magnification, white, files)[0]
        found = estimate(pair, solve_round(pair))
    near = signal_pixels(pair)
    light = float(np.sqrt(np.mean((pair.data[near] - found.background) ** 2)))
    rms = float(np.sqrt(np.mean((pair.values - found.model)[near.ravel()[pair.flat]] ** 2)))
    return KernelImage(found.kernel, found.gain, found.background, rms / light, found.noise / light)
