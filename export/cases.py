"""The cases on which a file is verified: frames, lenses and scenes other than the traced ones."""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from .graph import INPUTS, Portable

__all__ = ["Case", "cases"]


class Case(NamedTuple):
    """The name of a call, and its inputs in the order of the graph."""

    name: str
    tensors: tuple[Tensor, ...]


def cases(portable: Portable, channels: int) -> Iterator[Case]:
    """The calls for which a file of a module must give its result, for images with ``channels`` channels.

    Each frame has a size and a shape of its coc; a file with a fixed size gets scenes of this size. The f-number and
    the depth are those that give this coc.
    """
    reach, names = portable.dof.options.max_coc_px, INPUTS[portable.inputs]
    generator = torch.Generator().manual_seed(4)
    frames = [
        ("one pixel", (1, 1, 1), _ramp(0.3, 0.9)),
        ("one row", (1, 1, 7), _ramp(-1.0, 1.0)),
        ("one column", (2, 9, 1), _ramp(-1.0, 1.0)),
        ("smaller than the kernels", (1, 5, 7), _ramp(-1.0, 1.0)),
        ("odd, three items", (3, 37, 53), _ramp(-0.6, 0.8)),
        ("portrait", (1, 96, 31), _ramp(-1.0, 0.4)),
    ]
    scenes = [
        ("depth edges", (1, 64, 97), _steps),
        ("lamps", (2, 48, 83), _steps),
        ("all in focus", (1, 48, 64), _ramp(0.0, 0.0)),
        ("all behind, out of focus", (1, 48, 64), _ramp(0.9, 0.9)),
        ("all in front, out of focus", (1, 48, 64), _ramp(-0.9, -0.9)),
        ("beyond the largest radius", (1, 40, 44), _ramp(-1.6, 1.6)),
        ("highlight of 6.5e4", (1, 61, 75), _ramp(-0.7, 0.7)),
        ("infinitely far, 1e30 m", (1, 40, 50), _ramp(-0.5, 1.0)),
        ("bad depths", (2, 41, 50), _ramp(-0.8, 0.8)),
    ]
    frames += [*scenes, ("several tiles", (1, 257, 129), _ramp(-0.5, 0.9))]
    if portable.dof.options.depth_edges != "as given":
        frames.append(("soft depth edges", (2, 75, 140), _steps))
    if portable.size is not None:
        frames = [(name, (1, *portable.size), shape) for name, _, shape in scenes]
    for name, (batch, height, width), shape in frames:
        image = torch.rand((batch, channels, height, width), generator=generator, dtype=torch.float32)
        if name.startswith("highlight"):
            image = 0.1 * image
            image[:, :, height // 3, width // 4] = 6.5e4
        coc = reach * shape(batch, height, width)
        if name == "lamps":
            image = 0.1 * image
            image[:, :, 2::11, 3::13] *= 500.0
        if name == "soft depth edges":  # between surfaces that differ in the image
            image = 0.2 * image + 0.6 * (coc < 0) + 0.1
            coc = functional.avg_pool2d(coc, (1, 5), stride=1, padding=(0, 2), count_include_pad=False)
        elif float(coc.min()) < float(coc.max()):
            # Noise on the coc: at the exact mean of two neighbours, rounding would decide which surface a pixel shows.
            # The noise is smaller than the step between surfaces; light would depend steeply on larger noise.
            noise = torch.rand(coc.shape, generator=generator, dtype=coc.dtype)
            coc = coc + coc.clamp(-10.0, 10.0) * 0.03 * noise
        is_near = (coc < 0.2 * reach).float()
        matte = (functional.avg_pool2d(is_near, 3, 1, 1, count_include_pad=False),) * ("matte" in names)
        if "coc_px" in names:
            if name == "bad depths":
                coc[:, :, ::7, 3::11] = math.nan
            yield Case(name, (image, coc, *matte))
            continue
        focus, farthest = torch.linspace(1.2, 3.1, batch, dtype=torch.float32), 1.05 * coc.abs().amax().clamp_min(1.0)
        widest = portable.dof.camera.replace(focus_m=focus, f_number=1.0)
        f_number = widest.coc_px(focus.new_full((batch, 1, 1, 1), math.inf), width).flatten() / farthest
        depth = focus.reshape(-1, 1, 1, 1) / (1.0 - coc / farthest)
        if name.startswith("infinitely far"):
            depth[..., -height // 4 :, :] = math.inf
            depth[..., -height // 4 :, : width // 2] = 1e30
        if name == "bad depths":
            depth[:, :, ::7, 3::11] = math.nan
            depth[:, :, 1::7, 5::11] = 0.0
            depth[:, :, 2::7, 1::11] = -1.0
        yield Case(name, (image, depth, *matte, focus, f_number))


def _ramp(low: float, high: float) -> Callable[[int, int, int], Tensor]:
    def ramp(batch: int, height: int, width: int) -> Tensor:
        line = torch.linspace(low, high, height * width, dtype=torch.float32)
        return line.reshape(1, 1, height, width).repeat(batch, 1, 1, 1)

    return ramp


def _steps(batch: int, height: int, width: int) -> Tensor:
    """A wall behind the focus, in focus on the left, with a post in front of it."""
    coc = torch.linspace(0.0, 1.0, width, dtype=torch.float32).expand(batch, 1, height, width).clone()
    coc[..., width // 3 : width // 2] = -0.7
    return coc
