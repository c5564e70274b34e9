"""Makes a blur table of a lens prescription: traces spots at many distances, and fits a profile to each."""

import datetime
import math
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from torchdof.optics.blur_table import BlurTable
from torchdof.optics.camera import Camera
from torchdof.validation import number, show, whole

from .field import coc_nodes, trace_field
from .glass import C_UM, F_UM
from .lens import Lens
from .nodes import Tracer, place_nodes
from .spot import Focus, Reference, Spot, focus_sensor, point_spread


def trace_table(
    lens: Lens,
    f_number: float = 2.0,
    focus_m: float = 2.0,
    *,
    nodes: int | None = None,
    nearest_m: float | None = None,
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

    Nodes are keyed by the signed coc that :class:`torchdof.Camera` gives for the lens's paraxial focal length,
    ``f_number`` and ``focus_m``: render with that camera. Nodes are placed where interpolation would be worst, as many
    as are needed for 50 dB on a natural image between them.

    1. Stop the lens down and focus it: the position of the sensor.
    2. Place the nodes of coc, tracing spots in between to find the worst interpolation.
    3. Fit a profile to the spot of each node, for each wavelength.
    4. With ``field``, trace spots off the axis too.

    The table is exact for its focus and f-number only; :func:`torchdof.fit.check_reach` warns of others.

    Args:
        lens: The prescription.
        f_number: Marked f-number; up to 3 % below that of the open stop means fully open.
        focus_m: Focus distance in metres from ``reference``; ``inf`` allowed.
        nodes: Number of nodes, at least 5, or 3 for a focus at infinity; None uses as many as needed.
        nearest_m: Nearest object distance in metres; None is a third of the focus distance (the blur is then twice that
            of infinity), or 25 focal lengths for a focus at infinity. The farthest distance is infinity.
        points: Number of values of a profile, at least 3.
        focus: ``"best"`` or ``"paraxial"``, see :func:`torchdof.fit.lens.spot.focus_sensor`.
        reference: Reference point of distances, see :mod:`torchdof.fit.lens.spot`. Depth maps must use the same.
        field_mm: Image height in mm. Off the axis, the table has the rotational average of the spot about its centroid,
            and ``provenance["asymmetry"]`` the spot's deviation from a round one.
        wavelengths_um: One wavelength for each channel, such as :data:`torchdof.fit.lens.lens.RGB_UM`, for a lens whose
            prescription has Abbe numbers; None traces the d line for all channels.
        sensor_width_mm: Width of the sensor.
        width_px: Width of the images for which the fit is made: details far below a pixel do not count.
        rays: Rays for each spot; None is 2,000 on the axis, traced as a fan, and 50,000 off it.
        field: Distances in mm from the centre of the frame, increasing from 0 (to 21.6 mm for 36 x 24 mm), at which
            spots are traced for a table whose kernels vary over the frame (:class:`torchdof.optics.field.Field`).
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
    _check(arguments)
    stopped = lens.with_f_number(f_number)
    focal = lens.paraxial().focal_length
    sensor = focus_sensor(stopped, focus_m, focus, reference)
    if nearest_m is None:
        nearest_m = focus_m / 3.0 if math.isfinite(focus_m) else 0.025 * focal
    if not 0 < number("nearest_m", nearest_m, unit="metres") < focus_m:
        raise ValueError(f"nearest_m must be nearer than the focus at {focus_m} m, got {nearest_m}")
    rays = (50_000 if field_mm else 2_000) if rays is None else rays
    ends = torch.tensor([nearest_m, math.inf], dtype=torch.float64)[None, None, None]
    near, far = Camera(focal, f_number, focus_m, 1.0).coc_px(ends, width=1).flatten().tolist()  # a pixel is 1 mm

    def distance(coc: float) -> float:
        dioptres = 1.0 / focus_m - coc / near * (1.0 / focus_m - 1.0 / nearest_m)
        return 1.0 / dioptres if dioptres > 1e-9 else math.inf

    options: dict[str, Any] = {"field_mm": field_mm, "rays": rays, "reference": reference, "meridional": not field_mm}

    def spot(coc: float, wavelength_um: float | None) -> Spot:
        return point_spread(stopped, distance(coc), sensor, wavelength_um=wavelength_um, **options)

    with threadpool_limits(limits=1):
        d_line, *coloured = (
            Tracer(partial(spot, wavelength_um=wavelength), points, sensor_width_mm / width_px)
            for wavelength in (None, *(wavelengths_um or ()))
        )
        cocs, channels = place_nodes(d_line, near, far, nodes), coloured or [d_line]
        fitted = [[tracer.fitted(coc) for coc in cocs] for tracer in channels]
        residuals = [[tracer.error(coc, *tracer.fitted(coc)) for coc in cocs] for tracer in channels]
        spots = None
        if field is not None:
            field_cocs = coc_nodes(near, far, field_nodes)
            spots = trace_field(stopped, sensor, distance, field_cocs, field, wavelengths_um, field_rays, reference)
    del arguments["lens"]
    call = ", ".join(f"{key}={value!r}" for key, value in {**arguments, "nearest_m": nearest_m, "rays": rays}.items())
    provenance = {
        "lens": lens.name,
        "source": lens.source,
        "prescription": "; ".join(lens.lines()),
        "focal_length_mm": round(focal, 4),
        "f_number_paraxial": round(stopped.paraxial().f_number, 4),
        **{key: arguments[key] for key in ("f_number", "focus", "reference", "field_mm")},
        "focus_m": focus_m if math.isfinite(focus_m) else "inf",
        "nearest_m": round(nearest_m, 6),
        "wavelengths_um": list(wavelengths_um or ()) or "d line",
        "asymmetry": [round(channels[-1].spot(coc).asymmetry, 4) for coc in cocs] if field_mm else 0.0,
        "fitted_for": f"{width_px} px on {sensor_width_mm:g} mm; geometric spots, no diffraction",
        "date": datetime.date.today().isoformat(),
        "command": f"torchdof.fit.trace_table(Lens.read({lens.name!r}), {call})",
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
        provenance=provenance,
        residual=_rounded(np.sqrt(np.mean(np.square(residuals), axis=0))),
        field=spots,
    )


def _check(arguments: dict[str, Any]) -> None:
    """Raises an error for invalid arguments of `trace_table`; `focus_sensor` and `point_spread` check the rest."""
    lens, focus_m, wavelengths, field = (arguments[key] for key in ("lens", "focus_m", "wavelengths_um", "field"))
    if not isinstance(lens, Lens):
        raise ValueError(f"lens must be a Lens, got {show(lens)}; read one with Lens.read()")
    number("focus_m", focus_m, 0, unit="metres", infinite=True)
    number("field_mm", arguments["field_mm"], -1e6, 1e6)
    number("sensor_width_mm", arguments["sensor_width_mm"], 0, 1e9)
    number("width_px", arguments["width_px"], 0, 1e9, unit="pixels")
    if arguments["nodes"] is not None:
        whole("nodes", arguments["nodes"], 5 if math.isfinite(focus_m) else 3, 1000)
    for name, low, high in (("points", 3, 1000), ("field_nodes", 2, 100), ("field_rays", 1000, 10**7)):
        whole(name, arguments[name], low, high)
    if not isinstance(arguments["name"], str | None):
        raise ValueError(f"name must be a text, got {show(arguments['name'])}")
    if wavelengths is not None:
        if not isinstance(wavelengths, list | tuple) or not wavelengths:
            raise ValueError(f"wavelengths_um must be a list of micrometres, got {show(wavelengths)}")
        for value in wavelengths:
            lens.indices(number("wavelengths_um", value, unit="micrometres"))
        if np.array_equal(lens.indices(F_UM), lens.indices(C_UM)):
            raise ValueError(f"wavelengths_um need a lens with Abbe numbers (index/V); {lens.name!r} has none")
    if field is not None:
        if arguments["field_mm"]:
            raise ValueError("field_mm averages one place, field traces several: give one of them")
        is_list = isinstance(field, list | tuple) and len(field) > 1 and field[0] == 0
        if not is_list or not all(low < number("field", high, 0, 1e6, unit="mm") for low, high in pairwise(field)):
            raise ValueError(f"field must be increasing distances in mm from the middle, from 0 on, got {show(field)}")


def _rounded(values: Any, digits: int = 6) -> Any:
    return [_rounded(v, digits) for v in values] if np.ndim(values) else float(f"{values:.{digits}g}")
