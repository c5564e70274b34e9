"""The distances of one capture, fitted so that each informs its neighbours."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from torchdof.optics.aperture import Aperture
from torchdof.optics.psf import FAMILIES, LENGTHS

from ..problems import FitWarning
from ..result import Array, BlurFit
from .forward import OPENINGS
from .manifest import Capture
from .opening import common_opening, turned
from .pair import fit_pair

__all__ = ["KNOTS", "counted", "fit_distances", "fit_one", "fit_openings"]

KNOTS = 33
"""Values of a free profile, the same at all distances."""

_SWEEPS = 2


def fit_distances(
    pairs: list[Capture],
    focus_m: float,
    family: str,
    smooth: bool,
    done: Callable[[Capture, BlurFit], None],
) -> list[BlurFit]:
    """Fit all pairs with one family.

    Args:
        pairs: by increasing distance.
        focus_m: distance of the focus.
        family: of the kernel.
        smooth: whether neighbouring distances inform each other after the first fits.
        done: called after each first fit.

    Returns:
        One fit a pair.
    """
    fits: dict[int, BlurFit] = {}
    near = [i for i, pair in enumerate(pairs) if pair.distance_m < focus_m]
    far = [i for i, pair in enumerate(pairs) if pair.distance_m > focus_m][::-1]
    for side in (near, far):  # from both ends towards focus, each from its neighbour's fit
        start = None
        for k, i in enumerate(side):
            if start is not None:
                before, after = (abs(1 / focus_m - 1 / pairs[j].distance_m) for j in (side[k - 1], i))
                params = {n: v * after / before if n in LENGTHS else v for n, v in start.params.items()}
                start = replace(start, params=params)
            start = fits[i] = fit_one(pairs[i], focus_m, family, start)
            done(pairs[i], fits[i])
    if smooth:
        refine = _refine_aligned if family == "radial" else _refine_together
        fits = refine(pairs, focus_m, family, fits)
    return [fits[i] for i in range(len(pairs))]


def fit_one(
    pair: Capture,
    focus_m: float,
    family: str,
    start: BlurFit | None,
    accuracy_db: float = 45.0,
    prior: dict[str, tuple[float, float]] | None = None,
    reach: float | None = None,
    aperture: Aperture | None = None,
) -> BlurFit:
    """Fit one pair, its size expected from the distances."""
    return fit_pair(
        pair.sharp,
        pair.blurred,
        family,
        accuracy_db=accuracy_db,
        magnification=focus_m / pair.distance_m,
        white=pair.white,
        start=start,
        prior=prior,
        knots=KNOTS if family == "radial" else None,
        reach=reach,
        aperture=aperture,
        files=pair.files,
    )


def counted(pair: Capture, focus_m: float, fit: BlurFit) -> BlurFit:
    """A fit whose standard errors also count what was guessed about its pictures."""
    if not pair.uncertain:
        return fit
    family = "image" if fit.family in OPENINGS else fit.family
    reach = float(fit.params["radius"]) if family == "radial" else None

    def again(sharp: Array, blurred: Array) -> BlurFit:
        start = None if family == "image" else fit
        return fit_one(
            replace(pair, sharp=sharp, blurred=blurred), focus_m, family, start, 45.0, None, reach, fit.aperture
        )

    with warnings.catch_warnings():
        # the fit of the pictures as they are has said it
        warnings.simplefilter("ignore", FitWarning)
        plain = again(pair.sharp, pair.blurred)
        others = [again(*pictures) for pictures in pair.uncertain]
    changes = {n: np.stack([np.subtract(o.params[n], plain.params[n]) for o in others]) for n in plain.params}
    apart = np.linalg.norm([o.radius - plain.radius for o in others])
    along = np.stack([changes[n] if n in changes else np.zeros(len(others)) for n in fit.names])
    return replace(
        fit,
        stderr={
            n: np.hypot(e, np.linalg.norm(changes[n], axis=0)) if n in changes else e for n, e in fit.stderr.items()
        },
        covariance=fit.covariance
        + (along @ along.T if family != "radial" else changes["values"].T @ changes["values"]),
        radius_stderr=float(np.hypot(fit.radius_stderr, apart)),
    )


def fit_openings(
    pairs: list[Capture],
    focus_m: float,
    family: str,
    firsts: list[BlurFit],
    done: Callable[[Capture, BlurFit], None],
) -> tuple[list[BlurFit], Aperture]:
    """Fit all pairs with kernels that are not round, those of one opening in as many sizes.

    Args:
        pairs: by increasing distance.
        focus_m: distance of the focus.
        family: "polygon" or "image".
        firsts: a fit of each pair with any family; those of `family` tell the opening.
        done: called after each fit.

    Returns:
        One fit a pair, and the opening as it shows behind the focus.
    """
    nearer = [pair.distance_m < focus_m for pair in pairs]
    telling = [i for i, fit in enumerate(firsts) if fit.family == family]
    opening = common_opening([firsts[i] for i in telling], [nearer[i] for i in telling])
    shown = turned(opening)
    fits = []
    for pair, near in zip(pairs, nearer, strict=True):
        fit = fit_one(pair, focus_m, "image", None, aperture=shown if near else opening)
        fits.append(replace(fit, family=family))
        done(pair, fits[-1])
    return fits, opening


def _refine_together(pairs: list[Capture], focus_m: float, family: str, fits: dict[int, BlurFit]) -> dict[int, BlurFit]:
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
                fits[i] = fit_one(pairs[i], focus_m, family, fits[i], prior=prior)
    return fits


def _refine_aligned(pairs: list[Capture], focus_m: float, family: str, fits: dict[int, BlurFit]) -> dict[int, BlurFit]:
    """Fit free profiles once more, each up to a radius on one line over the circle of confusion.

    Between nodes a table mixes values at equal shares of the radius: shapes are alike there only if the radii follow
    one rule.
    """
    place = np.array([1 / focus_m - 1 / p.distance_m for p in pairs])
    fits = dict(fits)
    for sign in (-1, 1):
        side = [i for i in fits if place[i] * sign > 0]
        if len(side) < 2:
            continue
        x, ends = np.abs(place[side]), np.array([_end(fits[i]) for i in side])
        # near focus a profile may have any end: the outer nodes set the line, which is lifted to hold theirs
        slope, start = np.polyfit(x, ends, 1, w=x)
        lift = max(float(np.max((ends - slope * x - start)[x > 0.25 * x.max()])), 0.0)
        for i, defocus, end in zip(side, x, ends, strict=True):
            with warnings.catch_warnings():
                # the first fit of this pair has said it
                warnings.simplefilter("ignore", FitWarning)
                reach = max(float(slope * defocus + start + lift), float(end), 1.0)
                fits[i] = fit_one(pairs[i], focus_m, family, fits[i], reach=reach)
    return fits


def _end(fit: BlurFit) -> float:
    """Radius in px that holds all but a thousandth of a free profile's light."""
    values, radius = np.asarray(fit.params["values"]), float(fit.params["radius"])
    r = np.linspace(0, radius, 1001)
    light = np.cumsum(np.interp(r, np.linspace(0, radius, values.size), values) * r)
    return float(r[np.searchsorted(light, 0.999 * light[-1])]) + radius / (values.size - 1)


def _expected(
    name: str, i: int, inner: int | None, outer: int | None, place: Array, fits: dict[int, BlurFit]
) -> tuple[float, float]:
    """Value and standard deviation expected of a parameter: on the line between the neighbours, as the table has it."""
    length = name in LENGTHS
    if inner is None or outer is None:
        neighbour = outer if inner is None else inner
        value = float(fits[neighbour].params[name]) * (abs(place[i] / place[neighbour]) if length else 1.0)  # type: ignore[index]
        loose = 3.0
    else:
        fraction = (place[i] - place[inner]) / (place[outer] - place[inner])
        value = float((1 - fraction) * fits[inner].params[name] + fraction * fits[outer].params[name])
        loose = 1.0
    size = max(float(fits[i].params[n]) for n in fits[i].params if n in LENGTHS)
    deviation = {"b": 0.1, "m": 0.3}.get(name, 0.05 * size + 0.05)
    return value, loose * deviation
