"""The opening of a lens that is not round: blades, an image of it, an anamorphic squeeze. Exact areas, differentiable.

A lens draws a point out of focus as an image of its opening, scaled by the circle of confusion. The coordinates ``u``
of the opening have the axes of the picture, x to the right and y down, and the opening's circumscribed circle has
radius 1. The light of a point at ``p`` that passes through ``u`` lands at ``p + coc u``. So behind the focus plane the
opening appears as a viewer behind the camera sees it; in front of it, where the coc is negative, it is point-reflected.

The area of a polygon in each square of a grid is exact: by Green's theorem, each edge adds the area between itself and
the left side of the square. A curved blade is approximated by 48 chords, scaled to enclose the arc's own area.
"""

import dataclasses
import functools
import math
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..tensors import is_differentiated
from ..validation import broadcast_shapes, fields, numbers, real_tensor, show, whole

__all__ = ["Aperture", "overlaps"]

Number = float | Tensor

_CHORDS = 48  # straight pieces of a curved blade; more follow the arc more closely
_MAX_BLADES = 64
_MAX_SIDE_PX = 128  # pixels; a larger image of an opening is averaged down to this
_SQUEEZE = (0.1, 10.0)  # allowed range of height over width


@dataclasses.dataclass(frozen=True, eq=False)
class Aperture:
    """The open part of a round lens, and the ratio of height to width of its blur.

    Args:
        blades: Number of blades, from 3, whose opening is a regular polygon; 0 leaves the lens round.
        rotation_deg: Turns the opening counter-clockwise, as it appears behind the focus plane. At 0 a corner of a
            polygon points up. A float, or a tensor ``[]``, which may require a gradient.
        curvature: 0 for straight blades, 1 for blades that leave a circle, in between for arcs.
        squeeze: Height of the blur over its width: 2 for an anamorphic lens of that squeeze. The circle of confusion
            is the blur's height. A float, or a tensor ``[]``, which may require a gradient.
        mask: Transmission ``[H, W]`` >= 0 of the square around the opening, instead of blades; the longer side of the
            image spans the square. Images of more than 128 pixels are averaged down. Rotation is bilinear.
        vignetting: Cat's eyes, from 0 (round everywhere) to 1 (closed in the corner of the frame). A cat's eye in the
            corner is shorter than wide by this share of its width, half of it by a rim in front of the opening and half
            by one behind it. A pair ``(front, rear)`` gives each rim its own share.

    Raises:
        ValueError: If a number is out of its range, or the mask is dark or has blades as well.

    Example:
        >>> opening = Aperture(blades=6)
        >>> unit = torch.tensor(0.1, dtype=torch.float64)
        >>> round(float(opening.shares(10, unit, unit).sum()) * 0.1**2, 9) == round(3 * math.sin(math.pi / 3), 9)
        True
    """

    blades: int = 0
    rotation_deg: Number = 0.0
    curvature: float = 0.0
    squeeze: Number = 1.0
    mask: Tensor | None = None
    vignetting: float | tuple[float, float] = 0.0

    def __post_init__(self) -> None:
        if self.blades != 0 or isinstance(self.blades, bool):
            whole("blades", self.blades, 3, _MAX_BLADES)
        pair = self.vignetting if isinstance(self.vignetting, tuple | list) else (self.vignetting,) * 2
        if len(pair) != 2:
            raise ValueError(f"vignetting must be a number or (front, rear), got {show(self.vignetting)}")
        if isinstance(self.vignetting, list):
            object.__setattr__(self, "vignetting", tuple(pair))
        _check("rotation_deg", self.rotation_deg, -1e6, 1e6)
        _check("squeeze", self.squeeze, *_SQUEEZE)
        for name, value in (("curvature", self.curvature), *(("vignetting", share) for share in pair)):
            _check(name, value, 0.0, 1.0, tensors=False)
        if self.mask is not None:
            if self.blades != 0:
                raise ValueError(f"an opening has blades or a mask, got {self.blades} blades and a mask")
            object.__setattr__(self, "mask", _checked_mask(self.mask))
        elif self.blades == 0 and self.curvature != 0.0:
            raise ValueError(f"curvature is that of blades; give their number too, got {self.curvature:g}")

    @property
    def depends_on_place(self) -> bool:
        """Whether kernels differ across the frame."""
        return max(self.rims) > 0.0

    @property
    def rims(self) -> tuple[float, float]:
        """Shift of the front and of the rear rim in the corner of the frame, in diameters of the opening."""
        shares = self.vignetting
        return shares if isinstance(shares, tuple) else (shares / 2, shares / 2)

    @property
    def is_round(self) -> bool:
        """Whether the opening is a circle in the middle of the frame, possibly squeezed."""
        return self.blades == 0 and self.mask is None

    @property
    def is_differentiated(self) -> bool:
        """Whether derivatives are taken with respect to the rotation or to the squeeze."""
        return any(isinstance(v, Tensor) and is_differentiated(v) for v in (self.rotation_deg, self.squeeze))

    @property
    def widest(self) -> float:
        """Largest half axis of the blur over the circle of confusion."""
        return max(1.0, 1.0 / _as_float(self.squeeze))

    @functools.cached_property
    def finest(self) -> float:
        """Radius, as a share of the circle of confusion, of the disc with detail about as fine as the blur: at most 1.

        For a mask by the ratio of area to outline; for a cat's eye its height over its width halfway to the corner.
        """
        finest = min(1.0, 1.0 / _as_float(self.squeeze)) * (1.0 - min(1.0, sum(self.rims)) / 2)
        if self.mask is None:
            return finest
        padded = functional.pad(self.mask, (1, 1, 1, 1))
        outline = (padded.diff(dim=0)[:, 1:].square() + padded.diff(dim=1)[1:].square()).sqrt().sum()
        pixel = 2.0 / max(self.mask.shape)
        return finest * min(1.0, 4.0 * float(self.mask.sum() / outline) * pixel)

    def shares(self, half: int, step_y: Tensor, step_x: Tensor) -> Tensor:
        """Open share of each cell of a grid, without the squeeze: ``[..., 2 half + 1, 2 half + 1]``, float64.

        The middle cell is centred on the opening, whose circumscribed circle has radius 1; ``step_y`` and ``step_x``
        ``[...]`` are the height and width of the cells.
        """
        batch = broadcast_shapes(step_y.shape, step_x.shape)
        heights, widths = (step.to(torch.float64).expand(batch).reshape(-1) for step in (step_y, step_x))
        count = 2 * half + 1
        if self.mask is not None:
            rows, columns = (
                _pixels_in_cells(count, step, size, max(self.mask.shape))
                for step, size in zip((heights, widths), self.mask.shape, strict=True)
            )
            open_areas = rows @ self._turned(self.mask).to(heights.device) @ columns.transpose(-2, -1)
            return (open_areas / (heights * widths)[:, None, None]).reshape(*batch, count, count)
        x, y = self._outline(heights.device)
        centre = half + 0.5
        shares = _polygon_shares(x / widths[:, None] + centre, y / heights[:, None] + centre, count)
        return shares.reshape(*batch, count, count)

    def to_dict(self) -> dict[str, Any]:
        """The aperture as JSON-like data, the inverse of :meth:`from_dict`."""
        shape = {"blades": self.blades, "curvature": float(self.curvature)}
        return {
            **(shape if self.mask is None else {"mask": self.mask.tolist()}),
            "rotation_deg": _as_float(self.rotation_deg),
            "squeeze": _as_float(self.squeeze),
            "vignetting": list(self.rims),
        }

    @classmethod
    def from_dict(cls, data: Any) -> "Aperture":
        """Build an aperture from :meth:`to_dict`'s data; ``ValueError`` names a field that is unknown or wrong."""
        given = fields("aperture", data, (), [field.name for field in dataclasses.fields(cls)])
        if given.get("mask") is not None:
            given["mask"] = numbers("mask", given["mask"])
        return cls(**given)

    def __repr__(self) -> str:
        parts = [] if self.mask is None else ["mask " + " x ".join(map(str, self.mask.shape))]
        numbers = (
            ("{:g} blades", self.blades, 0),
            ("curvature {:g}", self.curvature, 0.0),
            ("turned by {:g}", _as_float(self.rotation_deg), 0.0),
            ("squeeze {:g}", _as_float(self.squeeze), 1.0),
            ("vignetting {:g}", sum(self.rims), 0.0),
        )
        parts += [text.format(value) for text, value, default in numbers if value != default]
        return f"Aperture({', '.join(parts) or 'round'})"

    def _outline(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Corners ``[V]`` of the outline, x and y with y down, counter-clockwise as seen with y up."""
        half_angle = math.pi / self.blades
        along, outward = _blade(half_angle, self.curvature)  # the blade whose outward normal points up
        normal = torch.arange(self.blades, dtype=torch.float64, device=device)[:, None] * (2.0 * half_angle)
        rotation = torch.deg2rad(torch.as_tensor(self.rotation_deg, dtype=torch.float64, device=device))
        normal = normal + half_angle + math.pi / 2 + rotation
        along, outward = along.to(device), outward.to(device)
        x = outward * torch.cos(normal) - along * torch.sin(normal)
        y = outward * torch.sin(normal) + along * torch.cos(normal)
        return x.flatten(), -y.flatten()

    def _turned(self, mask: Tensor) -> Tensor:
        """A mask turned by ``rotation_deg``."""
        rotation = self.rotation_deg
        if not isinstance(rotation, Tensor) and rotation == 0.0:
            return mask
        angle = torch.deg2rad(torch.as_tensor(rotation, dtype=torch.float64, device=mask.device))
        cosine, sine, zero = torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)
        height, width = mask.shape
        rows = torch.stack([cosine, -sine * height / width, zero, sine * width / height, cosine, zero])
        grid = functional.affine_grid(rows.reshape(1, 2, 3), [1, 1, height, width], align_corners=False)
        return functional.grid_sample(mask[None, None], grid, align_corners=False)[0, 0]


def _blade(half_angle: float, curvature: float) -> tuple[Tensor, Tensor]:
    """Corners of one blade without the last: distances along the blade and out from the centre, each ``[chords]``."""
    chord, apothem = math.sin(half_angle), math.cos(half_angle)
    sagitta = curvature * (1.0 - apothem)
    if sagitta < 1e-9:
        along, outward = torch.tensor([[-chord], [apothem]], dtype=torch.float64, device="cpu")
        return along, outward
    radius = (chord**2 + sagitta**2) / (2.0 * sagitta)
    half_arc = math.asin(min(1.0, chord / radius)) if sagitta <= radius else math.pi - math.asin(chord / radius)
    angle = torch.linspace(-half_arc, half_arc, _CHORDS + 1, dtype=torch.float64, device="cpu")[:-1]
    bulge = 2.0 * radius * torch.sin((half_arc + angle) / 2) * torch.sin((half_arc - angle) / 2)
    missing_share = 1.0 / _CHORDS**2  # share of the arc's area outside its chords; the limit of a flat arc
    if half_arc > 5e-3:
        step = 2.0 * half_arc / _CHORDS
        missing_share = _CHORDS * (step - math.sin(step)) / (2.0 * half_arc - math.sin(2.0 * half_arc))
    return radius * torch.sin(angle), apothem + bulge / (1.0 - missing_share)


def _polygon_shares(x: Tensor, y: Tensor, count: int) -> Tensor:
    """Area of polygons with corners ``[m, V]`` in unit squares: ``[m, count, count]``, the first square at (0, 0).

    Each edge is cut at the rows of squares. The area left of each vertical grid line is a sum over these pieces,
    signed by their direction.
    """
    items, next_x, next_y = len(x), x.roll(-1, -1), y.roll(-1, -1)
    row = torch.arange(count, dtype=torch.float64, device=x.device)[:, None]
    start, end = ((corner[:, None, :] - row).clamp(0.0, 1.0) for corner in (y, next_y))  # [m, rows, V]
    item, line, edge = (start.detach() != end.detach()).nonzero().unbind(1)
    start, end = start[item, line, edge], end[item, line, edge]
    x, y, next_x, next_y = (corner[item, edge] for corner in (x, y, next_x, next_y))
    slope = (next_x - x) / (next_y - y)
    ends = torch.stack([x + slope * (height + line - y) for height in (start, end)])
    left, right = ends.amin(0)[:, None], ends.amax(0)[:, None]
    grid_line = torch.arange(count + 1, dtype=torch.float64, device=x.device)
    # mean of min(x, border) over the piece
    clipped = torch.minimum(torch.maximum(grid_line, left), right) - left
    mean = torch.minimum(grid_line, left) + clipped - clipped.square() / (2.0 * (right - left) + 1e-12)
    areas = mean.new_zeros(items * count, count + 1)
    areas = areas.index_add(0, item * count + line, (start - end)[:, None] * mean)
    return areas.diff(dim=-1).clamp_min(0.0).unflatten(0, (-1, count))


def overlaps(low: Tensor, high: Tensor, edges: Tensor) -> Tensor:
    """Overlap ``[m, n, c]`` of intervals from ``low`` to ``high``, ``[m, n]``, with the cells between edges."""
    low, edges = low[..., None], edges[..., None, :]
    return (torch.minimum(high[..., None], edges[..., 1:]) - torch.maximum(low, edges[..., :-1])).clamp_min(0.0)


def _pixels_in_cells(count: int, step: Tensor, size: int, longer: int) -> Tensor:
    """Overlap of ``count`` cells of width ``step`` ``[m]`` with each pixel of a mask: ``[m, count, size]``."""
    cell = (torch.arange(count + 1, dtype=torch.float64, device=step.device) - count / 2) * step[:, None]
    pixel = (torch.arange(size + 1, dtype=torch.float64, device=step.device) - size / 2) * (2.0 / longer)
    return overlaps(cell[:, :-1], cell[:, 1:], pixel)


def _checked_mask(mask: Any) -> Tensor:
    """A valid mask as float64 on the CPU, averaged down to at most ``_MAX_SIDE_PX`` pixels, with a maximum of 1."""
    values = real_tensor("mask", mask, "[H, W]").detach().to("cpu", torch.float64)
    if values.ndim != 2 or not values.numel():
        raise ValueError(f"mask must be the transmission [H, W] of an opening, got {list(values.shape)}")
    if not bool(torch.isfinite(values).all()) or bool((values < 0).any()) or not bool((values > 0).any()):
        raise ValueError("mask must hold finite transmissions >= 0, not all of them 0")
    longer = max(values.shape)
    if longer > _MAX_SIDE_PX:
        height, width = (max(1, round(n * _MAX_SIDE_PX / longer)) for n in values.shape)
        values = functional.adaptive_avg_pool2d(values[None, None], (height, width))[0, 0]
    return values / values.max()


def _check(name: str, value: Any, low: float, high: float, tensors: bool = True) -> None:
    """Refuse a value that is neither a number nor, with ``tensors``, a tensor ``[]``, or is outside ``[low, high]``."""
    is_tensor = tensors and isinstance(value, Tensor) and value.ndim == 0 and value.is_floating_point()
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (is_tensor or is_number) or not low <= value <= high:
        raise ValueError(f"{name} must be a number from {low:g} to {high:g}, got {show(value)}")


def _as_float(value: Number) -> float:
    return float(value.detach()) if isinstance(value, Tensor) else float(value)
