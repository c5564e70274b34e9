"""Point spread functions (PSFs), and kernels: the effect of a PSF on pixels. Differentiable in the parameters.

A pixel is an integral already: ``J = box * scene`` at the pixel's centre. The pixel of the blurred picture is
``(psf * J)(j) = (psf * box * scene)(j)``. So a kernel must not integrate the PSF over the pixel's box once more, which
adds a variance of 1/12 px^2 along each axis and leaves a PSF smaller than a pixel without effect. Instead it must
estimate J between the samples. The kernel of least error over pictures of a power spectrum ``P(f)`` has the spectrum
``sum_i P(f + i) psf^(f + i) / sum_i P(f + i)``, that is ``K[m] = integral psf(x) phi(m - x) dx``, with the interpolator
``phi^(f) = P(f) / sum_i P(f + i)``. For photographs, ``P ~ |box^|^2 / f^2``, the separable cardinal cubic spline is as
good a phi. It changes no second moment. Where its lobes make a pixel negative, the four neighbours give up light to
raise it to 0. Kernels of discs are then within 0.3 dB of the non-negative kernel of least error.

The integral is a sum over square cells: 16 from the centre to the end of a small PSF, cells of a pixel in a large one.
Every family is a profile ``f(r)`` over the distance ``r`` from the centre. Its integral over a cell is exact for
``gaussian`` and ``disc``; for the others, circles cut the cell into slices of exact area, with the mean of f over r.

An aperture (:mod:`torchdof.optics.aperture`) multiplies the profile, and cuts off the part outside of the opening. The
light of a ``disc`` in a cell is the area of the opening in it; for the other families it is the mean of the profile in
the cell times the open area, in parts of the cell in small kernels. A squeeze makes the cells narrower than high.

Reference:
    Field, "Relations between the statistics of natural images and the response properties of cortical cells", Journal
    of the Optical Society of America A 4(12), 1987 (the spectrum).

All arithmetic is in float64 on the CPU's or the parameter's device; parameters are in pixels.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor

from ..validation import broadcast_shapes, choice, numbers, real_tensor, short, show
from .aperture import Aperture
from .kernel_cache import kept

__all__ = ["FAMILIES", "LENGTHS", "checked", "pixel_kernels", "profile", "reach", "sampled", "support", "template"]

FAMILIES: dict[str, tuple[str, ...]] = {
    "gaussian": ("sigma",),
    "ring": ("sigma", "r_c"),
    "disc": ("radius",),
    "softm": ("radius", "sigma", "b", "m"),
    "radial": ("values", "radius"),
}
"""Names of the parameters of each family; lengths are in pixels, >= 0.

* gaussian: standard deviation ``sigma`` along each axis.
* ring: the paper's eq. (1) without N, ``exp(-(r - r_c)^2 / (2 sigma^2))``, a Gaussian in r whose peak lies at ``r_c``.
* disc: uniform up to ``radius``, the image of a point through a perfect lens with a round aperture.
* softm: ``erfc((r - R) / (sqrt(2) sigma)) / 2 * (1 + b (r / R)^m)`` with ``R = radius``: a disc with a soft edge and a
  tilt ``b`` >= -1 with exponent ``m`` > 0. ``b > 0`` has the bright rim of an over-corrected lens.
* radial: ``values`` ``[..., P]`` >= 0 at ``r = radius * i / (P - 1)``, linear in between, 0 beyond ``radius``.
"""

LENGTHS = frozenset({"sigma", "r_c", "radius"})
"""Parameters that are lengths; the others are pure numbers."""

# Multiples of lengths that add up to the end of a profile, and of the opening around it; the others end at radius.
_ENDS = {"gaussian": {"sigma": 5.0}, "ring": {"r_c": 1.0, "sigma": 5.0}, "softm": {"radius": 1.0, "sigma": 4.5}}
_OPENINGS = {"gaussian": {"sigma": 2.0}, "ring": {"r_c": 1.0, "sigma": 2.0}}

# Accuracy; larger: more exact, slower
_CELLS = 16  # least cells from the centre to the end of a PSF; larger PSFs have cells of a pixel
_CELL_PARTS = 3  # parts of a cell along each axis where an opening cuts the profile
_FINE_CELLS = 64  # cells from the centre to the end of a PSF; larger ones are sliced and split less finely

_MIN_LENGTH_PX = 1e-7  # px; a length below it is rendered as this, which is a kernel of one pixel to 1e-14
_TILT_EXPONENT = 460.0  # largest logarithm of (r / R)^m, e^460 = 1e200; a larger power would overflow
_MAX_WIDTH_PX = 2**16 + 1  # px; a kernel of this width takes 34 GB
_RIPPLING = 1.0 / 16.0  # px: the interpolator of smaller cells has no ripple
_MARGIN_PX = 2  # px around a kernel that its values depend on (the four neighbours in _non_negative, and theirs)
_SLICES_AT_ONCE = 2**20  # slices computed together; limits memory

Number = float | Tensor


def pixel_kernels(
    family: str, params: Mapping[str, Number], size: int | None = None, aperture: Aperture | None = None
) -> Tensor:
    """Kernel of a family by name: the effect of its PSF on pixels.

    Args:
        family: A key of :data:`FAMILIES`.
        params: Its parameters by name, numbers or tensors ``[...]`` (``values``: ``[..., P]``), which broadcast against
            each other; lengths in pixels.
        size: Odd width of the kernel, at which the PSF is cut off; None takes the smallest that holds the largest PSF.
        aperture: The opening that the profile is multiplied by; None is a round one.

    Returns:
        ``[..., size, size]``, float64, non-negative, each kernel summing to 1, for a point behind the focus plane.

    Raises:
        ValueError: If the family, a parameter or the size is not as described.

    Reference:
        Sato, Dobashi, Yamamoto, eq. (1): the family "ring".

    Example:
        >>> pixel_kernels("disc", {"radius": 0.5}).shape
        torch.Size([3, 3])
    """
    valid = checked(family, params)
    widest, squeeze = (1.0, 1.0) if aperture is None else (aperture.widest, aperture.squeeze)
    half = width_of(size, widest * float(reach(family, valid, aperture).detach().max())) // 2
    lengths = _rendered(valid)
    end = reach(family, lengths, aperture)
    height = (end / _CELLS).clamp(max=1.0 / widest)  # sides of a cell, at most a pixel
    in_cells = {k: v / height if k in LENGTHS else v for k, v in lengths.items()}
    farthest = min(float((end / height).detach().max()), (half + _MARGIN_PX) * widest * max(1.0, float(squeeze)))
    cells = _sharpened(_cells(family, in_cells, max(_CELLS, math.ceil(farthest - 1e-9)) + 1, aperture))
    width = height if aperture is None else height / squeeze
    kernel = sampled(cells, height, width, half, are_pixels=bool(((height == 1.0) & (width == 1.0)).all()))
    centre = torch.zeros_like(kernel)
    centre[..., half, half] = 1.0
    total = kernel.sum((-2, -1), keepdim=True)
    # no light at all: the PSF underflows in float64, or lies beyond size
    return torch.where(total > 0, kernel / torch.where(total > 0, total, 1.0), centre)


def template(family: str, params: Mapping[str, Tensor], cells: int, aperture: Aperture | None = None) -> Tensor:
    """Light ``[C, 2 cells + 3, 2 cells + 3]`` in the cells of a PSF whose radius is ``cells`` cells, up to a factor.

    :func:`sampled` makes kernels of it. Parameters ``[C]`` (``values``: ``[C, P]``) are checked, and in any unit.
    """
    lengths = _rendered(params)
    cell = reach(family, lengths, aperture) / cells
    in_cells = {k: v / cell if k in LENGTHS else v for k, v in lengths.items()}
    return _sharpened(_cells(family, in_cells, cells + 1, aperture))


def sampled(cells: Tensor, height: Tensor, width: Tensor, half: int, are_pixels: bool = False) -> Tensor:
    """Kernels ``[..., 2 half + 1, 2 half + 1]``, up to a factor, from the light in cells ``[..., n, n]``.

    ``height`` and ``width`` are those of a cell in pixels, ``[...]``. With ``are_pixels`` all of them are 1, so that
    nothing is interpolated.
    """
    wide = half + _MARGIN_PX
    if are_pixels:
        light = functional.pad(cells, (wide - cells.shape[-1] // 2,) * 4)
    else:
        light = _interpolated(cells, height, width, wide)
    kernels = _non_negative(light)
    return kernels[..., _MARGIN_PX:-_MARGIN_PX, _MARGIN_PX:-_MARGIN_PX]


def profile(family: str, r: Tensor, params: Mapping[str, Number]) -> Tensor:
    """The profile ``f(r)`` itself, ``[..., n]``, not normalised and not integrated: eq. (1) without N for ``ring``.

    ``r`` ``[n]`` are distances from the centre, in the unit of the lengths among the parameters ``[...]``.
    """
    valid = {k: v if k == "values" else v.unsqueeze(-1) for k, v in checked(family, params).items()}
    r = real_tensor("r", r, "[n]").to(torch.float64)
    if family == "gaussian":
        return torch.exp(-0.5 * (r / valid["sigma"]) ** 2)
    if family == "ring":
        return torch.exp(-0.5 * ((r - valid["r_c"]) / valid["sigma"]) ** 2)
    if family == "disc":
        return (r <= valid["radius"]).to(torch.float64)
    if family == "softm":
        edge = 0.5 * torch.erfc((r - valid["radius"]) / (math.sqrt(2) * valid["sigma"].clamp_min(1e-12)))
        return edge * _tilt_factor(r, valid)
    values, radius = valid["values"], valid["radius"]
    position = (r / radius).clamp(max=1.0) * (values.shape[-1] - 1)
    low = position.floor().long().clamp(max=values.shape[-1] - 2)
    batch = broadcast_shapes(values.shape[:-1], low.shape[:-1])
    values, low = values.expand(*batch, -1), low.expand(*batch, -1)
    interpolated = torch.lerp(values.gather(-1, low), values.gather(-1, low + 1), position - low)
    return torch.where(r <= radius, interpolated, 0.0)


def support(family: str, params: Mapping[str, Number], aperture: Aperture | None = None) -> float:
    """Radius in pixels beyond which a kernel holds less than 4e-6 of its light (for the largest parameters given)."""
    farthest = float(reach(family, checked(family, params), aperture).detach().max())
    return farthest if aperture is None else farthest * aperture.widest


def width_of(size: int | None, reach_px: float) -> int:
    """Width in pixels of kernels: ``size`` if given, else the smallest that holds a PSF of radius ``reach_px``."""
    size = 2 * half_width(reach_px) + 1 if size is None else size
    if isinstance(size, bool) or not isinstance(size, int) or not 1 <= size <= _MAX_WIDTH_PX or size % 2 == 0:
        raise ValueError(f"size must be a positive odd number of pixels, got {show(size)} (at most {_MAX_WIDTH_PX})")
    return size


def half_width(reach: float) -> int:
    """Pixels on each side of the centre to which a PSF of radius ``reach`` moves light."""
    return max(0, math.ceil(min(reach, 1e18) - 1e-9))


def checked(family: str, params: Mapping[str, Any]) -> dict[str, Tensor]:
    """Valid parameters of a family as float64 tensors on one device."""
    choice("family", family, FAMILIES)
    if not isinstance(params, Mapping) or set(params) != set(FAMILIES[family]):
        got = ", ".join(map(str, params)) if isinstance(params, Mapping) else show(params)
        raise ValueError(f"{family} takes the parameters {', '.join(FAMILIES[family])}, got {got}")
    device = next((p.device for p in params.values() if isinstance(p, Tensor)), torch.device("cpu"))
    valid = {}
    for name in FAMILIES[family]:
        value = params[name]
        value = real_tensor(name, value, "[...]", whole=True) if isinstance(value, Tensor) else numbers(name, value)
        low = -1.0 if name == "b" else 0.0
        if not value.numel() or not bool((torch.isfinite(value.detach()) & (value.detach() >= low)).all()):
            raise ValueError(f"{name} of {family} must be finite and >= {low:g}, got {short(value)}")
        valid[name] = value.to(device, torch.float64)
    if family == "radial" and (valid["values"].ndim < 1 or valid["values"].shape[-1] < 2):
        raise ValueError(f"values must be [..., P] with P >= 2, got {list(valid['values'].shape)}")
    shapes = {k: list(v.shape[:-1] if k == "values" else v.shape) for k, v in valid.items()}
    try:
        broadcast_shapes(*shapes.values())
    except RuntimeError:
        raise ValueError(f"parameters of {family} must broadcast against each other, got shapes {shapes}") from None
    return valid


def _rendered(params: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Parameters whose lengths are above 0, so that nothing divides by 0."""
    return {k: v.clamp_min(_MIN_LENGTH_PX) if k in ("sigma", "radius") else v for k, v in params.items()}


def reach(family: str, params: Mapping[str, Tensor], aperture: Aperture | None = None) -> Tensor:
    """Radius at which a profile, or the opening that cuts it, ends, in the unit of its lengths, without squeeze.

    ``[...]``; beyond the end of a profile is less than 4e-6 of its light.
    """
    ends = _ENDS if aperture is None or aperture.is_round else _OPENINGS
    first, *others = (factor * params[name] for name, factor in ends.get(family, {"radius": 1.0}).items())
    return sum(others, first)


def _tilt_factor(r: Tensor, params: Mapping[str, Tensor]) -> Tensor:
    """Factor ``1 + b (r / R)^m`` of ``softm``, >= 0; the power is limited to 1e200."""
    farthest = torch.exp(_TILT_EXPONENT / params["m"].detach().clamp_min(1.0))
    return (1.0 + params["b"] * torch.minimum(r / params["radius"], farthest) ** params["m"]).clamp_min(0.0)


def _cells(family: str, lengths: Mapping[str, Tensor], half: int, aperture: Aperture | None = None) -> Tensor:
    """Integral of a PSF over the cells around its centre, lengths in cells: ``[..., 2 half + 1, 2 half + 1]``.

    It is right up to a factor if there is an opening.
    """
    slices = 16 if half - 1 <= _FINE_CELLS else 8
    if aperture is None or aperture.is_round:
        return _round_cells(family, lengths, half, slices)
    radius = reach(family, lengths, aperture)
    if family == "disc":
        return aperture.shares(half, 1.0 / radius, 1.0 / radius)
    parts = _CELL_PARTS if half <= _FINE_CELLS else 1
    fine_half = parts * half + parts // 2
    fine_lengths = {k: v * parts if k in LENGTHS else v for k, v in lengths.items()}
    light = _round_cells(family, fine_lengths, fine_half, slices // parts)
    covered = _round_cells("disc", {"radius": reach(family, fine_lengths)}, fine_half, slices)
    share = aperture.shares(fine_half, 1.0 / (parts * radius), 1.0 / (parts * radius))
    means = torch.where(covered > 0, light / torch.where(covered > 0, covered, 1.0), 0.0) * share
    return means.unflatten(-1, (-1, parts)).unflatten(-3, (-1, parts)).mean((-3, -1))


def _round_cells(family: str, lengths: Mapping[str, Tensor], half: int, slices: int) -> Tensor:
    """Integral of a profile over each cell, lengths in cells: ``[..., 2 half + 1, 2 half + 1]``."""
    if family == "gaussian":
        line = _gaussian_line(lengths["sigma"], half)
        quadrant = line.unsqueeze(-1) * line.unsqueeze(-2)
    elif family == "disc":
        quadrant = _disc_quadrant(lengths["radius"], half)
    else:
        quadrant = _sliced_quadrant(family, lengths, half, slices)
    cells = torch.cat([quadrant[..., 1:, :].flip(-2), quadrant], -2)
    return torch.cat([cells[..., 1:].flip(-1), cells], -1)


def _sharpened(cells: Tensor) -> Tensor:
    """Cells without the blur of integrating over a cell: a variance 1/12 smaller along each axis."""
    for axis in (-2, -1):
        padded = functional.pad(cells, (0, 0, 1, 1) if axis == -2 else (1, 1))
        size = cells.shape[axis]
        cells = (26.0 * cells - padded.narrow(axis, 0, size) - padded.narrow(axis, 2, size)) / 24.0
    return cells


def _interpolated(cells: Tensor, height: Tensor, width: Tensor, half: int) -> Tensor:
    """Integrals of a PSF with the interpolator of each pixel: ``[..., 2 half + 1, 2 half + 1]``.

    A pixel is limited to twice the result of linear interpolation. This removes the ripples of the cubic interpolator
    where the PSF has no light. Cells larger than a pixel are interpolated linearly. Arguments as in :func:`sampled`.
    """
    n = cells.shape[-1] // 2
    pixel = torch.arange(-half, half + 1, dtype=torch.float64, device=cells.device)[:, None]
    cell_index = torch.arange(-n, n + 1, dtype=torch.float64, device=cells.device)
    splines, lines = [], []
    for size in (height,) if width is height else (height, width):
        cell = size[..., None, None]
        distance = (pixel - cell * cell_index).abs()  # [..., pixels, cells]
        linear = (1.0 - distance / cell.clamp_min(1.0)).clamp_min(0.0)
        lines.append(linear)
        splines.append(torch.where(cell > 1.0, linear, _cardinal_spline(distance) / _ripple(pixel, cell)))
    limit = 2.0 * (lines[0] @ cells @ lines[-1].transpose(-2, -1)).clamp_min(0.0)
    return torch.minimum(splines[0] @ cells @ splines[-1].transpose(-2, -1), limit)


def _ripple(pixel: Tensor, cell: Tensor) -> Tensor:
    """Sum of the interpolator of each pixel ``[pixels, 1]`` over cells of a size ``[..., 1, 1]``, times the size.

    Cells sample the interpolator, so by Poisson summation the sum is 1 plus its spectrum at one cycle per cell.
    """
    cycles = 1.0 / cell.clamp(_RIPPLING, 1.0)  # cycles per pixel
    power = torch.sinc(cycles) ** 4
    spectrum = 3.0 * power / (2.0 + torch.cos(2.0 * math.pi * cycles))
    return 1.0 + 2.0 * spectrum * torch.cos(2.0 * math.pi * cycles * pixel)


def _cardinal_spline(t: Tensor) -> Tensor:
    """The cubic spline that is 1 at 0 and 0 at every other integer, at distances ``t >= 0``.

    Its second derivatives at the integers are ``6 - 6 sqrt(3)`` at 0 and fall from 1 on as powers of ``sqrt(3) - 2``.

    Reference:
        Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal Processing Magazine 16(6), 1999.
    """
    knot = t.detach().floor()
    fraction, is_first = t - knot, knot == 0.0
    right = (12.0 * math.sqrt(3) - 18.0) * torch.pow(math.sqrt(3) - 2.0, knot)
    left = torch.where(is_first, 6.0 - 6.0 * math.sqrt(3), right / (math.sqrt(3) - 2.0))
    curvature_term = left * ((1.0 - fraction) ** 3 - (1.0 - fraction)) + right * (fraction**3 - fraction)
    return torch.where(is_first, 1.0 - fraction, 0.0) + curvature_term / 6.0


def _non_negative(kernel: Tensor) -> Tensor:
    """Raises negative values ``[..., n, n]`` to 0 with light from their four neighbours, in proportion to their own.

    Light moves by one pixel only, which hardly changes the low frequencies, where photographs have most of their power.
    """
    positive, deficit = kernel.clamp_min(0.0), (-kernel).clamp_min(0.0)
    neighbour_light = _neighbours(positive)
    rate = torch.where(neighbour_light > 0, deficit / torch.where(neighbour_light > 0, neighbour_light, 1.0), 0.0)
    return (positive * (1.0 - _neighbours(rate))).clamp_min(0.0)


def _neighbours(values: Tensor) -> Tensor:
    """Sum of the four neighbours of each value ``[..., n, n]``."""
    rows, columns = functional.pad(values, (0, 0, 1, 1)), functional.pad(values, (1, 1))
    return rows[..., :-2, :] + rows[..., 2:, :] + columns[..., :-2] + columns[..., 2:]


def _gaussian_line(sigma: Tensor, half: int) -> Tensor:
    """Integral of a Gaussian over each unit step outwards from its centre: ``[..., half + 1]``."""
    edges = torch.arange(half + 2, dtype=torch.float64, device=sigma.device) - 0.5
    cumulative = torch.erf(edges / (math.sqrt(2) * sigma.unsqueeze(-1)))
    tail = torch.erfc(edges / (math.sqrt(2) * sigma.unsqueeze(-1)))
    # differences of erf round badly in the tail, those of erfc at the centre
    return torch.where(edges[:-1] < 1.0, cumulative[..., 1:] - cumulative[..., :-1], tail[..., :-1] - tail[..., 1:])


def _disc_quadrant(radius: Tensor, half: int) -> Tensor:
    """Area of a disc in each cell right of and below its centre, ``[..., half + 1, half + 1]``, each axis included."""
    radius = radius[..., None, None]
    index = torch.arange(half + 1, dtype=torch.float64, device=radius.device)
    edge = torch.cat([index.new_zeros(1), index + 0.5])
    covered = _corner_area(edge, edge[:, None], radius).diff(dim=-1).diff(dim=-2).clamp_min(0.0)
    # cells wholly outside or inside the circle are exact, without the rounding of differences
    farthest, nearest = (torch.hypot(side[:, None], side) for side in (edge[1:], edge[:-1]))
    covered = torch.where(farthest <= radius, edge.diff()[:, None] * edge.diff(), covered)
    return torch.where(nearest < radius, covered, 0.0) * _mirror_factor(index)


def _mirror_factor(index: Tensor) -> Tensor:
    """Factor of each cell's area in the quadrant: a cell on an axis extends equally to the other side."""
    twice = torch.where(index == 0, 2.0, 1.0)
    return twice[:, None] * twice[None, :]


def _sliced_quadrant(family: str, lengths: Mapping[str, Tensor], half: int, slices: int) -> Tensor:
    """Integral of any profile over each cell right of and below its centre, cut by circles into thin slices."""
    rows = max(1, _SLICES_AT_ONCE // ((half + 1) * slices))
    strips = []
    for top in range(0, half + 1, rows):
        cut = _slices(half, slices, top, min(top + rows, half + 1))
        inner, outer, area = (t.to(lengths[FAMILIES[family][-1]].device) for t in cut)
        strips.append((_slice_means(family, lengths, inner, outer) * area).sum(-1).unflatten(-1, (-1, half + 1)))
    return torch.cat(strips, -2)


def _slice_means(family: str, p: Mapping[str, Tensor], inner: Tensor, outer: Tensor) -> Tensor:
    """Mean over r of the profile in each slice: ``[..., pixels, slices]``."""
    p = {k: v if k == "values" else v[..., None, None] for k, v in p.items()}
    thickness = outer - inner
    if family == "ring":
        width = math.sqrt(2) * p["sigma"]
        return (torch.erf((outer - p["r_c"]) / width) - torch.erf((inner - p["r_c"]) / width)) * width / thickness
    if family == "softm":
        width = math.sqrt(2) * p["sigma"]
        rise = _erfc_integral((outer - p["radius"]) / width) - _erfc_integral((inner - p["radius"]) / width)
        return (rise * width / thickness).clamp_min(0.0) * _tilt_factor((inner + outer) / 2, p)
    return (_table_integral(outer, p) - _table_integral(inner, p)).clamp_min(0.0) / thickness


def _erfc_integral(x: Tensor) -> Tensor:
    """``integral of erfc(x) / 2``, arranged so that nothing cancels where erfc is nearly 2."""
    a = x.abs()
    tail = 0.5 * (a * torch.erfc(a) - torch.exp(-a * a) / math.sqrt(math.pi))
    return torch.where(x < 0, x + tail, tail)


def _table_integral(r: Tensor, p: Mapping[str, Tensor]) -> Tensor:
    """Integral from 0 to r of the piecewise linear table: ``[..., pixels, slices]``."""
    values, radius = p["values"], p["radius"]
    last = values.shape[-1] - 1
    position = (r / radius).clamp(max=1.0) * last
    low = position.detach().floor().long().clamp(max=last - 1)
    cumulative = functional.pad(torch.cumulative_trapezoid(values), (1, 0))
    batch = broadcast_shapes(values.shape[:-1], low.shape[:-2])
    flat = low.expand(*batch, *low.shape[-2:]).flatten(-2)
    start, left, right = (
        v.expand(*batch, -1).gather(-1, i).unflatten(-1, low.shape[-2:])
        for v, i in ((cumulative, flat), (values, flat), (values, flat + 1))
    )
    fraction = position - low
    return (start + left * fraction + (right - left) * fraction * fraction / 2) * radius / last


@kept
def _slices(half: int, slices: int, top: int, bottom: int) -> tuple[Tensor, Tensor, Tensor]:
    """Slices of the cells of a quadrant's rows: inner and outer radius and area, each ``[cells, slices]``."""
    index = torch.arange(half + 1, dtype=torch.float64, device="cpu")
    low, high = (index - 0.5).clamp_min(0.0), index + 0.5
    low_y, low_x = (v.flatten()[:, None] for v in torch.meshgrid(low[top:bottom], low, indexing="ij"))
    high_y, high_x = (v.flatten()[:, None] for v in torch.meshgrid(high[top:bottom], high, indexing="ij"))
    nearest, farthest = torch.hypot(low_y, low_x), torch.hypot(high_y, high_x)
    fractions = torch.linspace(0.0, 1.0, slices + 1, dtype=torch.float64, device="cpu")
    r = nearest + (farthest - nearest) * fractions
    covered = (
        _corner_area(high_x, high_y, r)
        - _corner_area(low_x, high_y, r)
        - _corner_area(high_x, low_y, r)
        + _corner_area(low_x, low_y, r)
    )
    covered = covered * _mirror_factor(index)[top:bottom].flatten()[:, None]
    return r[:, :-1].contiguous(), r[:, 1:].contiguous(), covered.diff(dim=-1).clamp_min(0.0)


def _corner_area(x: Tensor, y: Tensor, r: Tensor) -> Tensor:
    """Area of the quarter disc of radius r that lies within the rectangle from the origin to (x, y)."""
    x, y = torch.minimum(x, r), torch.minimum(y, r)
    reach = _safe_sqrt(r * r - y * y)  # for smaller x the rectangle's top is inside the disc

    def under_arc(t: Tensor) -> Tensor:
        inside = t < r
        angle = torch.where(inside, torch.asin(torch.where(inside, t / r, 0.0)), math.pi / 2)
        return 0.5 * (t * _safe_sqrt(r * r - t * t) + r * r * angle)

    beyond = torch.where(x > reach, under_arc(x) - under_arc(torch.minimum(reach, x)), 0.0)
    return torch.where(r > 0, y * torch.minimum(x, reach) + beyond, 0.0)


def _safe_sqrt(square: Tensor) -> Tensor:
    """Square root of positive numbers, 0 for others, with finite gradients."""
    positive = square > 0
    return torch.where(positive, torch.sqrt(torch.where(positive, square, 1.0)), 0.0)
