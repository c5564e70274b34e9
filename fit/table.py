"""Fits at several distances to one blur table, keyed by the signed circle of confusion, smooth between its nodes."""

from __future__ import annotations

import datetime
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from torchdof import BlurTable, Camera
from torchdof.kernel import FAMILIES, LENGTHS, profile, support

from .capture import Capture, Captures
from .choose import COST
from .pair import fit_pair
from .problems import ExposureWarning, FitError, FitWarning, SingleDistanceWarning, warn
from .result import Array, BlurFit
from .scale import signed_coc

__all__ = ["TableFit", "fit_captures", "fit_table"]

_KNOTS = 33
_EXPOSED = 1.3
_SWEEPS = 2


@dataclass(frozen=True)
class TableFit:
    """A table and the fits it was made of.

    Attributes:
        table: the blur table.
        fits: one for each pair, by increasing distance.
        coc_px: signed circle of confusion of each, px of the frame.
        why: how the family was chosen.
        scale: where the circles of confusion come from: "camera" or "measured".
    """

    table: BlurTable
    fits: tuple[BlurFit, ...]
    coc_px: tuple[float, ...]
    why: str
    scale: str


def fit_table(captures: Captures | Sequence[Capture], family: str = "auto", **options: Any) -> BlurTable:
    """The blur table of a camera from photographs of a dot at one or more distances: `fit_captures(...).table`.

    Args:
        captures: from `read_captures`, or made of arrays.
        family: "auto", or one of `torchdof.kernel.FAMILIES`.
        **options: see `fit_captures`.

    Returns:
        A table in mm of the sensor where its width is known, else in fractions of the frame's width.

    Raises:
        FitError: see `fit_captures`.
    """
    if not isinstance(captures, Captures):
        raise FitError(
            "captures must be a Captures(pairs, focus_m=..., width_px=...), which knows the focus and the frame's "
            f"width; got {type(captures).__name__}"
        )
    return fit_captures(captures, family, **options).table


def fit_captures(
    captures: Captures,
    family: str = "auto",
    *,
    accuracy_db: float = 45.0,
    smooth: bool = True,
    progress: Callable[[int, int, str], None] | None = None,
    command: str = "torchdof.fit.fit_table",
) -> TableFit:
    """Fit every distance and join the fits.

    Nodes are keyed by the thin lens's signed circle of confusion at their distance. Where focal length and f-number
    are known it is the camera's; else its scale is measured: the radius of the uniform disc with the fitted kernels'
    second moment, by least squares over all distances.

    Each fit starts from its outer neighbour's, scaled by geometry, from both ends towards focus, and leaves that
    branch only where the pictures clearly ask for it. Then all are fitted once more, each loosely expecting what lies on
    the line between its neighbours (not those of `radial`, which are smoothed over r).

    Args:
        captures: pairs at increasing distances.
        family: "auto" takes the cheapest family that is enough at every distance; or one of the families.
        accuracy_db: what "auto" asks for, see `fit_pair`.
        smooth: whether neighbouring distances inform each other.
        progress: called with (done, all, what) after each fit.
        command: recorded in the table's provenance.

    Returns:
        The table and its fits.

    Raises:
        FitError: a pair cannot be fitted; the message names its file.

    Warns:
        SingleDistanceWarning: one distance only; the thin lens scales it.
        ExposureWarning: a fitted gain contradicts the stated exposures.
        FitWarning: what `fit_pair` warns about.
    """
    pairs = list(captures)
    total, done = len(pairs) * (2 if family == "auto" else 1), 0
    why = f"family {family!r} was asked for"
    if family == "auto":
        family, why = _choose(pairs, captures.focus_m, accuracy_db, progress, total)
        done = len(pairs)
    fits: dict[int, BlurFit] = {}
    for i, before in _towards_focus([p.distance_m for p in pairs], captures.focus_m):
        start = _scaled(fits[before], pairs[before], pairs[i], captures.focus_m) if before is not None else None
        pair = pairs[i]
        fits[i] = _fit(pair, captures.focus_m, family, start)
        _check_exposure(pair, fits[i])
        done += 1
        if progress:
            progress(done, total, f"{pair.distance_m:g} m")
    if smooth and family != "radial":
        fits = _together(pairs, captures.focus_m, family, fits)
    ordered = [fits[i] for i in range(len(pairs))]
    coc_px, scale = _keys(captures, ordered)
    params = _nodes(ordered, family)
    if len(pairs) == 1:
        text = (
            f"one distance was measured ({pairs[0].distance_m:g} m); the thin lens scales it to all others, and the "
            "other side of focus mirrors it"
        )
        warn(SingleDistanceWarning(text, file=pairs[0].files[1], number=pairs[0].distance_m))
    return TableFit(
        table=_table(captures, ordered, coc_px, params, family, scale, command, why),
        fits=tuple(ordered),
        coc_px=tuple(coc_px),
        why=why,
        scale=scale,
    )


def _choose(
    pairs: list[Capture],
    focus_m: float,
    accuracy_db: float,
    progress: Callable[[int, int, str], None] | None,
    total: int,
) -> tuple[str, str]:
    worst = 0
    why = ""
    for i, pair in enumerate(pairs):
        fit = _fit(pair, focus_m, "auto", None, accuracy_db)
        # the richest family that any distance needs serves all
        if not why or COST.index(fit.family) > worst:
            worst, why = COST.index(fit.family), f"{fit.family}, for {pair.distance_m:g} m: {fit.why}"
        if progress:
            progress(i + 1, total, f"{pair.distance_m:g} m")
    return COST[worst], why


def _fit(
    pair: Capture,
    focus_m: float,
    family: str,
    start: BlurFit | None,
    accuracy_db: float = 45.0,
    prior: dict[str, tuple[float, float]] | None = None,
) -> BlurFit:
    return fit_pair(
        pair.sharp,
        pair.blurred,
        family,
        accuracy_db=accuracy_db,
        magnification=focus_m / pair.distance_m,
        white=pair.white,
        start=start,
        prior=prior,
        knots=_KNOTS if family == "radial" else None,
        files=pair.files,
    )


def _towards_focus(distances: list[float], focus_m: float) -> list[tuple[int, int | None]]:
    """Indices from both ends towards focus, each with the neighbour it starts from."""
    near = [i for i, d in enumerate(distances) if d < focus_m]
    far = [i for i, d in enumerate(distances) if d > focus_m][::-1]
    return [(i, side[k - 1] if k else None) for side in (near, far) for k, i in enumerate(side)]


def _scaled(fit: BlurFit, before: Capture, after: Capture, focus_m: float) -> BlurFit:
    ratio = abs(1 / focus_m - 1 / after.distance_m) / abs(1 / focus_m - 1 / before.distance_m)
    params = {k: v * ratio if k in LENGTHS else v for k, v in fit.params.items()}
    return replace(fit, params=params)


def _check_exposure(pair: Capture, fit: BlurFit) -> None:
    if pair.exposure is None or not fit.gain > 0:
        return
    off = fit.gain / pair.exposure
    if max(off, 1 / off) > _EXPOSED:
        text = (
            f"the blurred dot is {off:.2f} times as bright as the exposures say; is the image linear, and did the "
            "light stay the same?"
        )
        warn(ExposureWarning(text, file=pair.files[1], number=off), stacklevel=4)


def _keys(captures: Captures, fits: list[BlurFit]) -> tuple[list[float], str]:
    """Signed circle of confusion of each pair in px of the frame."""
    if captures.focal_length_mm is not None and captures.f_number is not None and captures.sensor_width_mm is not None:
        camera = Camera(
            focal_length_mm=captures.focal_length_mm,
            f_number=captures.f_number,
            focus_m=captures.focus_m,
            sensor_width_mm=captures.sensor_width_mm,
        )
        return [signed_coc(camera, p.distance_m, captures.width_px) for p in captures], "camera"
    vergence = np.array([1 / captures.focus_m - 1 / p.distance_m for p in captures])
    size = np.array([math.sqrt(2) * rms_radius(f) for f in fits])
    factor = float(np.abs(vergence) @ size / (vergence @ vergence))
    return [float(factor * v) for v in vergence], "measured"


def rms_radius(fit: BlurFit) -> float:
    """Root of a kernel's mean squared radius, in the fit's unit; over a uniform disc it is its radius / sqrt(2)."""
    given = {k: torch.as_tensor(v, dtype=torch.float64) for k, v in fit.kernel_params().items()}
    r = np.linspace(0, support(fit.family, given) + 1e-9, 4001)
    f = profile(fit.family, torch.from_numpy(r), given).numpy()
    return float(np.sqrt((f * r**3).sum() / (f * r).sum()))


def _together(pairs: list[Capture], focus_m: float, family: str, fits: dict[int, BlurFit]) -> dict[int, BlurFit]:
    """Fit every pair once more, expecting what its neighbours on the same side of focus say.

    Parameters that trade with each other (a rim's height and its steepness) are thus told alike at all distances,
    while what the pictures determine stays as they say: the expectation is loose.
    """
    place = np.array([1 / focus_m - 1 / p.distance_m for p in pairs])
    fits = dict(fits)
    for _ in range(_SWEEPS):
        for i in sorted(fits, key=lambda k: -abs(place[k])):
            sides = [k for k in fits if place[k] * place[i] > 0]
            lower = [k for k in sides if abs(place[k]) < abs(place[i])]
            upper = [k for k in sides if abs(place[k]) > abs(place[i])]
            inner = max(lower, key=lambda k: abs(place[k]), default=None)
            outer = min(upper, key=lambda k: abs(place[k]), default=None)
            if outer is None and inner is None:
                continue
            prior = {n: _expected(n, i, inner, outer, place, fits) for n in FAMILIES[family]}
            with warnings.catch_warnings():
                # the first fit of this pair has said it
                warnings.simplefilter("ignore", FitWarning)
                fits[i] = _fit(pairs[i], focus_m, family, fits[i], prior=prior)
    return fits


def _expected(
    name: str, i: int, inner: int | None, outer: int | None, place: Array, fits: dict[int, BlurFit]
) -> tuple[float, float]:
    """Value and standard deviation expected of a parameter: on the line between the neighbours, as the table has it."""
    length = name in LENGTHS
    if inner is None or outer is None:
        only = outer if inner is None else inner
        value = float(fits[only].params[name]) * (abs(place[i] / place[only]) if length else 1.0)  # type: ignore[index]
        loose = 3.0
    else:
        share = (place[i] - place[inner]) / (place[outer] - place[inner])
        value = float((1 - share) * fits[inner].params[name] + share * fits[outer].params[name])
        loose = 1.0
    size = max(float(fits[i].params[n]) for n in fits[i].params if n in LENGTHS)
    deviation = {"b": 0.1, "m": 0.3}.get(name, 0.05 * size + 0.05)
    return value, loose * deviation


def _nodes(fits: list[BlurFit], family: str) -> dict[str, Array]:
    """Parameters at the nodes in px: `[n]`, "values" `[n, knots]`."""
    if family == "radial":
        return _radial_nodes(fits)
    return {n: np.array([float(f.params[n]) for f in fits]) for n in FAMILIES[family]}


def _radial_nodes(fits: list[BlurFit]) -> dict[str, Array]:
    """Free profiles, each as smooth over r as its own data ask; relative to their radius they hardly change."""
    radius = np.array([float(f.params["radius"]) for f in fits])
    values = np.stack([np.asarray(f.params["values"]) for f in fits]) * radius[:, None] ** 2
    return {"values": values, "radius": radius}


def _table(
    captures: Captures,
    fits: list[BlurFit],
    coc_px: list[float],
    params: dict[str, Array],
    family: str,
    scale: str,
    command: str,
    why: str,
) -> BlurTable:
    sensor = captures.sensor_width_mm
    unit = captures.width_px if sensor is None else captures.width_px / sensor
    provenance = {
        "source": "photographs of a dot",
        "date": datetime.date.today().isoformat(),
        "command": command,
        "focus_m": captures.focus_m,
        "distances_m": [p.distance_m for p in captures],
        "coc_from": scale,
        "width_px": captures.width_px,
        "family_because": why,
        "residual_over_noise": [round(f.residual_over_noise, 3) for f in fits if math.isfinite(f.residual_over_noise)],
        "asymmetry": [round(f.asymmetry, 4) for f in fits],
        **dict(captures.notes),
    }
    for name in ("focal_length_mm", "f_number", "sensor_width_mm"):
        if getattr(captures, name) is not None:
            provenance[name] = getattr(captures, name)
    return BlurTable(
        family,
        [c / unit for c in coc_px],
        {k: (v / unit if k in LENGTHS else v).tolist() for k, v in params.items()},
        unit="fraction" if sensor is None else "mm",
        sensor_width_mm=sensor,
        name=captures.name,
        provenance=provenance,
        residual=[round(f.residual, 6) for f in fits],
    )
