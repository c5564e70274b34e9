"""A lens prescription to a blur table: spots traced at many distances, kernels fitted to them, smooth over depth."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from functools import partial
from typing import Any, get_args

import numpy as np

from torchdof.optics.blur_table import BlurTable
from torchdof.optics.psf import FAMILIES
from torchdof.validation import number, show, whole

from ..result import Array
from ..solve import one_thread
from .field import coc_nodes, trace_field
from .lens import Lens
from .nodes import Tracer, fit_radial, fit_shapes, place_nodes
from .spot import Focus, Reference, Spot, focus_sensor, point_spread

__all__ = ["signed_coc_mm", "trace_table"]


def trace_table(
    lens: Lens,
    f_number: float = 2.0,
    focus_m: float = 2.0,
    *,
    nodes: int | None = None,
    nearest_m: float | None = None,
    family: str = "radial",
    points: int = 65,
    focus: Focus = "best",
    reference: Reference = "principal",
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

    Nodes are keyed by the signed coc that :class:`torchdof.Camera` computes with the lens's paraxial focal length,
    ``f_number`` and ``focus_m``: use that camera to render with the table. Nodes are placed where interpolation between
    them would be worst, as many as keep a natural image to 50 dB between them; intervals whose spots stay within one
    pixel are not divided, nor those of a hundredth of one.

    The table is exact for its focus and f-number. At another focus of the same f-number it holds as far as the lens's
    aberrations do not change with distance; at another f-number it does not.

    Args:
        lens: The prescription.
        f_number: Marked f-number, see :meth:`Lens.with_f_number`.
        focus_m: Focus distance in metres from ``reference``; ``inf`` allowed.
        nodes: Number of nodes, at least 5, or 3 for a focus at infinity; None is as many as it takes.
        nearest_m: Nearest object distance in metres; None is a third of the focus distance (then the blur on the near
            side reaches twice that of infinity), or 25 focal lengths for a focus at infinity. The farthest is infinity.
        family: ``"radial"``, or a named shape fitted by least squares: ``"softm"``, ``"ring"``, ``"gaussian"``,
            ``"disc"``.
        points: Values of a radial profile, at least 3.
        focus: ``"best"`` or ``"paraxial"``, see :func:`torchdof.fit.lens.spot.focus_sensor`.
        reference: What distances are measured from, see :mod:`torchdof.fit.lens.spot`. A render's depth map has
            the same.
        field_mm: Image height in mm; off the axis the table holds the rotational average of the spot about its
            centroid, and ``provenance["asymmetry"]`` how far it was from round.
        wavelengths_um: One wavelength a channel, such as :data:`torchdof.fit.lens.RGB_UM`, for a lens whose
            prescription has Abbe numbers; None traces the d line for all channels.
        sensor_width_mm: Width of the sensor.
        width_px: Width of the images the fit is made for: details far below their pixels do not count.
        rays: Rays a spot; None is 2,000 on the axis, where a fan is enough, and 50,000 off it.
        field: Distances in mm from the middle of the frame, increasing from 0, at which spots are traced as they are,
            for a table whose kernels depend on the place (:class:`torchdof.optics.field.Field`): a full frame of
            36 x 24 mm wants those to 21.6 mm. None traces the axis alone.
        field_nodes: Blurs at which these are traced on either side of focus, on average: the farther a side reaches,
            the more.
        field_rays: Rays of each of these spots.
        name: Name of the table; None is the lens's with the f-number.

    Returns:
        A table in millimetres of the sensor, with provenance and the relative residual of each node.

    Raises:
        ValueError: If an argument is not as described, or there are more nodes than intervals to divide.

    Example:
        >>> lens = Lens.read("double_gauss_50mm")
        >>> trace_table(lens, f_number=4.0, focus_m=2.0, nodes=5, points=9, rays=200)
        BlurTable('double_gauss_50mm_f4', radial, 5 nodes)
    """
    _check(lens, family, nodes, points, focus, reference, wavelengths_um, rays, name)
    if not isinstance(focus_m, float) or focus_m != math.inf:
        number("focus_m", focus_m, unit="metres")
        if focus_m > 1e9:
            raise ValueError(f"focus_m must be at most 1e9 metres, or inf, got {show(focus_m)}")
    number("field_mm", field_mm, -1e6, 1e6)
    if nodes is not None and nodes < (5 if math.isfinite(focus_m) else 3):
        raise ValueError(f"nodes must be at least 5 (3 for a focus at infinity), got {nodes}")
    _check_field(field, field_mm, field_nodes, field_rays)
    number("sensor_width_mm", sensor_width_mm, 0, 1e9)
    number("width_px", width_px, 0, 1e9, unit="pixels")
    if wavelengths_um is not None and not lens.dispersive:
        raise ValueError(f"wavelengths_um need a lens with Abbe numbers (index/V); {lens.name!r} has none")
    stopped = lens.with_f_number(f_number)
    focal = lens.paraxial().focal_length
    sensor = focus_sensor(stopped, focus_m, focus, reference)
    if nearest_m is None:
        nearest_m = focus_m / 3.0 if math.isfinite(focus_m) else 0.025 * focal
    if not 0 < number("nearest_m", nearest_m, unit="metres") < focus_m:
        raise ValueError(f"nearest_m must be nearer than the focus at {focus_m} m, got {nearest_m}")
    count = rays or (50_000 if field_mm else 2_000)
    call = (
        f"Lens.read({lens.name!r}), f_number={f_number!r}, focus_m={focus_m!r}, nearest_m={nearest_m!r}, "
        f"nodes={nodes}, family={family!r}, points={points}, focus={focus!r}, reference={reference!r}, "
        f"field_mm={field_mm:g}, wavelengths_um={wavelengths_um}, sensor_width_mm={sensor_width_mm:g}, "
        f"width_px={width_px}, rays={count}"
    )

    def distance(coc: float) -> float:
        dioptres = 1.0 / focus_m - coc / _coc_per_dioptre(focal, f_number, focus_m)
        return 1.0 / dioptres if dioptres > 1e-9 else math.inf

    def spot(wavelength_um: float | None, coc: float) -> Spot:
        return point_spread(
            stopped,
            distance(coc),
            sensor,
            field_mm=field_mm,
            rays=count,
            wavelength_um=wavelength_um,
            reference=reference,
            meridional=field_mm == 0.0,
        )

    near, far = (signed_coc_mm(z, focal, f_number, focus_m) for z in (nearest_m, math.inf))
    pixel = sensor_width_mm / width_px
    with one_thread():
        tracer = Tracer(partial(spot, None), points, pixel)
        places = place_nodes(tracer, near, far, nodes)
        fitted = []
        for wavelength in wavelengths_um or (None,):
            if wavelength is not None:
                tracer = Tracer(partial(spot, wavelength), points, pixel)
            fitted.append(fit_radial(tracer, places) if family == "radial" else fit_shapes(tracer, places, family))
        across = None
        if field is not None:
            blurs = coc_nodes(near, far, field_nodes)
            across = trace_field(stopped, sensor, distance, blurs, field, wavelengths_um, field_rays, reference)
            call += f", field={tuple(field)}, field_nodes={field_nodes}, field_rays={field_rays}"
    params = {key: [_rounded(channel[0][key]) for channel in fitted] for key in FAMILIES[family]}
    residual = np.sqrt(np.mean([channel[1] ** 2 for channel in fitted], axis=0))
    provenance = {
        "lens": lens.name,
        "source": lens.source,
        "prescription": "; ".join(lens.lines()),
        "focal_length_mm": round(focal, 4),
        "f_number": f_number,
        "f_number_paraxial": round(stopped.paraxial().f_number, 4),
        "focus_m": focus_m if math.isfinite(focus_m) else "inf",
        "nearest_m": round(nearest_m, 6),
        "focus": focus,
        "reference": reference,
        "field_mm": field_mm,
        "wavelengths_um": list(wavelengths_um or ()) or "d line",
        "asymmetry": [round(tracer.spot(coc).asymmetry, 4) for coc in places] if field_mm else 0.0,
        "fitted_for": f"{width_px} px on {sensor_width_mm:g} mm; geometric spots, no diffraction",
        "date": datetime.date.today().isoformat(),
        "command": f"torchdof.fit.trace_table({call})",
    }
    return BlurTable(
        family,
        _rounded(np.array(places), 9),
        params,
        unit="mm",
        sensor_width_mm=sensor_width_mm,
        name=f"{lens.name}_f{f_number:g}" if name is None else name,
        provenance=provenance,
        residual=_rounded(residual),
        field=across,
    )


def _check(
    lens: Any, family: Any, nodes: Any, points: Any, focus: Any, reference: Any, wavelengths: Any, rays: Any, name: Any
) -> None:
    """Refuse arguments of :func:`trace_table` that make no sense, by name."""
    if not isinstance(lens, Lens):
        raise ValueError(f"lens must be a Lens, got {show(lens)}; read one with Lens.read()")
    for what, value, known in (
        ("family", family, tuple(FAMILIES)),
        ("focus", focus, get_args(Focus)),
        ("reference", reference, get_args(Reference)),
    ):
        if not isinstance(value, str) or value not in known:
            raise ValueError(f"{what} must be one of {', '.join(known)}, got {show(value)}")
    if isinstance(points, bool) or not isinstance(points, int) or not 3 <= points <= 1000:
        raise ValueError(f"points must be at least 3, got {show(points)} (and 1000 at most)")
    if nodes is not None:
        whole("nodes", nodes, 3, 1000)
    if rays is not None:
        if isinstance(rays, bool) or not isinstance(rays, int) or not 16 <= rays <= 10**7:
            raise ValueError(f"rays must be at least 16 (and 10 million at most), got {show(rays)}")
    if name is not None and not isinstance(name, str):
        raise ValueError(f"name must be a text, got {show(name)}")
    if wavelengths is None:
        return
    if not isinstance(wavelengths, list | tuple) or not wavelengths:
        raise ValueError(f"wavelengths_um must be a list of wavelengths in micrometres, got {show(wavelengths)}")
    for value in wavelengths:
        number("wavelengths_um", value, 0.299, 1.201, unit="micrometres")


def _check_field(field: Any, field_mm: float, nodes: Any, rays: Any) -> None:
    """Refuse distances across the field that make no sense."""
    whole("field_nodes", nodes, 2, 100)
    whole("field_rays", rays, 1000, 10**7)
    if field is None:
        return
    if field_mm:
        raise ValueError(f"field_mm averages one place, field traces several: give one of them, got {field_mm} mm too")
    if not isinstance(field, list | tuple) or len(field) < 2 or field[0] != 0:
        raise ValueError(f"field must be distances in mm from the middle of the frame, from 0 on, got {show(field)}")
    for low, high in zip(field, field[1:], strict=False):
        if not number("field", high, 0, 1e6, unit="mm") > low:
            raise ValueError(f"field must be increasing distances in mm, got {show(field)}")


def signed_coc_mm(z_m: float, focal_length_mm: float, f_number: float, focus_m: float) -> float:
    """Signed radius of the thin lens's circle of confusion in mm on the sensor, as :class:`torchdof.Camera` has it.

    Example:
        >>> round(signed_coc_mm(1.0, 50.3582, 2.03015, 2.0), 4)
        -0.3204
    """
    return _coc_per_dioptre(focal_length_mm, f_number, focus_m) * (1.0 / focus_m - 1.0 / z_m)


def _coc_per_dioptre(focal: float, f_number: float, focus_m: float) -> float:
    if not focus_m > focal / 1000.0:
        raise ValueError(f"focus_m must be longer than the focal length ({focal / 1000:.4g} m), got {focus_m}")
    return focal / (2.0 * f_number) * focal / 1000.0 / (1.0 - focal / 1000.0 / focus_m)


def _rounded(values: Array, digits: int = 6) -> Any:
    return [_rounded(v, digits) for v in values] if np.ndim(values) else float(f"{values:.{digits}g}")
