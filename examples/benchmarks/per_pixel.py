"""Seconds of `splat`, with and without gradients, beside the layered rendering: three channels, one thread.

python examples/benchmarks/per_pixel.py [--side 256]
"""

import argparse
import functools

import torch

from examples.benchmarks.operations import seconds
from torchdof import blur_by_coc
from torchdof.functional import splat


def gradients(image: torch.Tensor, coc_px: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Gradients to image and radius."""
    return torch.autograd.grad(splat(image, coc_px).sum(), (image, coc_px))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--side", type=int, default=256, help="height and width in pixels")
    side = parser.parse_args().side
    torch.manual_seed(0)
    torch.set_num_threads(1)
    print("radius  splat  step  layered")
    for largest_px in (4.0, 8.0, 16.0):
        image = torch.rand(1, 3, side, side)
        coc_px = largest_px * (2 * torch.rand(1, 1, side, side) - 1)
        leaves = (image.clone().requires_grad_(), coc_px.clone().requires_grad_())
        forward = seconds(functools.partial(splat, image, coc_px))
        step = seconds(functools.partial(gradients, *leaves))
        layered = seconds(functools.partial(blur_by_coc, image, coc_px, occlusion=False))
        print(f"{largest_px:6g} {forward:6.2f} {step:5.2f} {layered:8.2f}")


if __name__ == "__main__":
    main()
