"""Makes a blur table of a lens prescription: traces spots at many distances, and fits a profile to each.

Spots and profiles are compared by their transfer functions, which are Hankel transforms; a spot's is a sum of Bessel
functions over its rays. Both are weighted by the spectrum of natural images (amplitude 1/frequency) and the area of a
pixel. The squared difference is then the squared error in a photograph, up to a constant.

A profile has the radius of the outermost ray, and is linear in its values. So the fit is a convex problem with a single
solution. Nodes are added until profiles interpolated between them fit the spots there too.
"""

import datetime
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from scipy.optimize import nnls
from scipy.special import j0
from threadpoolctl import threadpool_limits

from torchdof.optics.blur_table import BlurTable
from torchdof.optics.camera import Camera
from torchdof.validation import number, show, whole

from ..result import Array
from .glass import C_UM, F_UM
from .lens import Lens
from .spot import Focus, Spot, coc_nodes, focus_sensor, point_spread, trace_field

_MIN_INTERVAL_PX = 0.01  # pixels of coc; narrower intervals are not divided
_TARGET_DB = 62.0  # PSNR of a natural image in the middle of an interval; elsewhere it may be a few dB less
_CONTRAST = 0.22  # standard deviation of natural images over their peak
_MAX_FREQUENCY = 3.0  # cycles for each pixel; kernels are sampled on the pixel grid, so higher frequencies are aliased
_PRIOR_WEIGHT = 1e-4  # weight of the ray histogram, which determines details of the profile far below a pixel


def trace_table(
    lens: Lens,
    f_number: float = 2.0,
    focus_m: float = 2.0,
    *,
    nodes: int | None = None,
    nearest_m: float | None = None,
    points: int = 65,
    focus: Focus = "best",
    field_mm: float = 0.0,
    wavelengths_um: Sequence[float] | None = None,
    sensor_width_mm: float = 36.0,
    width_px: int = 1920,
    rays: int | None = None,
    field: Sequence[float] | None = None,
    field_nodes: int = 14,
    field_rays: int = 160_000,
    name: str | None = None,
) -> BlurTable:
    """Blur table of a lens, traced at many distances on both sides of focus.

    Nodes are keyed by the signed coc that :class:`torchdof.Camera` gives for the lens's paraxial focal length,
    ``f_number`` and ``focus_m``: render with that camera. Nodes are placed where interpolation would be worst, as many
    as are needed for 50 dB on a natural image between them.

    The table is exact for its focus and f-number only.

    Args:
        lens: The prescription.
        f_number: Marked f-number; up to 3 % below that of the open stop means fully open.
        focus_m: Focus distance in metres from the front principal plane, where depth maps must start too; or ``inf``.
        nodes: Number of nodes, at least 5, or 3 for a focus at infinity; None uses as many as needed.
        nearest_m: Nearest object distance in metres; None is a third of the focus distance, or 25 focal lengths for a
            focus at infinity. The farthest distance is infinity.
        points: Number of values of a profile, at least 3.
        focus: ``"best"`` or ``"paraxial"``, see :func:`torchdof.fit.lens.spot.focus_sensor`.
        field_mm: Image height in mm at which the spot is traced; the table has its rotational average.
        wavelengths_um: One wavelength for each channel, such as :data:`torchdof.fit.lens.lens.RGB_UM`, for a lens whose
            prescription has Abbe numbers; None traces the d line for all channels.
        sensor_width_mm: Width of the sensor.
        width_px: Width of the images for which the fit is made: details far below a pixel do not count.
        rays: Rays for each spot; None is 2,000 on the axis, traced as a fan, and 50,000 off it.
        field: Distances in mm from the centre, increasing from 0, for a table whose kernels vary over the frame.
        field_nodes: Mean number of blurs on each side of focus at which these are traced.
        field_rays: Rays for each of these spots.
        name: Name of the table; None uses the lens's name and the f-number.

    Returns:
        A table in millimetres of the sensor, with provenance and the relative residual of each node.

    Raises:
        ValueError: If an argument is invalid, or there are more nodes than intervals to divide.

    Example:
        >>> lens = Lens.read("double_gauss_50mm")
        >>> trace_table(lens, f_number=4.0, focus_m=2.0, nodes=5, points=9, rays=200)
        BlurTable('double_gauss_50mm_f4', radial, 5 nodes)
    """
    arguments = dict(locals())
    _refuse(**arguments)
    stopped = lens.with_f_number(f_number)
    focal = lens.paraxial().focal_length
    sensor = focus_sensor(stopped, focus_m, focus)
    if nearest_m is None:
        nearest_m = focus_m / 3.0 if math.isfinite(focus_m) else 0.025 * focal
    number("nearest_m", nearest_m, 0, focus_m, unit="metres")
    rays = (50_000 if field_mm else 2_000) if rays is None else rays
    ends = torch.tensor([nearest_m, math.inf], dtype=torch.float64)[None, None, None]
    near, far = Camera(focal, f_number, focus_m, 1.0).coc_px(ends, width=1).flatten().tolist()  # a pixel is 1 mm

    def distance(coc: float) -> float:
        dioptres = 1.0 / focus_m - coc / near * (1.0 / focus_m - 1.0 / nearest_m)
        return 1.0 / dioptres if dioptres > 1e-9 else math.inf

    options: dict[str, Any] = {"field_mm": field_mm, "rays": rays, "meridional": not field_mm}

    def tracer(line_um: float | None) -> Tracer:
        def spot(coc: float) -> Spot:
            return point_spread(stopped, distance(coc), sensor, wavelength_um=line_um, **options)

        return Tracer(spot, points, sensor_width_mm / width_px)

    with threadpool_limits(limits=1):
        d_line, *coloured = map(tracer, (None, *(wavelengths_um or ())))
        cocs, channels = place_nodes(d_line, near, far, nodes), coloured or [d_line]
        fitted = [[tracer.fitted(coc) for coc in cocs] for tracer in channels]
        residuals = [[tracer.error(coc, *tracer.fitted(coc)) for coc in cocs] for tracer in channels]
        places = coc_nodes(near, far, field_nodes), field or ()
        spots = None if field is None else trace_field(stopped, sensor, distance, *places, wavelengths_um, field_rays)
    arguments |= {"nearest_m": nearest_m, "rays": rays}
    made = {
        "focal_length_mm": round(focal, 4),
        "f_number_paraxial": round(stopped.paraxial().f_number, 4),
        "nearest_m": round(nearest_m, 6),
        "asymmetry": [round(channels[-1].spot(coc).asymmetry, 4) for coc in cocs] if field_mm else 0.0,
    }
    return BlurTable(
        "radial",
        _rounded(np.array(cocs), 9),
        {
            "values": [[_rounded(values) for _, values in nodes] for nodes in fitted],
            "radius": [[_rounded(radius * d_line.pixel) for radius, _ in nodes] for nodes in fitted],
        },
        unit="mm",
        sensor_width_mm=sensor_width_mm,
        name=f"{lens.name}_f{f_number:g}" if name is None else name,
        provenance=_provenance(arguments) | made,
        residual=_rounded(np.sqrt(np.mean(np.square(residuals), axis=0))),
        field=spots,
    )


def _refuse(
    lens: Lens,
    focus_m: float,
    field_mm: float,
    sensor_width_mm: float,
    width_px: int,
    nodes: int | None,
    wavelengths_um: Sequence[float] | None,
    field: Sequence[float] | None,
    **others: Any,
) -> None:
    """Refuses arguments of :func:`trace_table`."""
    if not isinstance(lens, Lens):
        raise ValueError(f"lens must be a Lens, got {show(lens)}; read one with Lens.read()")
    number("focus_m", focus_m, 0, unit="metres", infinite=True)
    number("field_mm", field_mm, -1e6, 1e6)
    number("sensor_width_mm", sensor_width_mm, 1e-6, 1e9, unit="millimetres")
    number("width_px", width_px, 0, 1e9, unit="pixels")
    if nodes is not None:
        whole("nodes", nodes, 5 if math.isfinite(focus_m) else 3, 1000)
    for key, low, high in (("points", 3, 1000), ("field_nodes", 2, 100), ("field_rays", 1000, 10**7)):
        whole(key, others[key], low, high)
    if wavelengths_um is not None:
        if not isinstance(wavelengths_um, list | tuple) or not wavelengths_um:
            raise ValueError(f"wavelengths_um must be a list of micrometres, got {show(wavelengths_um)}")
        for value in wavelengths_um:
            lens.indices(number("wavelengths_um", value, unit="micrometres"))
        if np.array_equal(lens.indices(F_UM), lens.indices(C_UM)):
            raise ValueError(f"wavelengths_um need a lens with Abbe numbers (index/V); {lens.name!r} has none")
    if field is not None:
        if field_mm:
            raise ValueError("field_mm averages one place, field traces several: give one of them")
        is_list = isinstance(field, list | tuple) and len(field) > 1 and field[0] == 0
        if not is_list or not all(low < number("field", high, 0, 1e6, unit="mm") for low, high in pairwise(field)):
            raise ValueError(f"field must be increasing distances in mm from the middle, from 0 on, got {show(field)}")


def _provenance(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """What the table records of the arguments of :func:`trace_table`, and how to make it again."""
    lens, focus_m, lines_um = arguments["lens"], arguments["focus_m"], arguments["wavelengths_um"]
    call = ", ".join(f"{key}={value!r}" for key, value in arguments.items() if key != "lens")
    fitted_for = f"{arguments['width_px']} px on {arguments['sensor_width_mm']:g} mm"
    return {
        "lens": lens.name,
        "source": lens.source,
        "prescription": "; ".join(lens.lines()),
        **{key: arguments[key] for key in ("f_number", "focus", "field_mm")},
        "focus_m": focus_m if math.isfinite(focus_m) else "inf",
        "wavelengths_um": list(lines_um or ()) or "d line",
        "fitted_for": f"{fitted_for}; geometric spots, no diffraction",
        "date": datetime.date.today().isoformat(),
        "command": f"torchdof.fit.trace_table(Lens.read({lens.name!r}), {call})",
    }


def _rounded(values: Any, digits: int = 6) -> Any:
    return [_rounded(v, digits) for v in values] if np.ndim(values) else float(f"{values:.{digits}g}")


class Tracer:
    """Traces spots by coc, and fits profiles that are piecewise linear at ``points`` radii; keeps the results."""

    def __init__(self, spot: Callable[[float], Spot], points: int, pixel: float) -> None:
        self.spot, self.points, self.pixel = spot, points, pixel
        self.frequency = np.linspace(1 / 256, _MAX_FREQUENCY, 400)
        # amplitude of natural images times the area of a ring of frequencies; constant beyond Nyquist (aliasing)
        spectrum = np.minimum(self.frequency, 0.5) ** -0.5
        self.weight = spectrum / np.sqrt(1.0 + (np.pi * self.frequency) ** 2)
        count = 12 * (points - 1)
        self._r = (np.arange(count) + 0.5) / count  # radii relative to the profile's
        self._light = _hats(self._r, points) * (2.0 * np.pi * self._r / count)[:, None]
        self.traced, self.fitted = functools.cache(self._traced), functools.cache(self._fitted)

    def _traced(self, coc: float) -> tuple[Array, Array, Array]:
        """Radii in pixels, weights, and weighted transfer function (a Hankel transform) of the spot."""
        spot = self.spot(coc)
        r, light = np.maximum(spot.r / self.pixel, 1e-9), spot.weight
        slices = (slice(i, i + 4096) for i in range(0, len(r), 4096))
        parts = [j0(2.0 * np.pi * np.outer(self.frequency, r[i])) @ light[i] for i in slices]
        return r, light, np.sum(parts, axis=0) * self.weight

    def _basis(self, radius: float) -> Array:
        """Weighted transfer functions ``[F, P]`` of the hats of a profile that ends at ``radius`` pixels."""
        return j0(2.0 * np.pi * np.outer(self.frequency, self._r * radius)) @ self._light * self.weight[:, None]

    def _fitted(self, coc: float) -> tuple[float, Array]:
        """Radius in pixels of the outermost ray, and values of the profile that fits the spot, with a light of 1."""
        r, light, transfer = self.traced(coc)
        radius, area = float(r.max()), self._light.sum(0)  # integral of each hat
        # a large weight fixes the total light, a small one of the rays' histogram the details that no picture shows
        basis, total = self._basis(radius), 100.0 * self.weight.max() * area
        prior = _PRIOR_WEIGHT * np.sqrt((np.sum(basis**2) + np.sum(total**2)) * area / area.sum())
        histogram = light @ _hats(r / radius, self.points) / area
        rows = np.vstack([basis, total, np.diag(prior)])
        target = np.concatenate([transfer, [100.0 * self.weight.max()], prior * histogram])
        values, _ = nnls(rows, target, maxiter=50 * self.points)
        return radius, values / (area @ values)

    def error(self, coc: float, radius: float, values: Array) -> float:
        """Root of the weighted squared error of a profile against the spot, relative to that of an empty kernel."""
        difference = self._basis(radius) @ values - self.traced(coc)[2]
        return float(np.linalg.norm(difference) / np.linalg.norm(self.weight))


def _hats(r: Array, points: int) -> Array:
    """Values at radii ``[R]`` from 0 to 1 of the piecewise linear profile's basis ``[R, P]``."""
    return np.maximum(1.0 - np.abs(r[:, None] * (points - 1) - np.arange(points)), 0.0)


def place_nodes(tracer: Tracer, near: float, far: float, nodes: int | None) -> list[float]:
    """Signed coc of ``nodes`` nodes, or of as many as 50 dB need: halves the interval with the worst interpolation."""

    def interval_error(left: float, right: float) -> float:
        (radius, values), (next_radius, next_values) = tracer.fitted(left), tracer.fitted(right)
        if max(radius, next_radius) <= 0.5 or right - left < _MIN_INTERVAL_PX * tracer.pixel:
            return 0.0
        return tracer.error((left + right) / 2, (radius + next_radius) / 2, (values + next_values) / 2)

    cocs = [near, near / 2, 0.0, far / 2, far] if far > 0 else [near, near / 2, 0.0]
    errors = [interval_error(*pair) for pair in pairwise(cocs)]
    accepted_error = 10.0 ** (-_TARGET_DB / 20.0) / _CONTRAST
    while len(cocs) < nodes if nodes is not None else max(errors) > accepted_error:
        worst = int(np.argmax(errors))
        if errors[worst] == 0.0:
            most = f"{len(cocs)} for this lens and width_px, got {nodes}"
            raise ValueError(f"nodes must be at most {most}: more would hardly differ; take a larger width_px")
        left, right = cocs[worst : worst + 2]
        middle = (left + right) / 2
        cocs.insert(worst + 1, middle)
        errors[worst : worst + 1] = [interval_error(left, middle), interval_error(middle, right)]
    return cocs
