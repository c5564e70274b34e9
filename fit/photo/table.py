"""Makes one blur table of fits at several distances, keyed by the signed circle of confusion."""

import datetime
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np

from torchdof.optics.blur_table import BlurTable
from torchdof.optics.psf import FAMILIES, LENGTHS
from torchdof.validation import choice, show

from ..problems import FitError, warn, without_warnings
from ..result import Array, BlurFit
from ..validation import checked
from .agreement import check_agreement
from .captures import CAMERA, Capture, Captures
from .distances import Colour, common_opening, fit_colours, fit_one, with_uncertainty
from .family_choice import COST
from .forward import OPENINGS, SHAPES

_MAX_EXPOSURE_RATIO = 1.3  # ratio of fitted to stated exposure above which to warn
_BY_COST = (*COST, *OPENINGS)


@dataclass(frozen=True)
class TableFit:
    """A table and the fits from which it was made.

    Attributes:
        table: the blur table.
        fits: one for each pair, by increasing distance.
        coc_px: signed circle of confusion of each pair, px of the frame.
        why: reason for the family.
        scale: source of the circles of confusion: "camera" or "measured".
        colours: fits of red, green and blue, if the captures have colours; the table then has a kernel for each, and
            `fits` are those of their mean.
        coc_per_dioptre_px: circle of confusion over 1/focus - 1/distance [1/m], px of the frame.
    """

    table: BlurTable
    fits: tuple[BlurFit, ...]
    coc_px: tuple[float, ...]
    why: str
    scale: str
    coc_per_dioptre_px: float
    colours: tuple[Colour, ...] = ()


def fit_table(captures: Captures, family: str = "auto", **options: Any) -> BlurTable:
    """The blur table of a camera from photographs of a dot at one or more distances: `fit_captures(...).table`.

    Arguments and errors are those of `fit_captures`. The table is in mm of the sensor if its width is known, otherwise
    in fractions of the frame's width.

    Example:
        >>> import torch
        >>> from torchdof.optics import psf
        >>> def picture(radius, blur=0.0):  # a white dot of a radius, blurred by a disc
        ...     dot = psf.pixel_kernels("disc", {"radius": radius}, size=61) * 3.14159 * radius**2
        ...     kernel = psf.pixel_kernels("disc", {"radius": blur})
        ...     return torch.nn.functional.conv2d(dot[None, None], kernel[None, None], padding="same")[0, 0]
        >>> near = Capture(picture(8.0).numpy(), picture(10.0, 5.0).numpy(), distance_m=0.8)
        >>> far = Capture(picture(8.0).numpy(), picture(6.4, 4.0).numpy(), distance_m=1.25)
        >>> fit_table(Captures((near, far), focus_m=1.0, width_px=1000), "disc")
        BlurTable('unnamed', disc, 2 nodes)
    """
    return fit_captures(captures, family, **options).table


def fit_captures(
    captures: Captures,
    family: str = "auto",
    *,
    accuracy_db: float = 45.0,
    progress: Callable[[int, int, str], None] | None = None,
    command: str = "torchdof.fit.fit_table",
    scale_of: TableFit | None = None,
) -> TableFit:
    """Fits every distance, and makes one table of the fits.

    Nodes are keyed by the thin lens's signed circle of confusion at their distance, of the camera if it is known.
    Otherwise its scale is measured: the radius of the uniform disc with the second moment of the fitted kernels.

    1. With a free choice of family, or an opening, fit each pair alone: this determines one family for all.
    2. Fit all pairs with this family, or with this opening in different sizes.
    3. Compare the radii with the camera's, and determine the scale of the circle of confusion.
    4. Fit each colour like the mean, if the captures have colours.

    Args:
        captures: pairs at increasing distances.
        family: "auto" uses the cheapest family that is accurate enough at every distance; or a family of `fit_pair`.
            "polygon" and "image" use one opening, rotated by half a turn in front of the focus, in different sizes.
        accuracy_db: accuracy for "auto", see `fit_pair`.
        progress: called with (number done, total, text) after each fit.
        command: recorded in the table's provenance.
        scale_of: the fit of another dot in the same photographs, whose scale is used if the camera is unknown.

    Returns:
        The table and its fits.

    Raises:
        FitError: a pair cannot be fitted (the message names its file), or, of kind "camera", the fitted blur is far
        from the camera's numbers. Doubtful results give a `FitWarning`.
    """
    if not isinstance(captures, Captures):
        raise FitError(f"captures must be a Captures(pairs, focus_m=..., width_px=...), got {show(captures)}")
    checked(choice, "family", family, ("auto", *SHAPES))
    pairs, has_first_fits, done = captures.pairs, family == "auto" or family in OPENINGS, count(1)

    def report(pair: Capture) -> None:
        if progress:
            progress(next(done), len(pairs) * (2 if has_first_fits else 1), f"{pair.distance_m:g} m")

    why, first_fits = f"family {family!r} was asked for", list[BlurFit]()
    if has_first_fits:  # each pair alone determines the family or the opening; the final fits warn
        for pair in pairs:
            with without_warnings():
                first_fits.append(fit_one(pair, captures.focus_m, family, accuracy_db=accuracy_db))
            report(pair)
    if family == "auto":
        # the richest family needed at any distance is used for all
        richest = max(range(len(pairs)), key=lambda i: _BY_COST.index(first_fits[i].family))
        family = first_fits[richest].family
        why = f"{family}, for {pairs[richest].distance_m:g} m: {first_fits[richest].why}"
    opening, fits = common_opening(captures, family, first_fits) if family in OPENINGS else None, list[BlurFit]()
    for pair in pairs:
        fit = fit_one(pair, captures.focus_m, family, opening)
        ratio = 1.0 if pair.exposure is None or not fit.gain > 0 else fit.gain / pair.exposure
        if max(ratio, 1 / ratio) > _MAX_EXPOSURE_RATIO:
            text = f"the blurred dot is {ratio:.2f} times as bright as the exposures say; did the light stay the same?"
            warn(text, "exposure", file=pair.files[1], number=ratio)
        fits.append(with_uncertainty(pair, captures.focus_m, fit))
        report(pair)
    radius_px = np.array([f.radius for f in fits])
    check_agreement(captures, radius_px)
    camera_px, defocus = captures.promised_px, captures.defocus
    if camera_px is not None:
        coc_px, scale = camera_px, "camera"
    elif scale_of is not None:
        coc_px, scale = scale_of.coc_per_dioptre_px * defocus, scale_of.scale
    else:
        coc_px, scale = float(np.abs(defocus) @ radius_px / (defocus @ defocus)) * defocus, "measured"
    params, colours = _params(fits, family), tuple[Colour, ...]()
    if all(pair.colours is not None for pair in pairs):
        colours = fit_colours(captures, fits)
        colour_params = [_params(colour.fits, family) for colour in colours]
        params = {n: np.stack([p[n] for p in colour_params]) for n in params}
    if len(pairs) == 1:
        text = f"one distance was measured ({pairs[0].distance_m:g} m); the thin lens scales it to all others"
        warn(text, "single distance", file=pairs[0].files[1], number=pairs[0].distance_m)
    provenance = {
        "source": "photographs of a dot",
        "date": datetime.date.today().isoformat(),
        "focus_m": captures.focus_m,
        "distances_m": captures.distances_m.tolist(),
        "width_px": captures.width_px,
        "residual_over_noise": [round(f.residual_over_noise, 3) for f in fits if math.isfinite(f.residual_over_noise)],
        "asymmetry": [round(f.asymmetry, 4) for f in fits],
        **captures.notes,
        **{name: getattr(captures, name) for name in CAMERA if getattr(captures, name) is not None},
        **{"coc_from": scale, "family_because": why, "command": command},
    }
    if colours:
        shifts = [c.focus_shift_dioptres for c in colours]
        provenance["colours"] = [c.name for c in colours]
        provenance["focus_shift_dioptres"] = [round(s, 5) if math.isfinite(s) else None for s in shifts]
        provenance["lateral_px"] = [[[round(v, 3) for v in xy] for xy in c.lateral_px] for c in colours]
    sensor = captures.sensor_width_mm
    unit = captures.width_px if sensor is None else captures.width_px / sensor
    table = BlurTable(
        family if opening is None else "disc",
        (coc_px / unit).tolist(),
        {k: (v / unit if k in LENGTHS else v).tolist() for k, v in params.items()},
        unit="fraction" if sensor is None else "mm",
        sensor_width_mm=sensor,
        name=captures.name,
        provenance=provenance,
        residual=[round(f.residual, 6) for f in fits],
        aperture=opening,
    )
    return TableFit(table, tuple(fits), tuple(coc_px.tolist()), why, scale, float(coc_px[0] / defocus[0]), colours)


def _params(fits: Sequence[BlurFit], family: str) -> dict[str, Array]:
    """Parameters of a table of these fits, px: `[N]`, and `values` `[N, P]`."""
    if family == "radial":
        # profiles relative to their radius change little over distance
        radius = np.array([float(f.params["radius"]) for f in fits])
        values = np.stack([np.asarray(f.params["values"]) for f in fits]) * radius[:, None] ** 2
        return {"values": values, "radius": radius}
    names = ("radius",) if family in OPENINGS else FAMILIES[family]
    return {n: np.array([float(f.params[n]) for f in fits]) for n in names}
