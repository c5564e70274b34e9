"""Slow and obvious: plain loops in float64 that the tests compare everything else with."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchdof import BlurTable

SHARP_PX = 0.5  # a circle of confusion up to half a pixel leaves the pixel as it is


def scatter(light: Tensor, kernel_of: Callable[[int, int, int], Tensor]) -> Tensor:
    """Every pixel's light times its own kernel, added up; what falls outside the frame is lost.

    `kernel_of(item, row, column)` is `[1 or C, k, k]`, `light` is `[B, C, H, W]`.
    """
    batch, channels, height, width = light.shape
    out = torch.zeros_like(light, dtype=torch.float64)
    for item in range(batch):
        for row in range(height):
            for column in range(width):
                kernel = kernel_of(item, row, column).to(torch.float64)
                half = kernel.shape[-1] // 2
                for dy in range(-half, half + 1):
                    for dx in range(-half, half + 1):
                        y, x = row + dy, column + dx
                        if 0 <= y < height and 0 <= x < width:
                            weight = kernel[:, dy + half, dx + half]
                            out[item, :, y, x] += light[item, :, row, column].to(torch.float64) * weight
    return out


def kernel_between(coc: float, nodes: list[float] | None, table: BlurTable, width: int) -> Tensor:
    """Kernel of one pixel: its own (nodes None), or those of the two layers next to it, mixed linearly.

    The nodes are places of layers on the blur axis: signed, the radius less half a pixel.
    """

    def at(signed: float) -> Tensor:
        return table.kernels(torch.tensor([signed], dtype=torch.float64), width)[0]

    def in_pixels(x: float) -> float:
        return 0.0 if x == 0 else x + math.copysign(SHARP_PX, x)

    if nodes is None:
        return at(coc if abs(coc) > SHARP_PX else 0.0)
    x = math.copysign(max(abs(coc) - SHARP_PX, 0.0), coc)
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
    """The paper's renderer: every pixel's billboard accumulates; divided by the sum of the weights if asked for."""

    def kernel_of(item: int, row: int, column: int) -> Tensor:
        return kernel_between(float(coc[item, 0, row, column]), nodes, table, image.shape[-1])

    total = scatter(image, kernel_of)
    return total / scatter(torch.ones_like(image), kernel_of) if normalize else total


def normalised_convolution(image: Tensor, kernel: Tensor) -> Tensor:
    """Image convolved with one kernel `[1 or C, k, k]`, divided by the part of the kernel inside the frame."""
    return scatter(image, lambda *_: kernel) / scatter(torch.ones_like(image), lambda *_: kernel)


def disc_by_columns(radius: float, size: int) -> Tensor:
    """Disc integrated over the pixels: each pixel cut into columns, the disc's chord clipped to each."""
    columns = 40_000 // size
    half = size // 2
    edge = torch.arange(size + 1, dtype=torch.float64) - half - 0.5
    x = edge[:-1, None] + (torch.arange(columns, dtype=torch.float64) + 0.5) / columns  # [size, columns]
    chord = (radius**2 - x**2).clamp_min(0.0).sqrt()
    kernel = torch.zeros(size, size, dtype=torch.float64)
    for row in range(size):
        top = torch.minimum(torch.maximum(chord, edge[row]), edge[row + 1])
        bottom = torch.minimum(torch.maximum(-chord, edge[row]), edge[row + 1])
        kernel[row] = (top - bottom).mean(1)
    return kernel / kernel.sum()


def supersampled(profile: Callable[[Tensor], Tensor], size: int, samples: int = 64) -> Tensor:
    """Isotropic profile integrated over the pixels by the midpoints of `samples` x `samples` cells a pixel."""
    half = size // 2
    axis = (torch.arange(size * samples, dtype=torch.float64) + 0.5) / samples - half - 0.5
    fine = profile(torch.hypot(axis[:, None], axis[None, :]))
    kernel = fine.reshape(size, samples, size, samples).mean((1, 3))
    return kernel / kernel.sum()
