"""Fits the pairs of a capture, and makes one blur table of the fits, keyed by the signed circle of confusion."""

import datetime
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any

import numpy as np

from torchdof.optics.aperture import Aperture
from torchdof.optics.blur_table import BlurTable
from torchdof.optics.psf import FAMILIES, LENGTHS
from torchdof.validation import choice, show

from ..problems import FitError, checked, warn, without_warnings
from ..result import Array, BlurFit
from .captures import CAMERA, Capture, Captures
from .dot import find_dot
from .family_choice import COST
from .forward import OPENINGS, SHAPES
from .pair import fit_pair
from .source import soft_edge

_MIN_BLUR_PX = 2.0  # radius of a blur that is compared with the camera's; aberrations dominate smaller ones
# log factors between both above which to warn and to refuse; a thick lens differs by up to 1.1, an f-stop by 1.41
_WARN_LOG, _REFUSE_LOG = math.log(1.15), math.log(1.35)
_MAX_EXPOSURE_RATIO = 1.3  # ratio of fitted to stated exposure above which to warn
_BY_COST = (*COST, *OPENINGS)
_KNOTS = 33  # values of a free profile, equal for all distances

Report = Callable[[Capture], None]  # called with each pair that has been fitted


@dataclass(frozen=True)
class TableFit:
    """A table and the fits from which it was made.

    Attributes:
        table: the blur table, with a kernel for each colour if the captures have colours.
        fits: one for each pair, by increasing distance; of the mean of the colours.
        coc_px: signed circle of confusion of each pair, px of the frame.
        why: reason for the family.
        scale: source of the circles of confusion: "camera" or "measured".
        colours: fits of "red", "green" and "blue".
    """

    table: BlurTable
    fits: tuple[BlurFit, ...]
    coc_px: tuple[float, ...]
    why: str
    scale: str
    colours: Mapping[str, tuple[BlurFit, ...]] = field(default_factory=dict)


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

    Args:
        captures: pairs at increasing distances; with colours, each colour is fitted like their mean.
        family: "auto" uses the cheapest family that is accurate enough at every distance; or a family of `fit_pair`.
            "polygon" and "image" use one opening, rotated by half a turn in front of the focus, in different sizes.
        accuracy_db: accuracy for "auto", see `fit_pair`.
        progress: called with (number done, total, text) after each fit.
        command: recorded in the table's provenance.
        scale_of: the fit of another dot in the same photographs; gives the circles of confusion of an unknown camera.

    Raises:
        FitError: a pair cannot be fitted (the message names its file), or, of kind "camera", the fitted blur is far
        from the camera's numbers. Doubtful results give a `FitWarning`.
    """
    if not isinstance(captures, Captures):
        raise FitError(f"captures must be a Captures(pairs, focus_m=..., width_px=...), got {show(captures)}")
    checked(choice, "family", family, ("auto", *SHAPES))
    pairs, done = captures.pairs, count(1)
    total = len(pairs) * (2 if family in ("auto", *OPENINGS) else 1)

    def report(pair: Capture) -> None:
        if progress:
            progress(next(done), total, f"{pair.distance_m:g} m")

    family, why, opening = _chosen(captures, family, accuracy_db, report)
    fits = _fits(captures, family, opening, report)
    radius_px = np.array([f.radius for f in fits])
    check_agreement(captures, radius_px)
    coc_px, scale = _coc_px(captures, radius_px, scale_of)
    if len(pairs) == 1:
        text = f"one distance was measured ({pairs[0].distance_m:g} m); the thin lens scales it to all others"
        warn(text, "single distance", pairs[0].files[1])
    params, colours = _params(fits, family), dict[str, tuple[BlurFit, ...]]()
    if all(pair.colours is not None for pair in pairs):
        by_pair = [_fit_colours(pair, captures.focus_m, fit) for pair, fit in zip(pairs, fits, strict=True)]
        colours = dict(zip(("red", "green", "blue"), zip(*by_pair, strict=True), strict=True))
        colour_params = [_params(colour_fits, family) for colour_fits in colours.values()]
        params = {n: np.stack([p[n] for p in colour_params]) for n in params}
    sensor = captures.sensor_width_mm
    unit = captures.width_px if sensor is None else captures.width_px / sensor
    made = {"coc_from": scale, "family_because": why, "command": command}
    table = BlurTable(
        family if opening is None else "disc",
        (coc_px / unit).tolist(),
        {k: (v / unit if k in LENGTHS else v).tolist() for k, v in params.items()},
        unit="fraction" if sensor is None else "mm",
        sensor_width_mm=sensor,
        name=captures.name,
        provenance=_provenance(captures, fits) | made | ({"colours": list(colours)} if colours else {}),
        residual=[round(f.residual, 6) for f in fits],
        aperture=opening,
    )
    return TableFit(table, tuple(fits), tuple(coc_px.tolist()), why, scale, colours)


def _chosen(captures: Captures, family: str, accuracy_db: float, report: Report) -> tuple[str, str, Aperture | None]:
    """The family for all distances, why it was chosen, and the opening as seen from behind the focus, if it has one."""
    why = f"family {family!r} was asked for"
    if family not in ("auto", *OPENINGS):
        return family, why, None
    focus, pairs, first_fits = captures.focus_m, captures.pairs, list[BlurFit]()
    for pair in pairs:  # each alone determines the family or the opening; the final fits warn
        with without_warnings():
            first_fits.append(_fit_one(pair, focus, family, accuracy_db=accuracy_db))
        report(pair)
    if family == "auto":
        # the richest family needed at any distance is used for all
        richest = max(range(len(pairs)), key=lambda i: _BY_COST.index(first_fits[i].family))
        family = first_fits[richest].family
        why = f"{family}, for {pairs[richest].distance_m:g} m: {first_fits[richest].why}"
    if family not in OPENINGS:
        return family, why, None
    openings = [(fit, pair) for fit, pair in zip(first_fits, pairs, strict=True) if fit.family == family]
    largest, pair = max(openings, key=lambda one: one[0].radius)
    return family, why, _seen(largest.aperture or Aperture(), pair, focus)


def _fits(captures: Captures, family: str, opening: Aperture | None, report: Report) -> list[BlurFit]:
    """The fit of each distance, from the largest blur to the smallest: each expects the shape of the one before."""
    focus, fit_of = captures.focus_m, dict[int, BlurFit]()
    larger = dict[bool, BlurFit]()  # the next larger blur on each side of focus
    for i in np.argsort(-np.abs(captures.defocus)).tolist():
        pair, side = captures.pairs[i], bool(captures.defocus[i] > 0)
        aperture = None if opening is None else _seen(opening, pair, focus)
        name = family if aperture is None else "image"
        fit = _fit_one(pair, focus, name, aperture=aperture, like=larger.get(side))
        fit = replace(fit, family=family)
        ratio = 1.0 if pair.exposure is None or not fit.gain > 0 else fit.gain / pair.exposure
        if max(ratio, 1 / ratio) > _MAX_EXPOSURE_RATIO:
            text = f"the blurred dot is {ratio:.2f} times as bright as the exposures say; did the light stay the same?"
            warn(text, "exposure", pair.files[1])
        fit_of[i] = larger[side] = _with_uncertainty(pair, focus, fit)
        report(pair)
    return [fit_of[i] for i in range(len(captures.pairs))]


def _coc_px(captures: Captures, radius_px: Array, scale_of: TableFit | None) -> tuple[Array, str]:
    """Signed circles of confusion of the distances, and where their scale comes from."""
    if captures.promised_px is not None:
        return captures.promised_px, "camera"
    if scale_of is not None:
        return np.array(scale_of.coc_px), scale_of.scale
    defocus = captures.defocus
    return float(np.abs(defocus) @ radius_px / (defocus @ defocus)) * defocus, "measured"


def _provenance(captures: Captures, fits: Sequence[BlurFit]) -> dict[str, Any]:
    """What the table records of the photographs and their fits."""
    return {
        **{"source": "photographs of a dot", "date": datetime.date.today().isoformat(), "focus_m": captures.focus_m},
        **{"distances_m": captures.distances_m.tolist(), "width_px": captures.width_px},
        "residual_over_noise": [round(f.residual_over_noise, 3) for f in fits if math.isfinite(f.residual_over_noise)],
        "asymmetry": [round(f.asymmetry, 4) for f in fits],
        **captures.notes,
        **{name: getattr(captures, name) for name in CAMERA if getattr(captures, name) is not None},
    }


def check_agreement(captures: Captures, radius_px: Sequence[float] | Array) -> None:
    """Compares the fitted radius at each distance with the camera's, or without one with the other distances'."""
    measured, camera_px = np.asarray(radius_px, dtype=np.float64), captures.promised_px
    if camera_px is None:  # the scale is a median weighted by the defocus, so that one wrong distance has no effect
        defocus = np.abs(captures.defocus)
        order = np.argsort(measured / defocus)
        weight = np.cumsum(defocus[order])
        expected = defocus * (measured / defocus)[order][np.searchsorted(weight, 0.5 * weight[-1])]
    else:
        expected = np.abs(camera_px)
    is_large = np.maximum(expected, measured) > _MIN_BLUR_PX
    difference = np.maximum(np.abs(measured - expected) - 0.5, 0.0)  # half a pixel is for aberrations
    misfit = np.log1p(difference / np.maximum(np.minimum(measured, expected), 1e-9))
    misfit_log = float(np.max(misfit * is_large))
    # without a camera the scale is fitted to the distances themselves
    if int(is_large.sum()) < (3 if camera_px is None else 1) or misfit_log < _WARN_LOG:
        return
    ratios = measured / expected
    each = ", ".join(f"{ratio:.2f} at {d:g} m" for ratio, d in zip(ratios, captures.distances_m, strict=True))
    text = f"the blur's radius over the expected one is {each}: check the distance of a single odd one, the focus if "
    text += "near and far ones differ, and units, a crop (full_width_px) and the camera's numbers if all do"
    text += "" if camera_px is None else f"; without {', '.join(CAMERA)} the scale is measured"
    file = captures.pairs[int(np.argmax(np.where(is_large, np.abs(np.log(ratios)), 0.0)))].files[1]
    if misfit_log > _REFUSE_LOG:
        raise FitError(text, "camera", file)
    warn(text, "camera", file)


def _params(fits: Sequence[BlurFit], family: str) -> dict[str, Array]:
    """Parameters of a table of these fits, px: `[N]`, and `values` `[N, P]`."""
    names = ("radius",) if family in OPENINGS else FAMILIES[family]
    params = {n: np.array([f.params[n] for f in fits]) for n in names}
    if family == "radial":  # profiles relative to their radius change little over distance
        params["values"] *= params["radius"][:, None] ** 2
    return params


def _seen(opening: Aperture, pair: Capture, focus_m: float) -> Aperture:
    """The opening as seen behind the focus in a pair's picture, or the other way round: in front of it half a turn."""
    if pair.distance_m > focus_m:
        return opening
    if opening.mask is not None:
        return replace(opening, mask=opening.mask.flip(0, 1))
    return replace(opening, rotation_deg=float(opening.rotation_deg) + 180.0)


def _fit_one(pair: Capture, focus_m: float, family: str, **options: Any) -> BlurFit:
    """Fits one pair by `fit_pair`."""
    expected = {"magnification": focus_m / pair.distance_m, "knots": _KNOTS if family == "radial" else None}
    return fit_pair(pair.sharp, pair.blurred, family, white=pair.white, files=pair.files, **expected | options)


def _fit_like(fit: BlurFit, pair: Capture, focus_m: float, sharp: Array, blurred: Array, **options: Any) -> BlurFit:
    """Fits other pictures of a pair like its own: with the same family and opening, or free profile's end."""
    family = fit.family if fit.aperture is None else "image"
    options |= {"aperture": fit.aperture, "like": fit, "reach": fit.params["radius"] if family == "radial" else None}
    with without_warnings():  # the pair's own fit has already warned
        return _fit_one(replace(pair, sharp=sharp, blurred=blurred), focus_m, family, **options)


def _with_uncertainty(pair: Capture, focus_m: float, fit: BlurFit) -> BlurFit:
    """Adds the uncertainty of a pair's pictures (``pair.uncertain``) to the standard errors of its fit."""
    if not pair.uncertain:
        return fit
    others = [_fit_like(fit, pair, focus_m, *pictures) for pictures in pair.uncertain]
    names = ("values",) if fit.family == "radial" else fit.names
    values = [np.hstack([one.params.get(n, np.zeros(1)) for n in names]) for one in (fit, *others)]
    changes = np.array(values[1:]) - values[0]  # [others, parameters]
    covariance = fit.covariance + changes.T @ changes
    spread = np.sqrt(np.diag(covariance))
    errors = {"values": spread} if fit.family == "radial" else dict(zip(names, spread.tolist(), strict=True))
    stderr = fit.stderr | {n: error for n, error in errors.items() if n in fit.params}
    radius_stderr = float(np.hypot(fit.radius_stderr, np.linalg.norm([o.radius - fit.radius for o in others])))
    return replace(fit, stderr=stderr, covariance=covariance, radius_stderr=radius_stderr)


def _fit_colours(pair: Capture, focus_m: float, mean: BlurFit) -> list[BlurFit]:
    """Fits red, green and blue like their mean."""
    sharp_colours, blurred_colours = pair.colours or ((), ())
    # the sharpest colour's softness is used for all, so that each kernel contains all of its colour's blur
    softness = min(soft_edge(sharp, find_dot(sharp, file=pair.files[0])).softness for sharp in sharp_colours)
    fixed: dict[str, Any] = {"magnification": mean.magnification, "fit_magnification": False, "softness": softness}
    return [_fit_like(mean, pair, focus_m, *both, **fixed) for both in zip(sharp_colours, blurred_colours, strict=True)]
