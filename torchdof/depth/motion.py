"""Optical flow from a frame to the previous one, by block matching from coarse to fine."""

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["motion_between", "sample", "shifted"]

_COARSEST_PX = 24  # px; smallest side of the coarsest level; smaller: larger motion is found
_LEVELS = 5  # largest number of levels; more find larger motion
_BLOCK = 7  # px; side of the compared blocks; larger ones are more robust and less detailed
_GAIN = 0.05  # share of the squared difference that a subpixel shift must remove; larger: fewer subpixel shifts
_NOISE = 1e-4  # squared difference of noise, for the same test
_STILL_SHARE = 1e-3  # share of changed pixels below which motion is not searched


def motion_between(current_frame: Tensor, previous_frame: Tensor, is_changed: Tensor) -> Tensor:
    """Optical flow ``[B, 2, H, W]`` (x, y) in pixels from each pixel of a frame to its content in the previous one.

    Frames are ``[B, C, H, W]``. It has subpixel precision, and is computed at half the resolution. It is 0 if less than
    0.1 % of the pixels differ between both frames (``is_changed``).
    """
    batch, _, height, width = current_frame.shape
    if float(is_changed.float().mean()) <= _STILL_SHARE:
        return current_frame.new_zeros(batch, 2, height, width)
    levels = [(_halved(current_frame.mean(1, keepdim=True)), _halved(previous_frame.mean(1, keepdim=True)))]
    while min(levels[-1][0].shape[-2:]) >= 2 * _COARSEST_PX and len(levels) < _LEVELS:
        levels.append((_halved(levels[-1][0]), _halved(levels[-1][1])))
    flow = levels[-1][0].new_zeros(batch, 2, *levels[-1][0].shape[-2:])
    for level, (current, previous) in enumerate(reversed(levels)):
        if level:
            flow = 2.0 * F.interpolate(flow, size=current.shape[-2:], mode="nearest").round()
        flow = _matched(current, previous, flow, reach=2 if level == 0 else 1)
    return 2.0 * F.interpolate(_to_fractions(*levels[0], flow), size=(height, width), mode="nearest")


def sample(maps: Tensor, flow: Tensor, mode: str = "bilinear") -> Tensor:
    """The maps ``[B, C, H, W]`` of the previous frame at ``pixel + flow``, interpolated or of the nearest pixel."""
    size = maps.shape[-2:]
    y, x = torch.meshgrid(*(torch.arange(n, dtype=flow.dtype, device=flow.device) + 0.5 for n in size), indexing="ij")
    grid = torch.stack([(x + flow[:, 0]) * 2 / size[1] - 1, (y + flow[:, 1]) * 2 / size[0] - 1], dim=-1)
    return F.grid_sample(maps, grid, mode=mode, padding_mode="border", align_corners=False)


def shifted(maps: Tensor, flow: Tensor) -> Tensor:
    """The maps ``[B, K, H, W]`` of the previous frame at ``pixel + flow``, rounded to whole pixels."""
    return sample(maps, flow.round(), "nearest")


def _halved(picture: Tensor) -> Tensor:
    return F.avg_pool2d(picture, 2, ceil_mode=True)


def _cost(current: Tensor, previous: Tensor, flow: Tensor) -> Tensor:
    """Mean absolute difference of the blocks around each pixel and around ``pixel + flow``, ``[B, 1, H, W]``."""
    return _block_mean((current - shifted(previous, flow)).abs())


def _block_mean(values: Tensor) -> Tensor:
    return F.avg_pool2d(values, _BLOCK, stride=1, padding=_BLOCK // 2, count_include_pad=False)


def _matched(current: Tensor, previous: Tensor, flow: Tensor, reach: int) -> Tensor:
    """Integer flow of least cost.

    1. Choose among the guess ``flow``, no motion, and the guesses of the four neighbouring blocks.
    2. Search all displacements of up to ``reach`` pixels around the choice.
    """
    guesses = [flow, torch.zeros_like(flow)]
    for dim in (-2, -1):
        guesses += [flow.roll(step, dims=dim) for step in (-_BLOCK, _BLOCK)]
    best_cost, best = _cost(current, previous, guesses[0]), guesses[0]
    for guess in guesses[1:]:
        best_cost, best = _better(best_cost, best, _cost(current, previous, guess), guess)
    start = best
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            if dx or dy:
                step = start + start.new_tensor([dx, dy]).reshape(1, 2, 1, 1)
                best_cost, best = _better(best_cost, best, _cost(current, previous, step), step)
    return best


def _better(best_cost: Tensor, best: Tensor, cost: Tensor, candidate: Tensor) -> tuple[Tensor, Tensor]:
    is_better = cost < best_cost - 1e-4  # nearly equal costs keep the earlier candidate, so flat areas keep the guess
    return torch.where(is_better, cost, best_cost), torch.where(is_better, candidate, best)


def _to_fractions(current: Tensor, previous: Tensor, flow: Tensor) -> Tensor:
    """Flow with subpixel precision, along each axis from the parabola through three squared differences."""
    middle = _block_mean((current - shifted(previous, flow)).square())
    fractions = []
    for step in ((1.0, 0.0), (0.0, 1.0)):
        offset = flow.new_tensor(step).reshape(1, 2, 1, 1)
        before, after = (_block_mean((current - shifted(previous, flow + sign * offset)).square()) for sign in (-1, 1))
        bend = (before + after - 2 * middle).clamp(min=1e-6)
        gain = (before - after).square() / (8 * bend)  # the middle value minus the minimum of the parabola
        fractions.append(
            torch.where(gain > _GAIN * middle.clamp(min=_NOISE), 0.5 * (before - after) / bend, 0.0).clamp(-0.5, 0.5)
        )
    return flow + torch.cat(fractions, dim=1)
