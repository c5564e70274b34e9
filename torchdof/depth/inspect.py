"""Reports on a depth map and a camera: range of depth, blur radius, holes, and how exact the edges are."""

import dataclasses
import math
from typing import Any

import torch
from torch import Tensor

from ..optics.camera import Camera
from ..render.surfaces.edges import judged
from ..validation import image_and_map

__all__ = ["EDGES", "DepthReport", "coc_colours", "depth_colours", "inspect_depth", "panels", "tint_focus"]

EDGES = ("exact", "ramp", "beside", "unclear")
"""Kinds of pixels at depth edges.

* exact: beside a step; rendering keeps it.
* ramp: on a soft edge; rendering turns it into a step.
* beside: on one surface, with the depth of the other; rendering corrects it.
* unclear: on a ramp that rendering keeps, because the image shows no edge there.
"""
_EXACT, _RAMP, _BESIDE, _UNCLEAR = range(1, 1 + len(EDGES))  # their numbers in :attr:`DepthReport.edges`

_NEAR, _SHARP, _FAR = (1.3, 0.6, 0.0), (0.1, 1.3, 0.3), (0.1, 0.5, 1.3)  # RGB of the tints, linear light
_TINT, _DARK_LIGHT = 0.4, 0.1  # share of the tint in a pixel; its light in dark pixels, as a share of the mean light
_HOLE = (0.6, 0.0, 0.6)  # RGB of pixels without depth
_BOUNDS_PX = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)  # bounds of the histogram in px
_QUANTILES = {"1 %": 0.01, "median": 0.5, "99 %": 0.99}


@dataclasses.dataclass(frozen=True)
class DepthReport:
    """The result of :func:`inspect_depth`.

    Args:
        depth: The map, ``[1, 1, H, W]`` in metres, NaN in holes.
        coc_px: Signed circle of confusion, ``[1, 1, H, W]``, NaN in holes.
        repaired_px: The same after the repair of edges, as it is rendered.
        edges: ``[1, 1, H, W]``, uint8: 0 away from depth edges, else 1 + the index in :data:`EDGES`.
        counts: Number of pixels of each kind in :data:`EDGES`.
    """

    depth: Tensor
    coc_px: Tensor
    repaired_px: Tensor
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
        """Share of the pixels at edges whose depth rendering repairs; 0 if it uses the map unchanged."""
        return (self.counts[1] + self.counts[2]) / max(1, sum(self.counts))

    def histogram(self) -> list[tuple[float, float, float]]:
        """Lower and upper blur radius in pixels (negative: in front of the focus), and the share of the pixels between.

        The bounds are 1, 2, 4, ... 128 px; empty bins at both ends are left out.
        """
        bounds = [-math.inf, *(-x for x in reversed(_BOUNDS_PX)), *_BOUNDS_PX, math.inf]
        coc_px = self.coc_px[~self.coc_px.isnan()]
        counts = torch.bucketize(coc_px, coc_px.new_tensor(bounds[1:-1])).bincount(minlength=len(bounds) - 1).tolist()
        filled = [k for k, count in enumerate(counts) if count] or [len(_BOUNDS_PX)]
        total = max(1, coc_px.numel())
        return [(bounds[k], bounds[k + 1], counts[k] / total) for k in range(filled[0], filled[-1] + 1)]

    def facts(self) -> dict[str, Any]:
        """The numbers of ``str`` as JSON-like data: distances in metres, radii in pixels, shares in [0, 1]."""
        coc_px, finite = self.coc_px[~self.coc_px.isnan()], self.depth[self.depth.isfinite()]
        distances = {}
        if finite.numel():
            sample = finite[:: max(1, finite.numel() // 2**20)].double()
            quantiles = {name: float(sample.quantile(share)) for name, share in _QUANTILES.items()}
            distances = {"nearest": float(finite.min()), **quantiles, "farthest": float(finite.max())}
        return {
            "depth_m": distances,
            "at_infinity_px": int(self.depth.isinf().sum()),
            "holes_px": self.holes,
            "coc_px": [float(coc_px.min()), float(coc_px.max())] if coc_px.numel() else [],
            "in_focus": self.sharp,
            "histogram": [{"from_px": low, "to_px": high, "share": share} for low, high, share in self.histogram()],
            "depth_edges": dict(zip(EDGES, self.counts, strict=True)),
        }

    def __str__(self) -> str:
        facts, total, edge_px = self.facts(), self.depth.numel(), sum(self.counts)
        lines = []
        if facts["depth_m"]:
            lines.append("depth, m      " + "  ".join(f"{name} {z:.4g}" for name, z in facts["depth_m"].items()))
        infinite = _percent(facts["at_infinity_px"], total)
        lines.append(f"at infinity   {infinite}   holes {self.holes} ({_percent(self.holes, total)})")
        if facts["coc_px"]:
            lines.append("blur radius   {:+.1f} to {:+.1f} px, negative is near".format(*facts["coc_px"]))
            lines.append(f"in focus      {100 * self.sharp:.1f} % of the pixels (radius of at most 1 px)")
            longest = max(share for _, _, share in self.histogram())
            for low, high, share in self.histogram():
                bar = "#" * math.ceil(40 * share / longest)
                lines.append(f"{low:+8.0f} to {high:+5.0f} px {100 * share:5.1f} % {bar}".rstrip())
        shares = ", ".join(f"{_percent(n, edge_px)} {name}" for name, n in facts["depth_edges"].items())
        lines.append(f"depth edges   {edge_px} pixels: {shares}")
        if edge_px:
            treatment = "are repaired before rendering" if self.doubtful else "are exact and stay unchanged"
            lines.append(f"              they {treatment} (depth edges auto)")
        return "\n".join(lines)


def inspect_depth(image: Tensor, depth: Tensor, camera: Camera) -> DepthReport:
    """Inspects a depth map: range of depth, circle of confusion for a camera, holes, exactness of edges.

    Args:
        image: ``[1, C, H, W]``, linear light.
        depth: ``[1, 1, H, W]``, metres; NaN, zero and negative ones are holes.
        camera: The camera.

    Returns:
        The report, which can be printed.

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
    is_edge, is_ramp, repaired_px = judged(image, coc_px)
    is_changed = (repaired_px != coc_px) & ~coc_px.isnan()
    kept, changed = torch.where(is_ramp, _UNCLEAR, _EXACT * is_edge), torch.where(is_ramp, _RAMP, _BESIDE)
    kinds = torch.where(is_changed, changed, kept).byte()
    counts = torch.bincount(kinds.flatten(), minlength=len(EDGES) + 1)[1:].tolist()
    return DepthReport(depth, coc_px, repaired_px, kinds, (counts[0], counts[1], counts[2], counts[3]))


def depth_colours(depth: Tensor) -> Tensor:
    """Depth ``[1, 1, H, W]`` as ``[1, 3, H, W]`` in linear light: grey, even in 1 / distance; holes are magenta."""
    is_hole = depth.isnan()
    inverse = torch.where(is_hole, 0.0, 1.0 / depth)
    low, high = inverse[~is_hole].aminmax() if bool((~is_hole).any()) else (inverse.min(), inverse.max())
    grey = ((inverse - low) / (high - low).clamp(min=1e-12)).clamp(0, 1) ** 2.2
    return torch.where(is_hole, depth.new_tensor(_HOLE)[:, None, None], grey)


def coc_colours(coc_px: Tensor) -> Tensor:
    """Signed radii ``[B, 1, H, W]`` in pixels as ``[B, 3, H, W]`` in linear light.

    Orange is in front of the focus, blue behind; the largest radius (at least 1 px) has full colour.
    """
    size = (coc_px / coc_px.abs().max().clamp(min=1.0)).clamp(-1, 1)
    near, far = coc_px.new_tensor([1.0, 0.35, 0.02]), coc_px.new_tensor([0.05, 0.3, 1.0])
    return size.clamp(max=0).neg() * near[:, None, None] + size.clamp(min=0) * far[:, None, None]


def panels(image: Tensor, report: DepthReport) -> dict[str, Tensor]:
    """Pictures of the report of an image ``[1, C, H, W]``: caption -> ``[1, 3, H, W]`` in linear light."""
    is_hole = report.depth.isnan()
    coc_px = torch.where(is_hole, 0.0, torch.cat([report.coc_px, report.repaired_px]))
    blur, repaired = torch.where(is_hole, image.new_tensor(_HOLE)[:, None, None], coc_colours(coc_px)).split(1)
    ends = f"{float(coc_px[0].min()):+.1f} to {float(coc_px[0].max()):+.1f} px"
    colours = image.new_tensor([[0, 0, 0], [0.0, 0.7, 0.1], [1.0, 0.05, 0.0], [1.0, 0.0, 0.8], [0.05, 0.1, 0.5]])
    marks = colours[report.edges[:, 0].long()].permute(0, 3, 1, 2)  # [1, H, W, 3] -> [1, 3, H, W]
    brightness = image.mean(1, keepdim=True) / image.mean().clamp(min=1e-12)
    background = (0.08 * brightness).clamp(0, 0.3).expand(-1, 3, -1, -1)
    return {
        "depth: near is bright, holes magenta": depth_colours(report.depth),
        f"blur radius {ends}: near orange, far blue": blur,
        "depth edges: exact green, ramps red, beside the image's pink, unclear blue": torch.where(
            report.edges > 0, marks, background
        ),
        "the same blur radius as rendered: edges repaired": repaired,
    }


def tint_focus(image: Tensor, coc_px: Tensor, has_alpha: bool = False) -> Tensor:
    """The image in grey, lightly tinted: green in focus (radius of at most 1 px), orange nearer, blue farther.

    The tint changes from green to the other two between 1 and 2 px.

    Args:
        image: ``[B, C, H, W]`` in linear light, C of 1 or 3, one more with alpha (premultiplied).
        coc_px: ``[B, 1, H, W]``, signed radius in pixels.
        has_alpha: Whether the last channel is alpha.

    Returns:
        ``[B, 3, H, W]``, or ``[B, 4, H, W]`` with alpha.

    Raises:
        ValueError: If shapes or types are not as described.

    Example:
        >>> coc_px = torch.tensor([-3.0, 0.2, 5.0])[None, None, None]
        >>> tint_focus(torch.ones(1, 3, 1, 3), coc_px)[0, :, 0].argmax(dim=0)  # red, green and blue are strongest
        tensor([0, 1, 2])
    """
    image_and_map(image, "coc_px", coc_px, "in pixels")
    if image.shape[1] - has_alpha not in (1, 3):
        raise ValueError(f"image must have 1 or 3 channels of colour, got {image.shape[1] - has_alpha}")
    colour, alpha = (image[:, :-1], image[:, -1:]) if has_alpha else (image, image[:, :0])
    near, sharp, far = (image.new_tensor(tint)[:, None, None] for tint in (_NEAR, _SHARP, _FAR))
    tint = torch.lerp(torch.where(coc_px < 0, near, far), sharp, (2.0 - coc_px.abs()).clamp(0.0, 1.0).to(image))
    grey = colour.mean(dim=1, keepdim=True)
    floor = _DARK_LIGHT * grey.mean() * (alpha if has_alpha else 1.0)
    return torch.cat([(1.0 - _TINT) * grey + _TINT * tint * (grey + floor), alpha], dim=1)


def _percent(count: int, total: int) -> str:
    return f"{100 * count / max(1, total):.1f} %"
