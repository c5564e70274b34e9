"""The distances of one capture, fitted so that each informs its neighbours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from torchdof.optics.aperture import Aperture
from torchdof.optics.psf import FAMILIES, LENGTHS

from ..problems import unheard
from ..result import Array, BlurFit
from .captures import Capture, Captures
from .forward import OPENINGS
from .opening import common_opening, turned
from .pair import fit_pair

__all__ = ["counted", "fit_distances", "fit_one", "fit_openings"]

_KNOTS = 33  # values of a free profile, the same at all distances
_SWEEPS = 2


def fit_one(pair: Capture, focus_m: float, family: str, **known: Any) -> BlurFit:
    """Fit one pair, its size expected from the distances; `known` as `fit_pair` takes it."""
    expected = {"magnification": focus_m / pair.distance_m, "knots": _KNOTS if family == "radial" else None}
    return fit_pair(pair.sharp, pair.blurred, family, white=pair.white, files=pair.files, **{**expected, **known})


def fit_distances(
    captures: Captures, family: str, smooth: bool, done: Callable[[Capture, BlurFit], None]
) -> list[BlurFit]:
    """Fit all pairs with one family; `smooth` lets neighbouring distances inform each other after the first fits."""
    place, pairs = captures.defocus, captures.pairs
    fits: dict[int, BlurFit] = {}
    near = [i for i in range(len(pairs)) if place[i] < 0]
    far = [i for i in range(len(pairs)) if place[i] > 0][::-1]
    for side in (near, far):  # from both ends towards focus, each from its neighbour's fit
        before: int | None = None
        for i in side:
            start: BlurFit | None = None
            if before is not None:
                nearer = abs(place[i]) / abs(place[before])
                params = {n: v * nearer if n in LENGTHS else v for n, v in fits[before].params.items()}
                start = replace(fits[before], params=params)
            fits[i] = fit_one(pairs[i], captures.focus_m, family, start=start)
            done(pairs[i], fits[i])
            before = i
    if smooth:
        with unheard():
            (_refine_aligned if family == "radial" else _refine_together)(captures, family, fits)
    return [fits[i] for i in range(len(pairs))]


def _refine_together(captures: Captures, family: str, fits: dict[int, BlurFit]) -> None:
    """Fit every pair once more, expecting what its neighbours on the same side of focus say.

    Parameters that trade with each other (a rim's height and its steepness) are thus told alike at all distances,
    while what the pictures determine stays as they say: the expectation is loose.
    """
    place = captures.defocus
    for _ in range(_SWEEPS):
        for i in sorted(fits, key=lambda k: -abs(place[k])):
            side = [k for k in fits if place[k] * place[i] > 0]
            inner = max((k for k in side if abs(place[k]) < abs(place[i])), key=lambda k: abs(place[k]), default=None)
            outer = min((k for k in side if abs(place[k]) > abs(place[i])), key=lambda k: abs(place[k]), default=None)
            beside = [k for k in (inner, outer) if k is not None]
            if beside:
                neighbours = [fits[k] for k in beside]
                prior = {n: _expected(n, place[i], place[beside], fits[i], neighbours) for n in FAMILIES[family]}
                fits[i] = fit_one(captures.pairs[i], captures.focus_m, family, start=fits[i], prior=prior)


def _expected(name: str, place: float, beside: Array, fit: BlurFit, neighbours: list[BlurFit]) -> tuple[float, float]:
    """Value and standard deviation expected of a parameter: on the line between the neighbours, as the table has it."""
    values = [float(f.params[name]) for f in neighbours]
    if len(values) == 1:
        value = values[0] * (abs(place / beside[0]) if name in LENGTHS else 1.0)
    else:
        fraction = (place - beside[0]) / (beside[1] - beside[0])
        value = (1 - fraction) * values[0] + fraction * values[1]
    size = max(float(fit.params[n]) for n in fit.params if n in LENGTHS)
    loose = 3.0 if len(values) == 1 else 1.0
    return float(value), loose * {"b": 0.1, "m": 0.3}.get(name, 0.05 * size + 0.05)


def _refine_aligned(captures: Captures, family: str, fits: dict[int, BlurFit]) -> None:
    """Fit free profiles once more, each up to a radius on one line over the circle of confusion.

    Between nodes a table mixes values at equal shares of the radius: shapes are alike there only if the radii follow
    one rule.
    """
    place = captures.defocus
    for sign in (-1, 1):
        side = [i for i in fits if place[i] * sign > 0]
        if len(side) < 2:
            continue
        x, ends = np.abs(place[side]), np.array([_end(fits[i]) for i in side])
        # near focus a profile may have any end: the outer nodes set the line, which is lifted to hold theirs
        slope, start = np.polyfit(x, ends, 1, w=x)
        lift = max(float(np.max((ends - slope * x - start)[x > 0.25 * x.max()])), 0.0)
        for i, defocus, end in zip(side, x, ends, strict=True):
            reach = max(float(slope * defocus + start + lift), float(end), 1.0)
            fits[i] = fit_one(captures.pairs[i], captures.focus_m, family, start=fits[i], reach=reach)


def _end(fit: BlurFit) -> float:
    """Radius in px that holds all but a thousandth of a free profile's light."""
    values, radius = np.asarray(fit.params["values"]), float(fit.params["radius"])
    r = np.linspace(0, radius, 1001)
    light = np.cumsum(np.interp(r, np.linspace(0, radius, values.size), values) * r)
    return float(r[np.searchsorted(light, 0.999 * light[-1])]) + radius / (values.size - 1)


def fit_openings(
    captures: Captures, family: str, firsts: list[BlurFit], done: Callable[[Capture, BlurFit], None]
) -> tuple[list[BlurFit], Aperture]:
    """Fit all pairs with kernels that are not round, those of one opening in as many sizes.

    The first fits of `family` ("polygon" or "image") tell the opening, which is given as it shows behind the focus.
    """
    nearer = [pair.distance_m < captures.focus_m for pair in captures]
    telling = [i for i, fit in enumerate(firsts) if fit.family == family]
    opening = common_opening([firsts[i] for i in telling], [nearer[i] for i in telling])
    shown = turned(opening)
    fits = []
    for pair, near in zip(captures, nearer, strict=True):
        fit = fit_one(pair, captures.focus_m, "image", aperture=shown if near else opening)
        fits.append(replace(fit, family=family))
        done(pair, fits[-1])
    return fits, opening


def counted(pair: Capture, focus_m: float, fit: BlurFit) -> BlurFit:
    """A fit whose standard errors also count what was guessed about its pictures."""
    if not pair.uncertain:
        return fit
    family, start = ("image", None) if fit.family in OPENINGS else (fit.family, fit)
    reach = float(fit.params["radius"]) if family == "radial" else None
    with unheard():
        plain, *others = (
            fit_one(
                replace(pair, sharp=sharp, blurred=blurred),
                focus_m,
                family,
                start=start,
                reach=reach,
                aperture=fit.aperture,
            )
            for sharp, blurred in ((pair.sharp, pair.blurred), *pair.uncertain)
        )
    changes = {n: np.stack([np.subtract(o.params[n], plain.params[n]) for o in others]) for n in plain.params}
    apart = np.linalg.norm([o.radius - plain.radius for o in others])
    along = np.stack([changes[n] if n in changes else np.zeros(len(others)) for n in fit.names], axis=-1)
    along = changes["values"] if family == "radial" else along  # [others, parameters]
    return replace(
        fit,
        stderr={
            n: np.hypot(e, np.linalg.norm(changes[n], axis=0)) if n in changes else e for n, e in fit.stderr.items()
        },
        covariance=fit.covariance + along.T @ along,
        radius_stderr=float(np.hypot(fit.radius_stderr, apart)),
    )
