"""Blur tables: signed circle of confusion to kernel parameters, as measured from a camera or a lens."""

import hashlib
import itertools
import os
from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..tensors import floating
from ..validation import WHOLE_NUMBERS, number, pixels_wide, real_tensor, show
from . import psf, table_file
from .aperture import Aperture, Number
from .field import Field
from .kernel_bank import FADE_IN, bank_of

__all__ = ["BlurTable"]

UNITS = ("fraction", "mm", "relative")
_MOST_NODES = 4096
_COC_RANGE = (1e-9, 1e6)
_WIDEST = 1e4  # times the circle of confusion; a blur that is not of the focus shows at small ones
_SMALLEST, _LARGEST = 1e-100, 1e100  # of parameters: their sums and products are numbers too
_STEEPEST = 100.0  # m of a tilt, whose light would lie in the tail of the edge
_SEEN_PX = 1.5  # around a spot, in which pixels see some of it
_RIM_POWER = 4.0  # of the radius, with which a rim grows
_TRIED_AT_ONCE = 64
_TRIED_PX = (0.5, 6.0)  # radii of the widest kernel tried


class BlurTable:
    """Kernel parameters at nodes of signed circle of confusion, and the rule between them.

    Between nodes the parameters are linear in the signed coc, on each side of focus by itself; lengths shrink to 0 at a
    coc of 0 unless a node sits there. Beyond the last node of a side the lengths grow with ``|coc|`` and the pure
    numbers stay. A side without nodes mirrors the other. A table of one node is thus a lens whose blur keeps its shape
    and scales with the circle of confusion, as the thin lens has it.

    Args:
        family: A key of :data:`torchdof.optics.psf.FAMILIES`.
        coc: Signed coc of the nodes ``[N]``, strictly increasing, not only 0; in ``unit``.
        params: Parameters of the family by name: ``[N]``, or ``[channels, N]`` for a lens that blurs its colours
            differently (``values`` of ``radial``: one more axis ``P``). Lengths are in ``unit``.
        unit: ``"fraction"`` of the image's width, ``"mm"`` on a sensor of ``sensor_width_mm``, or ``"relative"`` for a
            table of which only the ratio of lengths to coc counts (one node a side).
        sensor_width_mm: Width of the sensor the millimetres were measured on; with ``unit="mm"`` only.
        strength: The fitted strength N at the nodes ``[N]``, kept as measured. It does not enter rendering: kernels
            conserve energy.
        name: Short name.
        provenance: Where the numbers are from (camera, source, date, command): a JSON-like dict.
        residual: Relative residual of the fit at each node ``[N]``.
        aperture: What the lens's opening is where it is not round (:class:`torchdof.optics.aperture.Aperture`): the
            family is multiplied by it, and turned by half in front of the focus plane.
        field: What the lens does across the frame, where that was traced or measured
            (:class:`torchdof.optics.field.Field`): pictures are then made of its spots, and the parameters tell those
            of the middle of the frame. A table with a field has no aperture of its own.

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
        if not isinstance(family, str) or family not in psf.FAMILIES:
            raise ValueError(f"family must be one of {', '.join(psf.FAMILIES)}, got {show(family)}")
        if not isinstance(unit, str) or unit not in UNITS:
            raise ValueError(f"unit must be one of {', '.join(UNITS)}, got {show(unit)}")
        if not isinstance(name, str):
            raise ValueError(f"name must be a text, got {show(name)}")
        if provenance is not None and not isinstance(provenance, Mapping):
            raise ValueError(f"provenance must be a dict, got {show(provenance)}")
        self.family, self.unit, self.name = family, unit, str(name)
        self.coc = _numbers("coc", coc)
        if self.coc.ndim != 1 or not len(self.coc) or bool((self.coc.diff() <= 0).any()) or not self.coc.any():
            raise ValueError(
                f"coc must be strictly increasing signed numbers, one a node and not only 0, got {_short(self.coc)}"
            )
        if len(self.coc) > _MOST_NODES:
            raise ValueError(f"coc must be at most {_MOST_NODES} nodes, got {len(self.coc)}")
        if unit == "relative" and max(int((self.coc > 0).sum()), int((self.coc < 0).sum())) > 1:
            raise ValueError(
                f"unit 'relative' takes one node on each side of focus at most, got {len(self.coc)}; "
                "state the unit as 'fraction' (of the image's width) or 'mm'"
            )
        if (unit == "mm") != (sensor_width_mm is not None):
            raise ValueError(
                f"sensor_width_mm goes with unit 'mm' and only with it, got {show(sensor_width_mm)} with {unit!r}"
            )
        if sensor_width_mm is not None and not isinstance(sensor_width_mm, bool | int | float):
            raise ValueError(f"sensor_width_mm must be a number, got {show(sensor_width_mm)}")
        if sensor_width_mm is not None and not 0 < sensor_width_mm < 1e300:
            raise ValueError(f"sensor_width_mm must be positive, got {show(sensor_width_mm)}")
        self.sensor_width_mm = None if sensor_width_mm is None else float(sensor_width_mm)
        self._params = self._check_params(params)
        self.strength = self._per_node("strength", strength)
        self.residual = self._per_node("residual", residual)
        self.provenance = dict(provenance or {})
        if aperture is not None and not isinstance(aperture, Aperture):
            raise ValueError(f"aperture must be an Aperture or None, got {show(aperture)}")
        self.aperture = aperture
        self.field = self._check_field(field)
        self._fingerprint: str | None = None
        self._sides = {sign: self._side(sign) for sign in (-1, 1)}
        for sign in (-1, 1):
            self._sides[sign] = self._sides[sign] or self._sides[-sign]
        in_focus = [self._side_params(sign, torch.zeros(1, device="cpu")) for sign in (-1, 1)]
        self.is_sharp_in_focus = not any(bool(p[name].any()) for p in in_focus for name in psf.LENGTHS & p.keys())
        self._try_kernels()

    @classmethod
    def disc(cls) -> "BlurTable":
        """A perfect lens with a round aperture: a uniform disc whose radius is the circle of confusion.

        Example:
            >>> BlurTable.disc()
            BlurTable('disc', disc, 1 node)
        """
        return cls("disc", [1.0], {"radius": [1.0]}, name="disc")

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
            blades: How many, from 3.
            rotation_deg: Turns the polygon counter-clockwise, as it shows behind the focus plane; at 0 a corner points
                up. A float, or a tensor ``[]`` that a gradient is taken to.
            curvature: 0 for straight blades to 1 for a circle.
            squeeze: Height of the blur over its width, 2 for a common anamorphic lens; the circle of confusion is the
                height. A float, or a tensor ``[]`` that a gradient is taken to.
            rim: How much brighter the blur is at the circle around the opening than in its middle, as that of an
                over-corrected lens is (spherical aberration); >= -1, and negative where it is darker.
            vignetting: How much of its width a cat's eye in the corner of the frame lacks in height, 0 to 1, or the
                shares of the lens's front and rear rim (:class:`torchdof.optics.aperture.Aperture`).

        Raises:
            ValueError: If a number is out of its range.

        Example:
            >>> BlurTable.polygon(6, rotation_deg=15.0, squeeze=2.0)
            BlurTable('polygon', disc, 1 node, Aperture(6 blades, turned by 15, squeeze 2))
        """
        opening = Aperture(blades, rotation_deg, curvature, squeeze, vignetting=vignetting)
        return cls._of_rim(rim, "polygon").with_aperture(opening)

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
        """A lens with any opening: each point out of focus is drawn as this image, as large as its circle of confusion.

        Args:
            image: Transmission ``[H, W]`` >= 0, linear, of the square around the opening as it shows behind the focus
                plane; the longer side spans the circle of confusion. More than 128 pixels are averaged down.
            rotation_deg: As in :meth:`polygon`.
            squeeze: As in :meth:`polygon`.
            rim: As in :meth:`polygon`.
            vignetting: As in :meth:`polygon`.

        Raises:
            ValueError: If the image is no transmission, or a number is out of its range.

        Example:
            >>> BlurTable.from_aperture(torch.eye(9))
            BlurTable('aperture', disc, 1 node, Aperture(mask 9 x 9))
        """
        opening = Aperture(rotation_deg=rotation_deg, squeeze=squeeze, mask=image, vignetting=vignetting)
        return cls._of_rim(rim, "aperture").with_aperture(opening)

    @classmethod
    def _of_rim(cls, rim: float, name: str) -> "BlurTable":
        """An ideal disc, or one whose edge is brighter than its middle."""
        number("rim", rim)
        if rim == 0.0:
            return cls("disc", [1.0], {"radius": [1.0]}, name=name)
        return cls("softm", [1.0], {"radius": [1.0], "sigma": [0.0], "b": [rim], "m": [_RIM_POWER]}, name=name)

    def with_aperture(self, aperture: Aperture | None) -> "BlurTable":
        """The same lens with another opening; None leaves it round.

        Example:
            >>> BlurTable.gaussian().with_aperture(Aperture(blades=5))
            BlurTable('gaussian', gaussian, 1 node, Aperture(5 blades))
        """
        return self.replace(aperture=aperture)

    def replace(self, **changes: Any) -> "BlurTable":
        """The same table with some arguments of the constructor changed.

        Raises:
            ValueError: If one is not as described there.
            TypeError: If a name is unknown.
        """
        names = ("unit", "sensor_width_mm", "strength", "name", "provenance", "residual", "aperture", "field")
        kept = {"family": self.family, "coc": self.coc, "params": self._params}
        return BlurTable(**{**kept, **{name: getattr(self, name) for name in names}, **changes})

    @property
    def is_round(self) -> bool:
        """Whether the opening is a circle, but for a squeeze: kernels are the same turned by half."""
        return self.aperture is None or self.aperture.is_round

    @property
    def depends_on_place(self) -> bool:
        """Whether kernels are others towards the corners of the frame."""
        return self.field is not None or (self.aperture is not None and self.aperture.depends_on_place)

    @property
    def is_differentiated(self) -> bool:
        """Whether derivatives are taken with respect to the aperture's rotation or squeeze."""
        return self.aperture is not None and self.aperture.is_differentiated

    def fingerprint(self) -> str:
        """Hash of all that kernels depend on: tables with the same numbers share it. Kept once it is made.

        Example:
            >>> BlurTable.disc().fingerprint() == BlurTable.disc().fingerprint() != BlurTable.gaussian().fingerprint()
            True
        """
        if self._fingerprint is None:
            facts: list[Any] = [self.family, self.unit, self.sensor_width_mm, self.px_per_unit(1.0), self.coc.tolist()]
            facts += [(name, value.tolist()) for name, value in self._params.items()]
            facts.append(None if self.aperture is None else self.aperture.to_dict())
            facts.append(None if self.field is None else self.field.fingerprint())
            self._fingerprint = hashlib.sha256(repr(facts).encode()).hexdigest()
        return self._fingerprint

    @property
    def channels(self) -> int:
        """Kernels at a node: 1, or the number of image channels that are blurred differently."""
        return next(iter(self._params.values())).shape[0]

    @property
    def node_params(self) -> dict[str, Tensor]:
        """Parameters at the nodes, ``[channels, N]`` (``values``: ``[channels, N, P]``), in the table's unit."""
        return dict(self._params)

    def params(self, coc_px: Tensor, width: float) -> dict[str, Tensor]:
        """Kernel parameters at a signed coc.

        Args:
            coc_px: Signed coc in pixels, any shape ``[...]``.
            width: Width in pixels of the image the coc is meant for.

        Returns:
            Parameters by name, lengths in pixels: ``[channels, ...]`` (``values``: ``[channels, ..., P]``), float64.
            Continuous in ``coc_px`` and differentiable wherever it lies between nodes.
        """
        pixels_wide(width)
        scale = self.px_per_unit(width)
        signed = real_tensor("coc_px", coc_px, "[...] in pixels").to(torch.float64) / scale
        near, far = (self._side_params(sign, signed.abs()) for sign in (-1, 1))
        mixed = {}
        for name in self._params:
            behind = signed >= 0
            behind = behind.unsqueeze(-1) if name == "values" else behind
            mixed[name] = torch.where(behind, far[name], near[name])
            if name in psf.LENGTHS:
                mixed[name] = mixed[name] * scale
        return mixed

    def kernels(self, coc_px: Tensor, width: float, size: int | None = None, window: int | None = None) -> Tensor:
        """Kernels at a signed coc: what the PSF does to a picture made of pixels (:mod:`torchdof.optics.psf`).

        They are those of the middle of the frame. In front of the focus plane an opening that is not round shows turned
        by half.

        In focus the kernel is a single pixel, for what is in focus is as sharp in the image as it shall be. Where the
        table has a blur of its own there, that fades in with the square of the coc, four times as fast as the light
        does that a disc moves: one that moves half of its light is all there at 0.35 px, one that moves a hundredth at
        0.05 px.

        Args:
            coc_px: Signed coc in pixels ``[n]``.
            width: Width in pixels of the image.
            size: Odd width of the kernels; None takes the smallest that holds them all.
            window: Odd width of the middle part that is wanted, which then holds its share of the light; None is all.

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
        if not self.is_differentiated and self.field is None:
            return self._from_templates(coc_px, width, size, window)
        kernels = psf.pixel_kernels(self.family, params, size, window, self.aperture).transpose(0, 1)
        if not self.is_round:
            behind = (coc_px.detach() >= 0).to(kernels.device)[:, None, None, None]
            kernels = torch.where(behind, kernels, kernels.flip(-2, -1))
        if self.is_sharp_in_focus:
            return kernels
        times = FADE_IN / self.moved_in_focus(width).clamp_min(torch.finfo(torch.float64).tiny)
        fade = (coc_px.to(torch.float64).square()[:, None] * times).clamp(max=1.0)[:, :, None, None]
        centre = torch.zeros_like(kernels)
        centre[..., kernels.shape[-2] // 2, kernels.shape[-1] // 2] = 1.0
        return torch.lerp(centre, kernels, fade)

    def _from_templates(self, coc_px: Tensor, width: float, size: int | None, window: int | None) -> Tensor:
        """Kernels of :meth:`kernels` where no gradient to the aperture is taken."""
        signed = coc_px.to(torch.float64)
        reach = psf.support(self.family, self.params(signed.detach(), width), self.aperture)
        whole = psf.half_width(reach) if size is None and window is not None else psf.width_of(size, reach) // 2
        half = whole if window is None else min(whole, psf.width_of(window, reach) // 2)
        cut = [(whole if size is not None else half) + 1] * len(coc_px) if half < reach else []
        made = bank_of(self).kernels(signed, width, longest=cut)
        if size is not None:  # all light is in the size that was asked for
            made = made / made.sum((-2, -1), keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)
        spare = half - made.shape[-1] // 2
        return functional.pad(made, (spare,) * 4).to(coc_px.device)

    def moved_in_focus(self, width: float) -> Tensor:
        """Share ``[channels]`` of its light that the table's kernel in focus moves to other pixels."""
        params = self.params(torch.zeros((), device="cpu"), width)
        in_focus = psf.pixel_kernels(self.family, params, aperture=self.aperture).detach()
        return 1.0 - in_focus[:, in_focus.shape[-2] // 2, in_focus.shape[-1] // 2]

    def side_nodes(self, sign: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Nodes of one side of focus, that in front of it for a sign of -1, by growing ``|coc|`` from 0.

        Returns:
            Unsigned coc ``[N]`` and parameters ``[channels, N]``, in the table's unit.
        """
        side = self._sides[sign]
        if side is None:
            raise AssertionError("a table has nodes on at least one side")
        return side

    def reach_px(self, coc_px: float, width: float) -> float:
        """Radius in pixels that holds the kernels at ``+-coc_px``."""
        number("coc_px", coc_px, unit="pixels")
        signed = torch.tensor([-abs(coc_px), abs(coc_px)], dtype=torch.float64, device="cpu")
        reach = psf.support(self.family, self.params(signed, width), self.aperture)
        if self.field is None:
            return reach
        per_unit = self.px_per_unit(width)
        return max(reach, float(self.field.reach(signed / per_unit).max()) * per_unit + _SEEN_PX)

    def finest_px(self, coc_px: float, width: float) -> float:
        """Radius in pixels, at most ``|coc_px|``, of the disc about as fine as the finest kernel of a signed coc."""
        if self.field is not None:
            per_unit = self.px_per_unit(width)
            return min(abs(coc_px), self.field.finest(coc_px / per_unit) * per_unit)
        return abs(coc_px) if self.aperture is None else abs(coc_px) * self.aperture.finest

    def blur_texture(self, coc_px: float, width: int, size: int | None = None) -> Tensor:
        """The paper's blur texture: the fitted profile f(r), strength N included, at the pixels' centres.

        Args:
            coc_px: Signed coc in pixels.
            width: Width in pixels of the image.
            size: Odd width of the texture; None takes the smallest that holds the kernel.

        Returns:
            ``[channels, size, size]``, float64; not normalised.

        Reference:
            Sato, Dobashi, Yamamoto, Fig. 3.

        Example:
            >>> texture = BlurTable.load("sato_j15").blur_texture(10.0, width=512)
            >>> round(float(texture.max()), 3)
            0.581
        """
        signed = torch.tensor(number("coc_px", coc_px, unit="pixels"), dtype=torch.float64, device="cpu")
        params = self.params(signed, width)
        size = psf.width_of(size, psf.support(self.family, params, self.aperture))
        axis = torch.arange(size, dtype=torch.float64, device="cpu") - size // 2
        opening = self.aperture or Aperture()
        r = torch.hypot(axis[:, None], axis[None, :] * opening.squeeze)
        texture = psf.profile(self.family, r.flatten(), params).unflatten(-1, (size, size))
        if not opening.is_round:
            pixel = 1.0 / psf.opening_radius(self.family, params)
            shares = opening.shares(size // 2, pixel, pixel * opening.squeeze)
            texture = texture * (shares if signed >= 0 else shares.flip(-2, -1))
        if self.strength is None:
            return texture
        nearest = (self.coc - signed / self.px_per_unit(width)).abs().argmin()
        return texture * self.strength[nearest]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the table as JSON, whole or not at all.

        Raises:
            OSError: If the file cannot be written.
        """
        table_file.write(self.to_dict(), path)

    @classmethod
    def load(cls, source: str | os.PathLike[str]) -> "BlurTable":
        """Read a table from a JSON file, or a shipped one by its name.

        Args:
            source: Path of a file, or the name of a shipped table such as ``"sato_j15"``.

        Raises:
            ValueError: If the content is not a valid table; the message names the file and the field.
            FileNotFoundError: If there is neither such a file nor such a shipped table.

        Example:
            >>> BlurTable.load("sato_j15").family
            'ring'
        """
        path = table_file.find(source)
        try:
            return cls.from_dict(table_file.read(path))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path}: {error}") from error

    def to_dict(self) -> dict[str, Any]:
        """The table as JSON-like data, the inverse of :meth:`from_dict`."""
        one_for_all = self.channels == 1
        fields = {
            "name": self.name,
            "family": self.family,
            "unit": self.unit,
            "sensor_width_mm": self.sensor_width_mm,
            "coc": self.coc.tolist(),
            "params": {k: (v[0] if one_for_all else v).tolist() for k, v in self._params.items()},
            "strength": None if self.strength is None else self.strength.tolist(),
            "residual": None if self.residual is None else self.residual.tolist(),
            "provenance": self.provenance,
            "aperture": None if self.aperture is None else self.aperture.to_dict(),
            "field": None if self.field is None else self.field.to_dict(),
        }
        return table_file.stamped({k: v for k, v in fields.items() if v is not None})

    @classmethod
    def from_dict(cls, data: Any) -> "BlurTable":
        """Build a table from :meth:`to_dict`'s data.

        Raises:
            ValueError: If a field is missing, unknown or of the wrong kind; the message names it.
        """
        fields = table_file.fields_of(data)
        if fields.get("aperture") is not None:
            fields["aperture"] = Aperture.from_dict(fields["aperture"])
        if fields.get("field") is not None:
            fields["field"] = Field.from_dict(fields["field"])
        return cls(**fields)

    def __repr__(self) -> str:
        nodes = f"{len(self.coc)} node{'s' if len(self.coc) > 1 else ''}"
        colours = f", {self.channels} channels" if self.channels > 1 else ""
        opening = "" if self.aperture is None else f", {self.aperture!r}"
        opening += "" if self.field is None else f", {self.field!r}"
        return f"BlurTable({self.name or 'unnamed'!r}, {self.family}, {nodes}{colours}{opening})"

    def px_per_unit(self, width: float) -> float:
        """Pixels of an image of a width in pixels that the table's unit is long; 1 for ``"relative"``.

        Example:
            >>> BlurTable("disc", [0.01], {"radius": [0.01]}, unit="fraction").px_per_unit(1920)
            1920.0
        """
        if self.unit == "relative":
            return 1.0
        return float(width) if self.sensor_width_mm is None else width / self.sensor_width_mm

    def _check_params(self, params: Mapping[str, Any]) -> dict[str, Tensor]:
        """Parameters by name as ``[channels, N]`` (``values``: ``[channels, N, P]``), or a refusal by name."""
        names = psf.FAMILIES[self.family]
        if not isinstance(params, Mapping) or set(params) != set(names):
            got = ", ".join(map(str, params)) if isinstance(params, Mapping) else type(params).__name__
            raise ValueError(f"params of {self.family} must be {', '.join(names)}, got {got}")
        checked = {}
        for name in names:
            value = _numbers(f"params.{name}", params[name])
            value = value.unsqueeze(0) if value.ndim == (2 if name == "values" else 1) else value
            if value.ndim != (3 if name == "values" else 2) or value.shape[1] != len(self.coc) or not value.numel():
                shape = "[N, P] or [channels, N, P]" if name == "values" else "[N] or [channels, N]"
                raise ValueError(
                    f"params.{name} must be {shape} with N = {len(self.coc)} nodes, got {list(value.shape)}"
                )
            low = -1.0 if name == "b" else 0.0
            if bool((value < low).any()):
                raise ValueError(f"params.{name} must be >= {low:g}, got {float(value.min()):g}")
            high = _STEEPEST if name == "m" else _LARGEST
            if bool((value > high).any()):
                raise ValueError(f"params.{name} must be <= {high:g}, got {float(value.max()):g}")
            if name == "values" and (value.shape[-1] < 2 or bool((value.amax(-1) < _SMALLEST).any())):
                raise ValueError("params.values must hold at least two values a node, not all of them 0")
            checked[name] = value
        channels = max(v.shape[0] for v in checked.values())
        for name, value in checked.items():
            if value.shape[0] not in (1, channels):
                raise ValueError(f"params.{name} has {value.shape[0]} channels where other parameters have {channels}")
            checked[name] = value.expand(channels, *value.shape[1:]).contiguous()
        return checked

    def _check_field(self, field: Any) -> Field | None:
        if field is None:
            return None
        if not isinstance(field, Field):
            raise ValueError(f"field must be a Field or None, got {show(field)}")
        if self.aperture is not None:
            raise ValueError(f"a table with a field has its own opening, got {self.aperture!r} too; leave one out")
        if self.unit == "relative":
            raise ValueError("a table with a field must state its unit as 'fraction' (of the image's width) or 'mm'")
        if field.channels != self.channels:
            raise ValueError(f"field must have {self.channels} channels, as params have, got {field.channels}")
        low, high = _COC_RANGE
        for name, ends in (("coc", field.coc[[0, -1]].abs()), ("radius", field.radius[-1:])):
            if not low <= float(ends.min()) <= float(ends.max()) <= high:
                raise ValueError(
                    f"field.{name} must reach somewhere from {low:g} to {high:g} ({self.unit}), "
                    f"got {' and '.join(f'{end:g}' for end in ends.tolist())}"
                )
        for side in (field.coc[field.coc <= 0], field.coc[field.coc >= 0]):
            largest, reach = float(side.abs().max()), float(field.reach(side).max())
            if reach > _WIDEST * largest:
                raise ValueError(
                    "field.box must be lengths in the unit of field.coc, got such as "
                    f"reach to {reach:g} where coc is {largest:g}"
                )
        return field

    def _try_kernels(self) -> None:
        """Refuse parameters whose kernels, at the nodes, between and beyond them, are no numbers or no lens's."""
        low, high = _COC_RANGE
        per_px, widest = self.px_per_unit(1.0), 0.0
        for side in (self.coc[self.coc < 0], self.coc[self.coc > 0]):
            largest = float(side.abs().max()) if len(side) else low
            if not low <= largest <= high:
                raise ValueError(f"coc must reach somewhere from {low:g} to {high:g} ({self.unit}), got {largest:g}")
            reach = psf.support(self.family, self.params(side * per_px, 1.0)) / per_px if len(side) else 0.0
            if reach > _WIDEST * largest:
                raise ValueError(
                    "params must be lengths in the unit of coc, got such as "
                    f"reach to {reach:g} where coc is {largest:g}"
                )
            widest = max(widest, reach)
        if widest == 0.0:
            return
        places = torch.cat([self.coc, (self.coc[1:] + self.coc[:-1]) / 2, 2.0 * self.coc[[0, -1]]])
        tried = self.params(places * per_px, 1.0)
        for pixels, start in itertools.product(_TRIED_PX, range(0, len(places), _TRIED_AT_ONCE)):
            some = {name: value[:, start : start + _TRIED_AT_ONCE] for name, value in tried.items()}
            factor = pixels / widest / per_px
            lengths = {name: value * factor if name in psf.LENGTHS else value for name, value in some.items()}
            if not bool(torch.isfinite(psf.pixel_kernels(self.family, lengths)).all()):
                named = ", ".join(f"{name} up to {float(value.max()):g}" for name, value in self._params.items())
                raise ValueError(f"params of {self.family} make kernels that are no numbers: {named}")

    def _per_node(self, name: str, value: Sequence[float] | Tensor | None) -> Tensor | None:
        if value is None:
            return None
        numbers = _numbers(name, value)
        if numbers.shape != self.coc.shape:
            raise ValueError(f"{name} must hold one number a node ({len(self.coc)}), got shape {list(numbers.shape)}")
        return numbers

    def _side(self, sign: int) -> tuple[Tensor, dict[str, Tensor]] | None:
        """Nodes of one side of focus by growing ``|coc|``, starting at 0."""
        chosen = self.coc * sign >= 0
        if not bool((self.coc * sign > 0).any()):
            return None
        order = torch.argsort(self.coc[chosen].abs())
        distances = self.coc[chosen].abs()[order]
        nodes = {k: v[:, chosen][:, order] for k, v in self._params.items()}
        if distances[0] > 0:
            distances = torch.cat([distances.new_zeros(1), distances])
            for name, value in nodes.items():
                first = torch.zeros_like(value[:, :1]) if name in psf.LENGTHS else value[:, :1]
                nodes[name] = torch.cat([first, value], 1)
        return distances, nodes

    def _side_params(self, sign: int, distance: Tensor) -> dict[str, Tensor]:
        """Parameters at unsigned coc ``[...]``, in the table's unit, on one side of focus: ``[channels, ...]``."""
        distances, nodes = self.side_nodes(sign)
        distances, nodes = distances.to(distance.device), {k: v.to(distance.device) for k, v in nodes.items()}
        upper = torch.searchsorted(distances, distance.detach().contiguous()).clamp(1, len(distances) - 1)
        lower = upper - 1
        fraction = ((distance - distances[lower]) / (distances[upper] - distances[lower])).clamp(max=1.0)
        beyond = (distance / distances[-1]).clamp_min(1.0)
        mixed = {}
        for name, value in nodes.items():
            weight = fraction.unsqueeze(-1) if name == "values" else fraction
            mixed[name] = torch.lerp(value[:, lower], value[:, upper], weight)
            if name in psf.LENGTHS:
                mixed[name] = mixed[name] * beyond
        return mixed


def _numbers(name: str, value: Any) -> Tensor:
    """Finite numbers as a float64 tensor on the CPU, or a refusal by name."""
    if isinstance(value, list | tuple):
        value = [each.detach() if isinstance(each, Tensor) else each for each in value]
    try:
        numbers = torch.as_tensor(value, device="cpu")
        if not (floating(numbers) or numbers.dtype in WHOLE_NUMBERS) or numbers.layout != torch.strided:
            raise TypeError
        if not isinstance(value, Tensor):
            numbers = torch.as_tensor(value, dtype=torch.float64, device="cpu")  # a list would have come as float32
        numbers = numbers.detach().to("cpu", torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise ValueError(f"{name} must be numbers, got {str(value)[:60]}") from None
    if not bool(torch.isfinite(numbers).all()):
        raise ValueError(f"{name} must be finite numbers, got {_short(numbers)}")
    return numbers


def _short(numbers: Tensor) -> str:
    shown = ", ".join(f"{x:g}" for x in numbers.flatten()[:6].tolist())
    return f"[{shown}{', ...' if numbers.numel() > 6 else ''}] of shape {list(numbers.shape)}"
