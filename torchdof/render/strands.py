"""Strands thinner than a pixel: hair, wires, twigs.

Depth, taken at the centres of pixels, shows a dash of them here and there. They are joined along their direction:
pixels between the dashes are split between the strand and what is behind.
"""

import torch
import torch.nn.functional as functional
from torch import Tensor

from .. import pixels
from .matting import ALIKE, EDGE_PX, NEVER_PX, TRUST, Matted, falloff, mean_of, other_light

__all__ = ["strands_joined"]

_REACH = 3  # pixels around one that tell of a strand through it
_WIDTH = 0.2  # variance of a strand's pixels across it, px^2
_NARROW = 0.5  # variance of these across their line up to which it is one strand's, px^2
_LEVEL = 1.0  # px^2 by which what is behind a strand is taken for level rather than inclined
_SEEN = 3.0  # part of 1 / pixels that must show a strand, and what is behind, for these to be sure
_LEAST_COVERED = 0.05  # part of a pixel from which on a strand is told from texture
_MOST_COVERED = 0.6  # part of a pixel that a strand beside its centre covers


def strands_joined(
    light: Tensor, coc_px: Tensor, threshold: Tensor, valid: Tensor | None, surfaces: Matted
) -> tuple[Matted, Tensor]:
    """Gives farther pixels the part of a strand that passes beside their centre.

    A pixel shows a strand where an opening of the depth by 2 x 2 pixels removes it. The strand's coc and light F are
    means of such pixels around, what is behind it, B, is a plane through the light of farther pixels that touch none,
    and the weight of F in a pixel the least-squares solution of ``I = a F + (1 - a) B``. It is believed as far as the
    contrast of the two stands out from the texture behind, the strand's pixels lie on a line and the pixel on it, and
    the pixel is no lamp's; else the surfaces stay.

    Args:
        light: ``[B, C, H, W]``.
        coc_px: ``[B, 1, H, W]``, signed.
        threshold: Light from which on a pixel is a highlight's, ``[B, 1, H, W]``.
        valid: ``[B, 1, H, W]``, 0 where a pixel is to be left out; None counts all.
        surfaces: What :func:`torchdof.render.matting.matte` returns.

    Returns:
        The same, changed at those pixels, where the weight of a strand is in [0, 0.6]; and by how much that of the
        other surface grew, ``[B, 1, H, W]``.
    """
    counted = torch.ones_like(coc_px) if valid is None else valid
    farthest = torch.where(counted > 0, coc_px, -NEVER_PX)
    opened = -functional.max_pool2d(-functional.max_pool2d(farthest, 2, stride=1, padding=1), 2, stride=1)
    thin = counted * ((opened - coc_px) / EDGE_PX - 1.0).clamp(0.0, 1.0)
    clear = counted * (1.0 - functional.max_pool2d(thin, 3, stride=1, padding=1))
    away = torch.where(thin > 0, -coc_px, -NEVER_PX).detach()
    away = functional.max_pool2d(away, 2 * _REACH + 1, stride=1, padding=_REACH)
    crossed = pixels.indices((coc_px.detach() + away > 1.0) & (counted > 0))

    near_by = falloff(light, _REACH)
    steps = range(-_REACH, _REACH + 1)
    y, x = light.new_tensor([[float(dy), float(dx)] for dy in steps for dx in steps]).t()[..., None]

    def look(part: Tensor) -> Tensor:
        # where the strand is, and whether the pixel lies on its line
        window, own_coc = pixels.around(part, coc_px, _REACH), pixels.pick(coc_px, part)[0]
        window_coc, shown = pixels.pick(coc_px, window)[0], pixels.pick(thin, window)[0] * near_by
        amount, nearest = shown.sum(0), window_coc.amin(0)  # from there on, for rounding must not make it nearer still
        coc = nearest + ((window_coc - nearest) * shown).sum(0) / amount.clamp_min(1e-12)
        down, right, yy, xx, xy = _moments(shown, y, x, _WIDTH)
        spread = yy * xx - xy**2
        aside = (right**2 * yy + down**2 * xx - 2.0 * right * down * xy) / spread
        on_line = (2.0 - aside).clamp(0.0, 1.0) * (2.0 - spread / (yy + xx) / _NARROW).clamp(0.0, 1.0)

        # a plane through the light behind it, at this pixel
        window_light, colour = pixels.pick(light, window), pixels.pick(light, part)  # [C, 49, P], [C, P]
        brightest = window_light.detach().abs().amax((0, 1)).clamp_min(torch.finfo(light.dtype).tiny)
        window_light, colour = window_light / brightest, colour / brightest
        farther = (window_coc - coc - 1.0).clamp(0.0, 1.0)
        behind = pixels.pick(clear, window)[0] * farther * near_by
        seen_behind = behind.sum(0)
        mean, _ = mean_of(window_light, behind)
        down, right, yy, xx, xy = _moments(behind, y, x, _LEVEL)
        from_mean, part_of = window_light - mean[:, None], behind / seen_behind.clamp_min(1e-12)
        along_y, along_x = ((from_mean * (part_of * (t - m))).sum(1) for t, m in ((y, down), (x, right)))
        slope_y = (along_y * xx - along_x * xy) / (xx * yy - xy**2)
        slope_x = (along_x * yy - along_y * xy) / (xx * yy - xy**2)
        back = mean - slope_y * down - slope_x * right
        texture = from_mean - slope_y[:, None] * (y - down) - slope_x[:, None] * (x - right)
        texture = ((texture**2).sum(0) * part_of).sum(0)

        # the strand's light, and how much of it is here
        front, _ = mean_of(window_light, shown)
        contrast = front - back
        strength = (contrast**2).sum(0)
        fitted = ((colour - back) * contrast).sum(0) / strength.clamp_min(1e-12)
        weight = fitted.clamp(0.0, _MOST_COVERED)
        trust = strength / (strength + TRUST * texture + ALIKE**2)
        trust = trust * (2.0 - fitted).clamp(0.0, 1.0)  # it covers no more than where depth shows it: else a lamp
        seen = (_SEEN * amount).clamp(max=1.0) * (_SEEN * seen_behind).clamp(max=1.0)
        limit = pixels.pick(threshold, part)[0] / brightest
        lamp = colour.amax(0) / limit.clamp_min(torch.finfo(light.dtype).tiny)
        sureness = trust * seen * on_line * (2.0 - lamp).clamp(0.0, 1.0)
        sureness = sureness * (own_coc - coc - 1.0).clamp(0.0, 1.0) * (weight / _LEAST_COVERED - 1.0).clamp(0.0, 1.0)

        # in doubt the surfaces are what they were
        moved = other_light(light, part, brightest, colour, weight, back, front) * brightest
        _, other, other_coc, other_weight = (pixels.pick(t, part) for t in surfaces)
        mixed = torch.lerp(other_weight[0], weight, sureness)
        moved = torch.lerp(other_weight * other, moved, sureness)
        known = mixed.clamp_min(1e-12)
        own = (colour * brightest - moved) / (1.0 - mixed)
        coc = torch.lerp(other_coc[0], coc, sureness * weight / known)
        return torch.cat([own, torch.where(mixed > 0, moved / known, 0.0), coc[None], mixed[None]])

    found = pixels.by_parts(look, crossed).split([light.shape[1], light.shape[1], 1, 1])
    joined = Matted(*(pixels.put(maps, crossed, values) for maps, values in zip(surfaces, found, strict=True)))
    return joined, (joined.other_weight - surfaces.other_weight).clamp_min(0.0)


def _moments(weight: Tensor, y: Tensor, x: Tensor, more: float) -> tuple[Tensor, ...]:
    """Mean place of weights ``[n, P]`` at places ``[n, 1]``: y, x; and their variances, with some more: yy, xx, xy."""
    part = weight / weight.sum(0).clamp_min(1e-12)
    down, right = (y * part).sum(0), (x * part).sum(0)
    y, x = y - down, x - right
    return down, right, (y**2 * part).sum(0) + more, (x**2 * part).sum(0) + more, (y * x * part).sum(0)
