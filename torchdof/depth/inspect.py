"""What a depth map holds and what a camera makes of it: ranges, blur, holes, and how exact its edges are."""

import dataclasses
import math
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..optics.camera import Camera
from ..render.edges import STEP_PX, judged
from ..validation import image_and_map

__all__ = ["EDGES", "DepthReport", "coc_colours", "inspect_depth", "panels", "tint_focus"]

EDGES = ("exact", "ramp", "beside", "unclear")
"""Pixels at depth edges, by what rendering does: beside a step that stays where it is; on a ramp that becomes a step;
of one surface with the depth of the other, which gets its own; on a ramp that stays, for the image shows no edge."""

_NEAR, _SHARP, _FAR = (0.90, 0.35, 0.0), (0.0, 0.62, 0.20), (0.0, 0.30, 0.85)
_FAINT, _CLEAR = 0.2, 0.6  # change of light to the next pixel, of the brighter one: begins to be an outline, and is one
_DARKEST = 0.05  # of the mean light: what is darker has no outlines of its own
_BOUNDS_PX = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)


@dataclasses.dataclass(frozen=True)
class DepthReport:
    """What :func:`inspect_depth` found.

    Args:
        depth: The map, ``[1, 1, H, W]`` in metres, NaN in holes.
        coc_px: Signed circle of confusion, ``[1, 1, H, W]``, NaN in holes.
        edges: ``[1, 1, H, W]``, uint8: 0 where there is no edge of depth, else 1 + the place in :data:`EDGES`.
        counts: How many pixels of each kind of :data:`EDGES` there are.
    """

    depth: Tensor
    coc_px: Tensor
    edges: Tensor
    counts: tuple[int, int, int, int]

    @property
    def holes(self) -> int:
        """Pixels without depth."""
        return int(self.depth.isnan().sum())

    @property
    def sharp(self) -> float:
        """Share of the pixels with depth whose blur radius is at most 1 px."""
        return float((self.coc_px.abs() <= 1.0).sum()) / max(1, self.depth.numel() - self.holes)

    @property
    def doubtful(self) -> float:
        """Share of the pixels at edges whose depth rendering repairs; 0 where it takes the map as it is."""
        return (self.counts[1] + self.counts[2]) / max(1, sum(self.counts))

    def histogram(self) -> list[tuple[float, float, float]]:
        """Lower and upper blur radius in pixels (negative: in front of the focus), and the share of the pixels between.

        The bounds double from 1 px on; bins at both ends that hold nothing are left out.
        """
        bounds = [-math.inf, *(-x for x in reversed(_BOUNDS_PX)), *_BOUNDS_PX, math.inf]
        known = self.coc_px[~self.coc_px.isnan()]
        edges = torch.tensor(bounds[1:-1], dtype=known.dtype, device=known.device)
        counts = torch.bincount(torch.bucketize(known, edges), minlength=len(bounds) - 1).tolist()
        filled = [k for k, count in enumerate(counts) if count] or [len(_BOUNDS_PX)]
        total = max(1, known.numel())
        return [(bounds[k], bounds[k + 1], counts[k] / total) for k in range(filled[0], filled[-1] + 1)]

    def distances(self) -> dict[str, float]:
        """Finite depths in metres: the nearest, those that 1, 50 and 99 % are nearer than, the farthest; or none."""
        finite = self.depth[self.depth.isfinite()]
        if not finite.numel():
            return {}
        spread = torch.quantile(finite.flatten()[:: max(1, finite.numel() // 2**20)].double(), _SHARES).tolist()
        named = dict(zip(_SHARE_NAMES, spread, strict=True))
        return {"nearest": float(finite.min()), **named, "farthest": float(finite.max())}

    def facts(self) -> dict[str, Any]:
        """What ``str`` tells, for programs: JSON-like data, distances in metres, radii in pixels, shares of 1."""
        known = self.coc_px[~self.coc_px.isnan()]
        return {
            "depth_m": self.distances(),
            "at_infinity_px": int(self.depth.isinf().sum()),
            "holes_px": self.holes,
            "coc_px": [float(known.min()), float(known.max())] if known.numel() else [],
            "in_focus": self.sharp,
            "histogram": [{"from_px": low, "to_px": high, "share": share} for low, high, share in self.histogram()],
            "depth_edges": dict(zip(EDGES, self.counts, strict=True)),
        }

    def __str__(self) -> str:
        total = self.depth.numel()
        lines = []
        if distances := self.distances():
            lines.append("depth, m      " + "  ".join(f"{name} {metres:.4g}" for name, metres in distances.items()))
        infinite = int(self.depth.isinf().sum())
        lines.append(f"at infinity   {_percent(infinite, total)}   holes {self.holes} ({_percent(self.holes, total)})")
        known = self.coc_px[~self.coc_px.isnan()]
        if known.numel():
            lines.append(f"blur radius   {float(known.min()):+.1f} to {float(known.max()):+.1f} px, negative is near")
            lines.append(f"in focus      {100 * self.sharp:.1f} % of the pixels (radius of at most 1 px)")
            longest = max(share for _, _, share in self.histogram())
            for low, high, share in self.histogram():
                bar = "#" * math.ceil(40 * share / longest)
                lines.append(f"{low:+8.0f} to {high:+5.0f} px {100 * share:5.1f} % {bar}".rstrip())
        edge_px = sum(self.counts)
        shares = ", ".join(f"{_percent(n, edge_px)} {name}" for n, name in zip(self.counts, EDGES, strict=True))
        lines.append(f"depth edges   {edge_px} pixels: {shares}")
        if edge_px:
            taken = "are repaired before rendering" if self.doubtful else "are exact and stay as they are"
            lines.append(f"              they {taken} (depth edges auto)")
        return "\n".join(lines)


_SHARES = torch.tensor([0.01, 0.5, 0.99], dtype=torch.float64, device="cpu")
_SHARE_NAMES = ("1 %", "median", "99 %")


def inspect_depth(image: Tensor, depth: Tensor, camera: Camera) -> DepthReport:
    """Looks at a depth map: ranges, the circle of confusion that a camera makes of it, holes, exactness of edges.

    Args:
        image: ``[1, C, H, W]``, linear light.
        depth: ``[1, 1, H, W]``, metres; NaN, zero and negative ones are holes.
        camera: The camera.

    Returns:
        The report; ``print`` tells it.

    Raises:
        ValueError: If an argument is not as described.

    Example:
        >>> image, depth = torch.full((1, 3, 16, 24), 0.2), torch.full((1, 1, 16, 24), 4.0)
        >>> image[..., 12:], depth[..., 12:] = 0.6, 2.0
        >>> report = inspect_depth(image, depth, Camera(focus_m=2.0))
        >>> report.counts, report.sharp  # no edge is blurred by a pixel
        ((0, 0, 0, 0), 1.0)
    """
    image_and_map(image, "depth", depth, "in metres")
    if image.shape[0] != 1:
        raise ValueError(f"inspect one image at a time, got a batch of {image.shape[0]}")
    depth = torch.where(depth > 0, depth, torch.nan)
    coc_px = camera.coc_px(depth, depth.shape[-1])
    places, changed = judged(image, -coc_px, STEP_PX)
    is_ramp = places == 2
    kinds = torch.where(changed, torch.where(is_ramp, 2, 3), torch.where(is_ramp, 4, places)).byte()
    counts = torch.bincount(kinds.flatten(), minlength=len(EDGES) + 1)[1:].tolist()
    return DepthReport(depth, coc_px, kinds, (counts[0], counts[1], counts[2], counts[3]))


def coc_colours(coc_px: Tensor) -> Tensor:
    """A signed map in colour: orange in front of the focus, black in focus, blue behind; linear light.

    Args:
        coc_px: ``[1, 1, H, W]``, pixels.

    Returns:
        ``[1, 3, H, W]``; the largest radius, at least 1 px, is full colour.

    Example:
        >>> coc_colours(torch.tensor([[[[-2.0, 0.0, 2.0]]]]))[0, :, 0].argmax(dim=0).tolist()
        [0, 0, 2]
    """
    size = (coc_px / coc_px.abs().max().clamp(min=1.0)).clamp(-1, 1)
    near, far = coc_px.new_tensor([1.0, 0.35, 0.02]), coc_px.new_tensor([0.05, 0.3, 1.0])
    return size.clamp(max=0).neg() * near[:, None, None] + size.clamp(min=0) * far[:, None, None]


def panels(image: Tensor, report: DepthReport) -> dict[str, Tensor]:
    """Pictures of a report, each ``[1, 3, H, W]`` in linear light, by what to write above them.

    Args:
        image: ``[1, C, H, W]``, linear light.
        report: What was found.
    """
    is_hole = report.depth.isnan()
    magenta = report.depth.new_tensor([0.6, 0.0, 0.6])[:, None, None]
    inverse = torch.where(is_hole, 0.0, 1.0 / report.depth)
    low, high = inverse[~is_hole].aminmax() if bool((~is_hole).any()) else (inverse.min(), inverse.max())
    grey = ((inverse - low) / (high - low).clamp(min=1e-12)).clamp(0, 1) ** 2.2
    coc_px = torch.where(is_hole, 0.0, report.coc_px)
    colours = image.new_tensor([[0, 0, 0], [0.0, 0.7, 0.1], [1.0, 0.05, 0.0], [1.0, 0.0, 0.8], [0.05, 0.1, 0.5]])
    marks = colours[report.edges[:, 0].long()].permute(0, 3, 1, 2)  # [1, H, W, 3] -> [1, 3, H, W]
    level = image.mean(1, keepdim=True) / image.mean().clamp(min=1e-12)
    dim = (0.08 * level).clamp(0, 0.3).expand(-1, 3, -1, -1)
    return {
        "depth: near is bright, holes magenta": torch.where(is_hole, magenta, grey),
        f"blur radius {float(coc_px.min()):+.1f} to {float(coc_px.max()):+.1f} px: near orange, far blue": torch.where(
            is_hole, magenta, coc_colours(coc_px)
        ),
        "depth edges: exact green, ramps red, beside the image's pink, unclear blue": torch.where(
            report.edges > 0, marks, dim
        ),
    }


def tint_focus(image: Tensor, coc_px: Tensor, has_alpha: bool = False) -> Tensor:
    """The image with outlines in colour: green in focus (radius of at most 1 px), orange nearer, blue farther.

    Everything else keeps its colours. Outlines are where the image's light changes by more than a third from pixel to
    pixel, and where one of the three zones meets another.

    Args:
        image: ``[B, C, H, W]`` in linear light, C of 1 or 3, one more with alpha (premultiplied).
        coc_px: ``[B, 1, H, W]``, signed radius in pixels.
        has_alpha: Whether the last channel is alpha.

    Returns:
        ``[B, 3, H, W]``, or ``[B, 4, H, W]`` with alpha.

    Raises:
        ValueError: If shapes or types are not as described.

    Example:
        >>> coc_px = torch.tensor([-3.0, -3.0, 0.2, 5.0, 5.0])[None, None, None]
        >>> tinted = tint_focus(torch.ones(1, 3, 1, 5), coc_px)
        >>> tinted[0, :, 0, 1:4].argmax(dim=0)  # red, green and blue are strongest where zones meet
        tensor([0, 1, 2])
        >>> tinted[0, :, 0, 0]
        tensor([1., 1., 1.])
    """
    image_and_map(image, "coc_px", coc_px, "in pixels")
    if image.shape[1] - has_alpha not in (1, 3):
        raise ValueError(f"image must have 1 or 3 channels of colour, got {image.shape[1] - has_alpha}")
    colour, alpha = (image[:, :-1], image[:, -1:]) if has_alpha else (image, image[:, :0])
    tints = torch.tensor([_NEAR, _SHARP, _FAR], dtype=image.dtype, device=image.device)
    zone = (coc_px >= -1.0).long() + (coc_px > 1.0).long()
    tint = tints[zone[:, 0]].permute(0, 3, 1, 2)  # [B, H, W, 3] -> [B, 3, H, W]
    grey = colour.mean(dim=1, keepdim=True)
    brightest, darkest = _largest_around(grey), -_largest_around(-grey)
    zones = zone.to(image.dtype)
    meets_another = _largest_around(zones) + _largest_around(-zones) > 0
    contrast = (brightest - darkest) / brightest.clamp(min=_DARKEST * grey.mean().clamp(min=1e-12))
    outline = torch.where(meets_another, 1.0, ((contrast - _FAINT) / (_CLEAR - _FAINT)).clamp(0.0, 1.0))
    shown = tint / tint.amax(dim=1, keepdim=True) * brightest.clamp(min=grey.mean())
    tinted = torch.lerp(colour.expand_as(shown), shown, outline.expand_as(shown))
    return torch.cat([tinted, alpha], dim=1)


def _largest_around(values: Tensor) -> Tensor:
    """Largest of a pixel and its eight neighbours, ``[B, 1, H, W]``."""
    return functional.max_pool2d(values, 3, stride=1, padding=1)


def _percent(count: int, total: int) -> str:
    return f"{100 * count / max(1, total):.1f} %"
