"""Blur tables: signed circle of confusion to kernel parameters, as measured from a camera or a lens."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..io.atomic import write_text
from ..io.paths import named_file
from ..validation import choice, fields, number, numbers, pixels_wide, real_tensor, short, show
from . import psf
from .aperture import Aperture, Number
from .field import Field, bracket
from .kernel_bank import KernelBank, bank_of

__all__ = ["BlurTable", "shipped"]

_SCHEMA = "torchdof/blur-table"
_VERSIONS = (1, 2, 3)  # that are read, the last is written; 2 added "aperture", 3 added "field"
_FOLDER = Path(__file__).parent / "tables"
_UNITS = ("fraction", "mm", "relative")
_OPTIONAL = ("sensor_width_mm", "strength", "name", "provenance", "residual", "aperture", "field")
_RIM_POWER = 4.0  # exponent m of a bright rim; a larger one makes the rim thinner
_FINEST_SIGMAS = 3.4  # radius of the disc that is as accurate at a coarser resolution as a Gaussian, in its sigmas
_SPOT_EDGE_PX = 1.5  # px around a spot of a field in which pixels receive some of its light

# Allowed values
_MAX_NODES = 4096
_COC_RANGE = (1e-9, 1e6)  # |coc| of the outermost nodes, in the table's unit
_MAX_REACH = 1e4  # largest radius of a kernel over |coc| of its node; allows a blur that remains in focus
_MIN_PARAMETER, _MAX_PARAMETER = 1e-100, 1e100
_MAX_EXPONENT = 100.0  # largest exponent m of "softm"; with a steeper tilt the light would lie in the tail of the edge


class BlurTable:
    """Kernel parameters at nodes of signed circle of confusion, with interpolation between them.

    Each side of focus is interpolated separately:

    * Between nodes, parameters are linear in the signed coc. Lengths go to 0 at a coc of 0 unless there is a node.
    * Beyond the last node, lengths grow in proportion to ``|coc|``; pure numbers keep the value of the last node.
    * A side without nodes uses the nodes of the other side.

    So a table of one node is a thin lens: its blur keeps its shape and scales with the circle of confusion.

    Args:
        family: A key of :data:`torchdof.optics.psf.FAMILIES`.
        coc: Signed coc of the nodes ``[N]``, strictly increasing, not only 0; in ``unit``.
        params: Parameters of the family by name: ``[N]``, or ``[channels, N]`` for a lens that blurs its colours
            differently (``values`` of ``radial``: one more axis ``P``). Lengths are in ``unit``.
        unit: ``"fraction"`` of the image's width, ``"mm"`` on a sensor of ``sensor_width_mm``, or ``"relative"``: only
            the ratio of lengths to coc matters (one node a side).
        sensor_width_mm: Width of the sensor on which the millimetres were measured; with ``unit="mm"`` only.
        strength: The fitted strength N at the nodes ``[N]``, as measured; rendering conserves energy instead.
        name: Short name.
        provenance: Origin of the numbers (camera, source, date, command): a JSON-like dict.
        residual: Relative residual of the fit at each node ``[N]``.
        aperture: Opening that is not round (:class:`torchdof.optics.aperture.Aperture`). The profile is multiplied by
            it, and point-reflected in front of the focus plane. None is a round opening.
        field: Traced or measured blur across the frame (:class:`torchdof.optics.field.Field`). Rendering then uses its
            spots; the parameters describe the middle of the frame. A table with a field takes no aperture.

    Raises:
        ValueError: If a field is not as described; the message names it.

    Reference:
        Sato, Dobashi, Yamamoto, section 2 (the table from f(r), one blur texture a depth).

    Example:
        >>> table = BlurTable("gaussian", coc=[0.01], params={"sigma": [0.005]}, unit="fraction")
        >>> float(table.params(torch.tensor(-8.0), width=1000)["sigma"])
        4.0
    """

    def __init__(
        self,
        family: str,
        coc: Sequence[float] | Tensor,
        params: Mapping[str, Any],
        *,
        unit: str = "relative",
        sensor_width_mm: float | None = None,
        strength: Sequence[float] | Tensor | None = None,
        name: str = "",
        provenance: Mapping[str, Any] | None = None,
        residual: Sequence[float] | Tensor | None = None,
        aperture: Aperture | None = None,
        field: Field | None = None,
    ) -> None:
        choice("family", family, psf.FAMILIES)
        choice("unit", unit, _UNITS)
        kinds: dict[str, tuple[Any, type]] = {"name": (name, str), "provenance": (provenance, Mapping)}
        kinds |= {"aperture": (aperture, Aperture), "field": (field, Field)}
        for what, (value, kind) in kinds.items():
            if value is not None and not isinstance(value, kind):
                raise ValueError(f"{what} must be of type {kind.__name__}, got {show(value)}")
        self.family, self.unit, self.name = family, unit, name or ""
        self.coc = numbers("coc", coc)
        if self.coc.ndim != 1 or not 0 < len(self.coc) <= _MAX_NODES or bool((self.coc.diff() <= 0).any()):
            raise ValueError(f"coc must be 1 to {_MAX_NODES} strictly increasing signed numbers, got {short(self.coc)}")
        if not self.coc.any():
            raise ValueError("coc must have a node that is not 0")
        if unit == "relative" and max(int((self.coc > 0).sum()), int((self.coc < 0).sum())) > 1:
            remedy = f"got {len(self.coc)}; state the unit as 'fraction' (of the image's width) or 'mm'"
            raise ValueError(f"unit 'relative' takes one node on each side of focus at most, {remedy}")
        if (unit == "mm") != (sensor_width_mm is not None):
            raise ValueError(f"sensor_width_mm goes with unit 'mm' only, got {show(sensor_width_mm)} with {unit!r}")
        if sensor_width_mm is not None:
            sensor_width_mm = number("sensor_width_mm", sensor_width_mm, 1e-6, 1e9, "millimetres")
        self.sensor_width_mm = sensor_width_mm
        self._params, self._fingerprint = self._check_params(params), ""
        self._sides = {sign: self._side(sign) for sign in (-1, 1) if bool((self.coc * sign > 0).any())}
        for distances, nodes in self._sides.values():
            self._check_extent("coc", "params", float(distances[-1]), float(psf.reach(family, nodes).max()))
        self._finest = 1.0  # radius of the disc in finest_px over the coc; a number, as traced code reads no tensors
        if family == "gaussian":
            self._finest = _FINEST_SIGMAS * float((self._params["sigma"] / self.coc.abs())[:, self.coc != 0].min())
        in_focus = [nodes[name][:, 0] for _, nodes in self._sides.values() for name in psf.LENGTHS & nodes.keys()]
        self.is_sharp_in_focus = not bool(torch.cat(in_focus).any())
        self.strength, self.residual = self._per_node("strength", strength), self._per_node("residual", residual)
        self.provenance, self.aperture, self.field = dict(provenance or {}), aperture, field
        if field is not None:
            self._check_field(field)

    @classmethod
    def disc(cls) -> "BlurTable":
        """A perfect lens with a round aperture: a uniform disc whose radius is the circle of confusion.

        Example:
            >>> BlurTable.disc()
            BlurTable('disc', disc, 1 node)
        """
        return cls._of_rim(0.0, "disc")

    @classmethod
    def gaussian(cls, sigma_per_coc: float = 0.5) -> "BlurTable":
        """Gaussian blur with ``sigma = sigma_per_coc * |coc|``; 0.5 has the second moment of the disc.

        Example:
            >>> BlurTable.gaussian()
            BlurTable('gaussian', gaussian, 1 node)
        """
        return cls("gaussian", [1.0], {"sigma": [sigma_per_coc]}, name="gaussian")

    @classmethod
    def polygon(
        cls,
        blades: int = 7,
        rotation_deg: Number = 0.0,
        curvature: float = 0.0,
        *,
        squeeze: Number = 1.0,
        rim: float = 0.0,
        vignetting: float | tuple[float, float] = 0.0,
    ) -> "BlurTable":
        """A lens whose aperture blades leave a polygon open, inscribed in the circle of confusion.

        Args:
            blades: Number of blades, from 3.
            rotation_deg: Degrees, as in :class:`torchdof.optics.aperture.Aperture`.
            curvature: 0 for straight blades to 1 for a circle.
            squeeze: Height of the blur over its width, 2 for a common anamorphic lens, as in ``Aperture``.
            rim: Brightness of the edge over that of the middle, minus 1: positive for an over-corrected lens (spherical
                aberration), 0 for an even disc, -1 for a dark edge.
            vignetting: Cat's eyes, 0 (round) to 1 (closed in the corner), as in ``Aperture``.

        Raises:
            ValueError: If a number is out of its range.

        Example:
            >>> BlurTable.polygon(6, rotation_deg=15.0, squeeze=2.0)
            BlurTable('polygon', disc, 1 node, Aperture(6 blades, turned by 15, squeeze 2))
        """
        return cls._of_rim(rim, "polygon", Aperture(blades, rotation_deg, curvature, squeeze, vignetting=vignetting))

    @classmethod
    def from_aperture(
        cls,
        image: Tensor,
        rotation_deg: Number = 0.0,
        *,
        squeeze: Number = 1.0,
        rim: float = 0.0,
        vignetting: float | tuple[float, float] = 0.0,
    ) -> "BlurTable":
        """A lens with any opening: a point out of focus appears as this image, scaled to its circle of confusion.

        Args:
            image: Transmission ``[H, W]`` >= 0, linear, of the square around the opening as it appears behind the focus
                plane; the longer side spans the circle of confusion. More than 128 pixels are averaged down.
            rotation_deg: As in :meth:`polygon`.
            squeeze: As in :meth:`polygon`.
            rim: As in :meth:`polygon`.
            vignetting: As in :meth:`polygon`.

        Raises:
            ValueError: If the image is not a transmission, or a number is out of its range.

        Example:
            >>> BlurTable.from_aperture(torch.eye(9))
            BlurTable('aperture', disc, 1 node, Aperture(mask 9 x 9))
        """
        opening = Aperture(rotation_deg=rotation_deg, squeeze=squeeze, mask=image, vignetting=vignetting)
        return cls._of_rim(rim, "aperture", opening)

    @classmethod
    def _of_rim(cls, rim: float, name: str, aperture: Aperture | None = None) -> "BlurTable":
        """An ideal disc, or one whose edge is brighter than its middle."""
        if number("rim", rim) == 0.0:
            return cls("disc", [1.0], {"radius": [1.0]}, name=name, aperture=aperture)
        params = {"radius": [1.0], "sigma": [0.0], "b": [rim], "m": [_RIM_POWER]}
        return cls("softm", [1.0], params, name=name, aperture=aperture)

    def replace(self, **changes: Any) -> "BlurTable":
        """The same table with some arguments of the constructor changed, such as the opening.

        Raises:
            ValueError: If one is not as described there.
            TypeError: If a name is unknown.

        Example:
            >>> BlurTable.gaussian().replace(aperture=Aperture(blades=5))
            BlurTable('gaussian', gaussian, 1 node, Aperture(5 blades))
        """
        given = {name: getattr(self, name) for name in ("family", "unit", "coc", *_OPTIONAL)}
        return BlurTable(**{**given, "params": self._params, **changes})

    @property
    def is_round(self) -> bool:
        """Whether the opening is a circle, possibly squeezed: kernels then equal their point reflection."""
        return self.aperture is None or self.aperture.is_round

    @property
    def depends_on_place(self) -> bool:
        """Whether kernels change across the frame."""
        return self.field is not None or (self.aperture is not None and self.aperture.depends_on_place)

    @property
    def is_differentiated(self) -> bool:
        """Whether derivatives are taken with respect to the aperture's rotation or squeeze."""
        return self.aperture is not None and self.aperture.is_differentiated

    def fingerprint(self) -> str:
        """Hash of all numbers that kernels depend on; computed once."""
        if not self._fingerprint:
            aperture = None if self.aperture is None else self.aperture.to_dict()
            field = None if self.field is None else self.field.fingerprint()
            params = {name: value.tolist() for name, value in self._params.items()}
            data = (self.family, self.unit, self.sensor_width_mm, self.coc.tolist(), params, aperture, field)
            self._fingerprint = hashlib.sha256(repr(data).encode()).hexdigest()
        return self._fingerprint

    @property
    def channels(self) -> int:
        """Number of kernels at a node: 1, or one for each channel of the image."""
        return next(iter(self._params.values())).shape[0]

    @property
    def node_params(self) -> dict[str, Tensor]:
        """Parameters at the nodes, ``[channels, N]`` (``values``: ``[channels, N, P]``), in the table's unit."""
        return dict(self._params)

    def params(self, coc_px: Tensor, width: float) -> dict[str, Tensor]:
        """Kernel parameters at a signed coc ``[...]`` in pixels of an image ``width`` pixels wide, lengths in pixels.

        By name, ``[channels, ...]`` (``values``: ``[channels, ..., P]``), float64. Continuous in ``coc_px``, and
        differentiable wherever it lies between nodes.
        """
        pixels_wide(width)
        scale = self.px_per_unit(width)
        signed = real_tensor("coc_px", coc_px, "[...] in pixels").to(torch.float64) / scale
        near, far = (self._side_params(sign, signed.abs(), scale) for sign in (-1, 1))
        behind = signed >= 0
        return {k: torch.where(behind[..., None] if k == "values" else behind, far[k], near[k]) for k in self._params}

    def kernels(self, coc_px: Tensor, width: float, size: int | None = None, window: int | None = None) -> Tensor:
        """Kernels of the middle of the frame at a signed coc, for pictures made of pixels (:mod:`torchdof.optics.psf`).

        In front of the focus plane, kernels of an opening that is not round are point-reflected.

        In focus the kernel is a single pixel, because the image is already as sharp there as it should be. A blur of
        the table in focus, which moves a share ``M`` of the light, is faded in with the weight ``min(1, 4 coc^2 / M)``.

        Args:
            coc_px: Signed coc in pixels ``[n]``.
            width: Width in pixels of the image.
            size: Odd width of the kernels; None takes the smallest that holds them all.
            window: Odd width of the middle part to return, which sums to its share of the light; None returns all.

        Returns:
            ``[n, channels, size, size]``, float64, non-negative, each summing to 1. Differentiable in ``coc_px``, and
            in the aperture's rotation and squeeze where these are tensors.

        Example:
            >>> BlurTable.disc().kernels(torch.tensor([-2.0, 0.0, 2.0]), width=100).shape
            torch.Size([3, 1, 5, 5])
        """
        params = self.params(coc_px, width)
        if coc_px.ndim != 1 or not coc_px.numel():
            raise ValueError(f"coc_px must be [n] in pixels, got {list(coc_px.shape)}")
        reach = psf.support(self.family, {name: value.detach() for name, value in params.items()}, self.aperture)
        full_half = psf.half_width(reach) if size is None and window is not None else psf.width_of(size, reach) // 2
        half = full_half if window is None else min(full_half, psf.width_of(window, reach) // 2)
        longest = [(full_half if size is not None else half) + 1] * len(coc_px) if half < reach else []
        central = self if self.field is None else self.replace(field=None)
        bank = KernelBank(central, gradients=True) if self.is_differentiated else bank_of(central)
        kernels = bank.kernels(coc_px.to(torch.float64), width, longest=longest)
        if size is not None:  # kernels that are cut off to a given size sum to 1 as well
            kernels = kernels / kernels.sum((-2, -1), keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)
        padding = half - kernels.shape[-1] // 2
        return functional.pad(kernels, (padding,) * 4).to(coc_px.device)

    def moved_in_focus(self, width: float) -> Tensor:
        """Share ``[channels]`` of the light that the table's kernel in focus moves to other pixels."""
        params = self.params(torch.zeros((), device="cpu"), width)
        in_focus = psf.pixel_kernels(self.family, params, aperture=self.aperture).detach()
        return 1.0 - in_focus[:, in_focus.shape[-2] // 2, in_focus.shape[-1] // 2]

    def side_nodes(self, sign: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Unsigned coc ``[N]``, from 0, and parameters ``[channels, N]`` at the nodes of a side, or else the other."""
        return self._sides.get(sign) or self._sides[-sign]

    def reach_px(self, coc_px: float, width: float) -> float:
        """Radius in pixels that holds the kernels at ``+-coc_px``."""
        number("coc_px", coc_px, unit="pixels")
        signed = torch.tensor([-abs(coc_px), abs(coc_px)], dtype=torch.float64, device="cpu")
        reach = psf.support(self.family, self.params(signed, width), self.aperture)
        if self.field is None:
            return reach
        per_unit = self.px_per_unit(width)
        return max(reach, float(self.field.reach(signed / per_unit).max()) * per_unit + _SPOT_EDGE_PX)

    def finest_px(self, coc_px: float, width: float) -> float:
        """Radius in pixels of the disc with detail about as fine as the kernel's finest."""
        if self.field is not None:
            per_unit = self.px_per_unit(width)
            return min(abs(coc_px), self.field.finest(coc_px / per_unit) * per_unit)
        if self.aperture is None or self.family == "gaussian":
            return abs(coc_px) * self._finest
        return abs(coc_px) * self.aperture.finest

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the table as JSON, whole or not at all; ``OSError`` if the file cannot be written."""
        write_text(path, json.dumps(self.to_dict(), indent=1) + "\n")

    @classmethod
    def load(cls, source: str | os.PathLike[str]) -> "BlurTable":
        """Read a table from a JSON file, or a shipped one by its name, such as ``"sato_j15"``.

        Raises:
            ValueError: If the content is not a valid table; the message names the file and the field.
            FileNotFoundError: If no file and no shipped table has this name.

        Example:
            >>> BlurTable.load("sato_j15").family
            'ring'
        """
        path = named_file(source, _FOLDER, ".json", "blur table")
        try:
            return cls.from_dict(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path}: {error}") from error

    def to_dict(self) -> dict[str, Any]:
        """The table as JSON-like data, the inverse of :meth:`from_dict`."""
        params = {k: (v[0] if self.channels == 1 else v).tolist() for k, v in self._params.items()}
        data: dict[str, Any] = {"schema": _SCHEMA, "version": _VERSIONS[-1], "family": self.family, "unit": self.unit}
        data |= {"coc": self.coc.tolist(), "params": params}
        for name in _OPTIONAL:
            value = getattr(self, name)
            if value is not None:
                is_part = isinstance(value, Aperture | Field)
                data[name] = value.to_dict() if is_part else value.tolist() if isinstance(value, Tensor) else value
        return data

    @classmethod
    def from_dict(cls, data: Any) -> "BlurTable":
        """Build a table from :meth:`to_dict`'s data; ``ValueError`` names a field that is missing, unknown or wrong."""
        schema, version = (data.get(k) if isinstance(data, Mapping) else None for k in ("schema", "version"))
        if not isinstance(schema, str) or schema != _SCHEMA:
            raise ValueError(f"schema must be {_SCHEMA!r}, got {show(schema)}; is this a blur table?")
        if not isinstance(version, int) or version not in _VERSIONS:
            raise ValueError(f"version must be one of {_VERSIONS}, got {show(version)}; update torchdof to read it")
        given = fields("a blur table", data, ("schema", "version", "family", "unit", "coc", "params"), _OPTIONAL)
        del given["schema"], given["version"]
        for name, part in (("aperture", Aperture), ("field", Field)):
            if given.get(name) is not None:
                given[name] = part.from_dict(given[name])
        return cls(**given)

    def __repr__(self) -> str:
        nodes = f"{len(self.coc)} node{'s' if len(self.coc) > 1 else ''}"
        colours = f", {self.channels} channels" if self.channels > 1 else ""
        opening = "" if self.aperture is None else f", {self.aperture!r}"
        opening += "" if self.field is None else f", {self.field!r}"
        return f"BlurTable({self.name or 'unnamed'!r}, {self.family}, {nodes}{colours}{opening})"

    def px_per_unit(self, width: float) -> float:
        """Length of the table's unit in pixels of an image ``width`` pixels wide; 1 for ``"relative"``.

        Example:
            >>> BlurTable("disc", [0.01], {"radius": [0.01]}, unit="fraction").px_per_unit(1920)
            1920.0
        """
        if self.unit == "relative":
            return 1.0
        width = width.detach() if isinstance(width, Tensor) else width
        return float(width) if self.sensor_width_mm is None else width / self.sensor_width_mm

    def _check_params(self, params: Mapping[str, Any]) -> dict[str, Tensor]:
        """Valid parameters as ``[channels, N]`` (``values``: ``[channels, N, P]``), float64."""
        checked = {name: value.detach().cpu() for name, value in psf.checked(self.family, params).items()}
        for name, value in checked.items():
            axes = 3 if name == "values" else 2
            value = value.unsqueeze(0) if value.ndim == axes - 1 else value
            if value.ndim != axes or value.shape[1] != len(self.coc):
                shape = "[N, P] or [channels, N, P]" if name == "values" else "[N] or [channels, N]"
                raise ValueError(f"params.{name} must be {shape} with N = {len(self.coc)}, got {list(value.shape)}")
            high = _MAX_EXPONENT if name == "m" else _MAX_PARAMETER
            if bool((value > high).any()):
                raise ValueError(f"params.{name} must be <= {high:g}, got {float(value.max()):g}")
            if name == "values" and bool((value.amax(-1) < _MIN_PARAMETER).any()):
                raise ValueError("params.values must not all be 0 at a node")
            checked[name] = value
        channels = max(v.shape[0] for v in checked.values())
        return {name: value.expand(channels, *value.shape[1:]).contiguous() for name, value in checked.items()}

    def _check_field(self, field: Field) -> None:
        if self.aperture is not None:
            raise ValueError(f"a table with a field has its own opening, got {self.aperture!r} too; leave one out")
        if self.unit == "relative":
            raise ValueError("a table with a field must state its unit as 'fraction' (of the image's width) or 'mm'")
        if field.channels != self.channels:
            raise ValueError(f"field must have {self.channels} channels, as params have, got {field.channels}")
        self._check_extent("field.radius", "field.box", float(field.radius[-1]))
        for cocs in (field.coc[field.coc <= 0], field.coc[field.coc >= 0]):
            self._check_extent("field.coc", "field.box", float(cocs.abs().max()), float(field.reach(cocs).max()))

    def _check_extent(self, ends: str, lengths: str, end: float, reach: float = 0.0) -> None:
        """Refuse a side of focus that ends at an absurd coc, or a blur there that reaches absurdly far."""
        low, high = _COC_RANGE
        if not low <= end <= high:
            raise ValueError(f"{ends} must reach somewhere from {low:g} to {high:g} ({self.unit}), got {end:g}")
        if reach > _MAX_REACH * end:
            got = f"a blur that reaches to {reach:g} where coc is {end:g}"
            raise ValueError(f"{lengths} must be lengths in the unit of {ends}, got {got}")

    def _per_node(self, name: str, value: Sequence[float] | Tensor | None) -> Tensor | None:
        if value is None:
            return None
        values = numbers(name, value)
        if values.shape != self.coc.shape:
            raise ValueError(f"{name} must hold one number a node ({len(self.coc)}), got shape {list(values.shape)}")
        return values

    def _side(self, sign: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Nodes of one side of focus, ordered by ``|coc|``, with a node at 0."""
        order = self.coc.abs().argsort()
        order = order[self.coc[order] * sign >= 0]
        distances, nodes = self.coc[order].abs(), {k: v[:, order] for k, v in self._params.items()}
        if distances[0] > 0:
            distances = torch.cat([distances.new_zeros(1), distances])
            for name, value in nodes.items():
                first = torch.zeros_like(value[:, :1]) if name in psf.LENGTHS else value[:, :1]
                nodes[name] = torch.cat([first, value], 1)
        return distances, nodes

    def _side_params(self, sign: int, distance: Tensor, scale: float) -> dict[str, Tensor]:
        """Parameters at unsigned coc ``[...]`` on one side of focus, lengths times ``scale``: ``[channels, ...]``."""
        distances, nodes = self.side_nodes(sign)
        distances, nodes = distances.to(distance.device), {k: v.to(distance.device) for k, v in nodes.items()}
        lower, fraction = bracket(distances, distance)
        growth = (distance / distances[-1]).clamp_min(1.0)
        interpolated = {}
        for name, value in nodes.items():
            weight = fraction.unsqueeze(-1) if name == "values" else fraction
            interpolated[name] = torch.lerp(value[:, lower], value[:, lower + 1], weight)
            if name in psf.LENGTHS:
                interpolated[name] = interpolated[name] * growth * scale
        return interpolated


def shipped() -> list[str]:
    """Names of the tables that come with torchdof, sorted."""
    return sorted(path.stem for path in _FOLDER.glob("*.json"))
