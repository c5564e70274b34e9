"""Slow and obvious reference implementations: plain loops in float64."""

import functools
from collections.abc import Callable

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from torchdof import BlurTable


def scatter(light: Tensor, kernel_of: Callable[[int, int, int], Tensor]) -> Tensor:
    """Sum of the light `[B, C, H, W]` of every pixel times its own kernel `[1 or C, k, k]`, without light outside."""
    batch, channels, height, width = light.shape
    out = torch.zeros_like(light, dtype=torch.float64)
    for item in range(batch):
        for row in range(height):
            for column in range(width):
                kernel = kernel_of(item, row, column).to(torch.float64)
                half = kernel.shape[-1] // 2
                top, left = max(row - half, 0), max(column - half, 0)
                seen = kernel[:, top - row + half : height - row + half, left - column + half : width - column + half]
                here = out[item, :, top : row + half + 1, left : column + half + 1]
                here += light[item, :, row, column, None, None].to(torch.float64) * seen
    return out


def accumulate(image: Tensor, coc: Tensor, table: BlurTable, normalize: bool = True) -> Tensor:
    """The paper's renderer: the sum of every pixel's billboard, with `normalize` divided by the sum of the weights."""

    @functools.cache
    def kernel_of(item: int, row: int, column: int) -> Tensor:
        return table.kernels(coc[item, :, row, column].double(), image.shape[-1])[0]

    total = scatter(image, kernel_of)
    return total / scatter(torch.ones_like(image), kernel_of) if normalize else total


def interpolated(profile: Callable[[Tensor], Tensor], reach: float, size: int, samples: int = 200) -> Tensor:
    """Kernel `[size, size]` of an isotropic profile with radius `reach` in pixels, finely sampled."""
    places = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples * 2 * reach - reach
    return seen_by_pixels(profile(torch.hypot(places[:, None], places[None, :])), places, size)


def seen_by_pixels(light: Tensor, places: Tensor, size: int) -> Tensor:
    """Kernel `[size, size]` of a PSF's light `[n, n]` at places `[n]` along each axis, by the interpolator of pixels.

    The interpolator is the cubic spline through a single 1 among 0s. The result is limited to twice that of linear
    interpolation, and negative values are raised to 0 with light of the four neighbours, in proportion to their own.
    """
    knots = np.arange(-60, 61)
    cardinal = CubicSpline(knots, (knots == 0).astype(float), bc_type="natural")
    half = size // 2 + 2
    away = torch.arange(-half, half + 1, dtype=torch.float64)[:, None] - places
    spline, hat = torch.from_numpy(cardinal(away.numpy())), (1 - away.abs()).clamp_min(0.0)
    kernel = torch.minimum(spline @ light @ spline.T, 2 * hat @ light @ hat.T).tolist()
    settled = [[max(value, 0.0) for value in row] for row in kernel]
    for row in range(1, 2 * half):
        for column in range(1, 2 * half):
            if not (owed := -kernel[row][column]) > 0:
                continue
            givers = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
            wealth = sum(max(kernel[y][x], 0.0) for y, x in givers)
            for y, x in givers if wealth > 0 else []:
                settled[y][x] -= owed * max(kernel[y][x], 0.0) / wealth
    inner = torch.tensor(settled, dtype=torch.float64).clamp_min(0.0)[2:-2, 2:-2]
    return inner / inner.sum()
