"""Blur across the field: the spots of a lens off its axis, traced or measured.

The *spot*, the image of a point, has all errors of a lens off its axis: cat's eyes, field curvature, astigmatism, coma
and lateral colour. Because a lens is rotationally symmetric, the spot depends only on the signed circle of confusion
and on the distance from the middle of the frame; it turns with the azimuth, and is symmetric about the line to the
middle. So half of each spot is stored, with ``u`` pointing away from the middle and ``v`` across. The origin is the
place of the point in the sharp image.

A spot is a histogram in the smallest box that contains it. Boxes and histograms are interpolated linearly in the signed
coc and in the distance. Beyond the last coc of a side, boxes grow in proportion to the coc; beyond the last distance
the last spots are used.
"""

import base64
import dataclasses
import functools
import hashlib
import math
import zlib
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..validation import fields, numbers, short, show

__all__ = ["Field", "bracket", "deviations"]

_MAX_CODE = 65535  # integer value of the brightest cell of a spot in a file
_MAX_CELLS = 2**25  # largest number of cells in a file
_LIT_SHARE = 1e-3  # share of the brightest cell; darker cells do not count for the reach of a spot
_MIN_SIDE = 1e-6  # smallest side of a box, relative to the largest; avoids a division by 0


@dataclasses.dataclass(frozen=True, eq=False)
class Field:
    """Spots of a lens over the signed circle of confusion and the distance from the middle of the frame.

    Args:
        coc: Signed coc of the nodes ``[K]``, strictly increasing, from in front of the focus plane to behind it. This
            and all lengths are in the table's unit.
        radius: Distances from the middle of the frame ``[F]``, strictly increasing from 0.
        box: Box of each spot ``[K, F, 3]``: centre in u, half length in u, half width in v.
        light: Light in the cells of the half of each box with ``v >= 0``: ``[channels, K, F, U, V]``, or
            ``[K, F, U, V]`` for all channels. U increases away from the middle of the frame, V away from the symmetry
            line. Each spot is normalised to a sum of 1.

    Raises:
        ValueError: If a field is not as described; the message names it.

    Example:
        >>> light = torch.ones(2, 2, 8, 4)
        >>> Field(torch.tensor([-1.0, 1.0]), torch.tensor([0.0, 20.0]), torch.ones(2, 2, 3), light).channels
        1
    """

    coc: Tensor
    radius: Tensor
    box: Tensor
    light: Tensor

    def __post_init__(self) -> None:
        for name in ("coc", "radius", "box", "light"):
            object.__setattr__(self, name, numbers(f"field.{name}", getattr(self, name)))
        for name in ("coc", "radius"):
            value = getattr(self, name)
            if value.ndim != 1 or len(value) < 2 or bool((value.diff() <= 0).any()):
                raise ValueError(f"field.{name} must be at least two strictly increasing numbers, got {short(value)}")
        if self.radius[0] != 0 or not self.coc[0] < 0 < self.coc[-1]:
            raise ValueError("field.radius must begin at 0, and field.coc reach to both sides of it")
        nodes, sides = (len(self.coc), len(self.radius)), self.box[..., 1:]
        if self.box.shape != (*nodes, 3) or bool((sides < 0).any()) or not bool((sides > 0).any()):
            raise ValueError(f"field.box must be {[*nodes, 3]} with lengths >= 0, got {list(self.box.shape)}")
        light = self.light if self.light.ndim == 5 else self.light.unsqueeze(0)
        if light.ndim != 5 or light.shape[1:3] != nodes or min(light.shape[3:]) < 2 or bool((light < 0).any()):
            expected = f"[channels, {nodes[0]}, {nodes[1]}, U, V]"
            raise ValueError(f"field.light must be {expected} >= 0, got {list(self.light.shape)}")
        total = light.sum((-2, -1), keepdim=True)
        if not bool((total > 0).all()):
            raise ValueError("field.light must hold some light at every node")
        sides = sides.clamp_min(_MIN_SIDE * float(sides.max()))
        object.__setattr__(self, "light", light / total)
        object.__setattr__(self, "box", torch.cat([self.box[..., :1], sides], -1))

    @property
    def channels(self) -> int:
        """Number of spots at a node: 1, or one for each channel of the image."""
        return self.light.shape[0]

    def spots(self, coc: float, radius: Tensor) -> tuple[Tensor, Tensor]:
        """Boxes ``[n, 3]`` and light ``[channels, n, U, V]`` at a signed coc and distances ``[n]``, float64."""
        growth = max(1.0, coc / float(self.coc[-1]), coc / float(self.coc[0]))
        low, weight = bracket(self.radius, radius.to(torch.float64))
        nodes = slice(int(low.min()), int(low.max()) + 2)
        node, blend = bracket(self.coc, torch.tensor(coc, dtype=torch.float64, device="cpu"))
        box = torch.lerp(self.box[node, nodes], self.box[node + 1, nodes], blend) * growth  # [F, 3]
        light = torch.lerp(self.light[:, node, nodes], self.light[:, node + 1, nodes], blend)  # [channels, F, U, V]
        low, weight = low - nodes.start, weight[:, None]
        light = torch.lerp(light[:, low], light[:, low + 1], weight[..., None])
        return torch.lerp(box[low], box[low + 1], weight), light

    def reach(self, coc: Tensor) -> Tensor:
        """Radius around the origin that contains all spots of each signed coc ``[n]``."""
        coc = coc.to(torch.float64)
        growth = torch.maximum(coc / self.coc[-1], coc / self.coc[0]).clamp_min(1.0)
        low, weight = bracket(self.coc, coc)
        return torch.lerp(self._reaches[low], self._reaches[low + 1], weight) * growth

    @functools.cached_property
    def _reaches(self) -> Tensor:
        """Radius around the origin that contains the lit cells of all spots with the coc of each node: ``[K]``."""
        length, width = self.light.shape[-2:]
        edges = torch.linspace(-1.0, 1.0, length + 1, dtype=torch.float64, device="cpu")
        u = edges * self.box[..., 1:2] + self.box[..., :1]
        farthest = torch.maximum(u[..., 1:].abs(), u[..., :-1].abs())
        v = torch.linspace(0.0, 1.0, width + 1, dtype=torch.float64, device="cpu")[1:] * self.box[..., 2:]
        is_lit = self.light > _LIT_SHARE * self.light.amax((-2, -1), keepdim=True)
        return torch.where(is_lit, torch.hypot(farthest[..., None], v[..., None, :]), 0.0).amax((0, 2, 3, 4))

    def finest(self, coc: float) -> float:
        """Radius of the disc with detail about as fine as the spot of a signed coc in the middle of the frame."""
        box, light = self.spots(coc, self.radius[:1])
        return float(2.0 * deviations(box, light).amin())

    def fingerprint(self) -> str:
        """Hash of the numbers."""
        digest = hashlib.sha256()
        for value in (self.coc, self.radius, self.box, self.light):
            digest.update(repr(value.shape).encode() + value.contiguous().numpy().tobytes())
        return digest.hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """The field as JSON-like data, the inverse of :meth:`from_dict`.

        ``light`` holds integers from 0 to 65535 for the brightest cell of each spot: little-endian 16 bit, deflated
        (RFC 1950), base64. ``shape`` is ``[channels, K, F, U, V]``.
        """
        light = self.light / self.light.amax((-2, -1), keepdim=True)
        codes = (light * _MAX_CODE).round().to(torch.int32).numpy().astype("<u2")
        packed = base64.b64encode(zlib.compress(codes.tobytes(), 9)).decode("ascii")
        lists = {name: getattr(self, name).tolist() for name in ("coc", "radius", "box")}
        return {**lists, "shape": list(light.shape), "light": packed}

    @classmethod
    def from_dict(cls, data: Any) -> "Field":
        """Build a field from :meth:`to_dict`'s data; ``ValueError`` names a field that is missing, unknown or wrong."""
        data = fields("field", data, ("coc", "radius", "box", "shape", "light"))
        sizes = numbers("field.shape", data["shape"]).flatten()
        shape = [int(n) for n in sizes.clamp(-1, _MAX_CELLS).tolist()]
        if len(shape) != 5 or min(shape) < 1 or math.prod(shape) > _MAX_CELLS:
            raise ValueError(f"field.shape must be five numbers of cells, got {show(data['shape'])}")
        count = 2 * math.prod(shape)
        try:
            packed = base64.b64decode(data["light"], validate=True)
            cells = zlib.decompressobj().decompress(packed, count + 1)
        except (TypeError, ValueError, zlib.error):
            raise ValueError("field.light must be deflated numbers of 16 bit as base64 text") from None
        if len(cells) != count:
            raise ValueError(f"field.light must hold {count} bytes for field.shape, got {len(cells)}")
        light = np.frombuffer(cells, "<u2").astype(np.float64).reshape(shape)
        return cls(data["coc"], data["radius"], data["box"], torch.from_numpy(light))

    def __repr__(self) -> str:
        return f"Field({len(self.coc)} blurs, {len(self.radius)} distances to {float(self.radius[-1]):g})"


def deviations(box: Tensor, light: Tensor) -> Tensor:
    """Standard deviations ``[n, 2]`` along u and v (about ``v = 0``) of spots, the smallest of the channels.

    Spots have boxes ``[n, 3]`` and light ``[channels, n, U, V]``, each with sum 1.
    """
    length, width = light.shape[-2:]
    u = (torch.arange(length, dtype=torch.float64, device=light.device) + 0.5) * (2.0 / length) - 1.0
    v = (torch.arange(width, dtype=torch.float64, device=light.device) + 0.5) / width
    along, across = light.sum(-1), light.sum(-2)
    mean = (along * u).sum(-1, keepdim=True)
    spread = torch.stack([(along * (u - mean) ** 2).sum(-1), (across * v**2).sum(-1)], -1).amin(0).sqrt()
    return spread * box[:, 1:]


def bracket(nodes: Tensor, positions: Tensor) -> tuple[Tensor, Tensor]:
    """Index of the node before each position, and the weight in [0, 1] of the next node, for linear interpolation."""
    low = (torch.searchsorted(nodes, positions.detach().contiguous(), right=True) - 1).clamp(0, len(nodes) - 2)
    return low, ((positions - nodes[low]) / (nodes[low + 1] - nodes[low])).clamp(0.0, 1.0)
