"""Slow and obvious reference implementations: plain loops in float64."""

import functools
import math
from collections.abc import Callable

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from torchdof import BlurTable

IN_FOCUS = 2e-4  # on the blur axis; smaller blurs count as in focus


def scatter(light: Tensor, kernel_of: Callable[[int, int, int], Tensor]) -> Tensor:
    """Sum of every pixel's light times its own kernel; light outside the frame is lost.

    `kernel_of(item, row, column)` is `[1 or C, k, k]`, `light` is `[B, C, H, W]`.
    """
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


def kernel_between(coc: float, nodes: list[float] | None, table: BlurTable, width: int) -> Tensor:
    """Kernel of one pixel: its own (nodes None), or the linear mixture of the two neighbouring layers.

    The nodes are places of layers on the blur axis: `sign (radius^2 / (radius + 1/2) - IN_FOCUS)`.
    """

    def at(signed: float) -> Tensor:
        return table.kernels(torch.tensor([signed], dtype=torch.float64), width)[0]

    def in_pixels(x: float) -> float:
        return 0.0 if x == 0 else math.copysign(((y := abs(x) + IN_FOCUS) + math.sqrt(y * y + 2.0 * y)) / 2.0, x)

    x = math.copysign(max(coc**2 / (abs(coc) + 0.5) - IN_FOCUS, 0.0), coc)
    if nodes is None:
        return at(coc if x else 0.0)
    x = min(max(x, nodes[0]), nodes[-1])
    for low, high in zip(nodes, nodes[1:], strict=False):
        if low <= x <= high:
            share = (x - low) / (high - low)
            return mix(at(in_pixels(low)), at(in_pixels(high)), share)
    return at(in_pixels(x))


def mix(first: Tensor, second: Tensor, share: float) -> Tensor:
    """`(1 - share) first + share second` for kernels of different sizes."""
    size = max(first.shape[-1], second.shape[-1])
    total = torch.zeros(first.shape[0], size, size, dtype=torch.float64)
    for kernel, weight in ((first, 1 - share), (second, share)):
        margin = (size - kernel.shape[-1]) // 2
        total[:, margin : size - margin, margin : size - margin] += weight * kernel
    return total


def accumulate(
    image: Tensor, coc: Tensor, table: BlurTable, nodes: list[float] | None = None, normalize: bool = True
) -> Tensor:
    """The paper's renderer: the sum of every pixel's billboard, with `normalize` divided by the sum of the weights."""

    @functools.cache
    def kernel_of(item: int, row: int, column: int) -> Tensor:
        return kernel_between(float(coc[item, 0, row, column]), nodes, table, image.shape[-1])

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
