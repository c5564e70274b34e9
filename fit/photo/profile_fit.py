"""Eq. (1) of the paper, and the other families, fitted to samples of blur strength over radius."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike

from torchdof.optics.psf import FAMILIES, profile
from torchdof.validation import show

from ..problems import BoundaryWarning, FitError, FlatProfileError, FlatProfileWarning, NonFiniteError, warn
from ..result import Array, BlurFit
from ..solve import best_of, information_criterion
from ..validation import a_count

__all__ = ["fit_profile"]

_ORDER = {"gaussian": ("N", "sigma"), "ring": ("N", "r_c", "sigma"), "softm": ("N", "radius", "sigma", "b", "m")}
_LENGTHS = ("r_c", "sigma", "radius")
# in units of the largest r; N in units of the largest strength
_BOUNDS = {
    "N": (0.0, np.inf),
    "r_c": (0.0, 3.0),
    "sigma": (1e-3, 30.0),
    "radius": (1e-2, 3.0),
    "b": (-1.0, 20.0),
    "m": (0.5, 12.0),
}
_BENT = 8.0
_SMALLEST, _LARGEST = 1e-60, 1e60  # their squares enter the covariance
_STARTS: dict[str, list[list[float]]] = {
    "gaussian": [[1.0, 0.2], [1.0, 0.5], [1.0, 1.5]],
    "ring": [[1.0, 0.05, 0.3], [1.0, 0.5, 0.2], [1.0, 0.1, 1.0]],
    "softm": [[1.0, 0.5, 0.1, 0.0, 2.0], [1.0, 0.9, 0.1, 0.0, 4.0], [1.0, 0.3, 0.1, 0.5, 2.0]],
}


def fit_profile(
    r: ArrayLike,
    strength: ArrayLike,
    family: str = "ring",
    *,
    groups: ArrayLike | None = None,
    knots: int | None = None,
) -> BlurFit:
    """Fit `f(r) = N exp(-(r - r_c)^2 / (2 sigma^2))`, or another family times N, to samples of blur strength.

    Radii may be in any unit (the paper's are metres on the paper): they are normalised inside, and the lengths among
    the parameters come back in the caller's unit.

    Args:
        r: distance from the dot's centre `[n]`, >= 0.
        strength: blur strength `[n]`, in any positive unit.
        family: "gaussian", "ring" (the paper's), "disc", "softm" or "radial" (a non-negative table over r).
        groups: which samples have errors in common `[n]` integers (the spoke a sample lies on); the standard errors
            then allow for it. None takes every sample as independent.
        knots: number of radii of a "radial" table; None chooses from the number of samples.

    Returns:
        A `BlurFit` with the family's parameters and "N".

    Raises:
        FitError: wrong shapes, too few samples, negative radii, unknown family.
        NonFiniteError: NaN or infinity among the samples.
        FlatProfileError: the strength does not vary beyond its noise, so nothing fixes a width.
        NotConvergedError: no start converged.

    Warns:
        FlatProfileWarning: a parameter is not determined by the samples.
        BoundaryWarning: a parameter ended on its bound.

    Reference:
        Sato, Dobashi, Yamamoto, eq. (1): N -> "N", r_c -> "r_c", sigma -> "sigma" (the paper prints sigma^2).

    Example:
        >>> import numpy as np
        >>> r = np.linspace(0, 5e-3, 50)
        >>> fit = fit_profile(r, 0.58 * np.exp(-((r - 4e-4) ** 2) / (2 * 2e-3**2)))
        >>> f"{fit.params['sigma']:.6f} {fit.params['r_c']:.6f} {fit.params['N']:.4f}"
        '0.002000 0.000400 0.5800'
    """
    radii, values = _checked(r, strength, family)
    clusters = None if groups is None else _checked_groups(groups, radii.size)
    if knots is not None:
        a_count("knots", knots, 2, 10_000)
    order = np.argsort(radii, kind="stable")
    unit, peak = float(radii.max()), float(np.abs(values).max())
    x, y = radii[order] / unit, values[order] / peak
    # from differences of neighbours in r: what no smooth curve can explain
    noise = float(np.sqrt(np.mean((y[2:] - 2 * y[1:-1] + y[:-2]) ** 2) / 6.0))
    _refuse_flat(x, y, noise)
    if family == "radial":
        params, covariance, names, curve = _fit_radial(x, y, knots)
    elif family == "disc":
        params, covariance, names, curve = _fit_disc(x, y)
    else:
        params, covariance, names, curve = _fit_smooth(x, y, family, None if clusters is None else clusters[order])
    squares = float(np.sum((y - curve) ** 2))
    scale = np.array([unit if n in _LENGTHS else peak if n == "N" or n.startswith("values") else 1.0 for n in names])
    covariance = covariance * np.outer(scale, scale)
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    real: dict[str, float | Array] = {"values": params * scale, "radius": unit}
    stderr: dict[str, float | Array] = {"values": spread, "radius": 0.0}
    if family != "radial":
        real = {name: float(value) for name, value in zip(names, params * scale, strict=True)}
        stderr = {name: float(error) for name, error in zip(names, spread, strict=True)}
    line = np.linspace(0.0, unit, 257)
    fit = BlurFit(
        family=family,
        params=real,
        stderr=stderr,
        residual=float(np.sqrt(squares / np.sum(y**2))),
        noise=float(noise * np.sqrt(y.size / np.sum(y**2))),
        covariance=covariance,
        names=names,
        bic=information_criterion(squares, y.size, len(names)),
        count=y.size,
        model="profile",
        samples=np.stack([radii, values]),
        curve=np.stack([line, evaluate(family, line, real)]),
    )
    if family in _ORDER:
        _warn_if_undetermined(fit, unit)
    return fit


def evaluate(family: str, r: Array, params: dict[str, float | Array]) -> Array:
    """`N f(r)` of a profile fit at radii `[n]`, N = 1 where there is none."""
    shape = {k: torch.as_tensor(v, dtype=torch.float64) for k, v in params.items() if k != "N"}
    strength = float(params.get("N", 1.0))
    return strength * profile(family, torch.from_numpy(np.ascontiguousarray(r)), shape).numpy()


def _checked(r: ArrayLike, strength: ArrayLike, family: str) -> tuple[Array, Array]:
    """Radii and strengths `[n]` as float64, or a refusal that says what is wrong with them."""
    if not isinstance(family, str) or family not in FAMILIES:
        raise FitError(f"family must be one of {', '.join(FAMILIES)}, got {show(family)}")
    try:
        if np.iscomplexobj(r) or np.iscomplexobj(strength):
            raise TypeError
        radii, values = np.asarray(r, dtype=np.float64), np.asarray(strength, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise FitError("r and strength must be numbers, one strength for each radius") from None
    if radii.ndim != 1 or radii.shape != values.shape:
        raise FitError(f"r and strength must both be [n], got {list(radii.shape)} and {list(values.shape)}")
    bad = int(np.sum(~np.isfinite(radii) | ~np.isfinite(values)))
    if bad:
        raise NonFiniteError(f"{bad} of {radii.size} samples are NaN or infinite; leave them out", number=float(bad))
    for name, array in (("r", radii), ("strength", values)):
        largest = float(np.abs(array).max()) if array.size else 0.0
        if not _SMALLEST <= largest <= _LARGEST and largest > 0:
            text = f"{name} must lie within {_SMALLEST:g} and {_LARGEST:g}, got up to {largest:g}; take another unit"
            raise FitError(text, number=largest)
    if radii.size and radii.min() < 0:
        raise FitError(f"r must be >= 0, got {radii.min():g}", number=float(radii.min()))
    least = len(_ORDER.get(family, ("N", "radius", "", ""))) + 2
    distinct = np.unique(radii).size
    if distinct < least:
        raise FitError(f"{family} takes at least {least} different radii, got {distinct}", number=float(distinct))
    if values.max() <= 0:
        raise FitError("strength must be positive somewhere; is the dot darker than its paper?", number=values.max())
    return radii, values


def _checked_groups(groups: ArrayLike, count: int) -> Array:
    """The number of the group of each sample `[n]`, or a refusal."""
    try:
        array = np.asarray(groups)
        if array.shape != (count,) or array.dtype.kind not in "iuf":
            raise ValueError
    except ValueError:
        raise FitError(f"groups must be one integer a sample [{count}], got {show(groups)}") from None
    return array


def _refuse_flat(x: Array, y: Array, noise: float) -> None:
    """Refuse samples that a parabola over r explains no better than a constant does."""
    level = y - y.mean()
    bent = np.stack([np.ones_like(x), x, x * x], axis=1)
    residual = y - bent @ np.linalg.lstsq(bent, y, rcond=None)[0]
    explained, unexplained = float(level @ level - residual @ residual), float(residual @ residual)
    variation = float(np.sqrt(max(explained, 0.0) / y.size))
    # Fisher's test of a parabola against a constant: 8 is one chance in 1500
    if variation < 1e-8 or explained / 2 < _BENT * unexplained / (y.size - 3):
        raise FlatProfileError(
            f"the profile is flat: it varies by {variation:.3g} of its peak over r, in a noise of {noise:.3g}; sample "
            "farther out, or move the paper farther from focus",
            number=variation / noise if noise > 0 else 0.0,
        )


def _fit_smooth(x: Array, y: Array, family: str, clusters: Array | None) -> tuple[Array, Array, tuple[str, ...], Array]:
    """Parameters, covariance, names and fitted curve of a family with a smooth profile."""
    names = _ORDER[family]

    def model(_: Array, *p: float) -> Array:
        return evaluate(family, x, dict(zip(names, p, strict=True)))

    bounds = [_BOUNDS[n][0] for n in names], [_BOUNDS[n][1] for n in names]
    starts = [*_STARTS[family]]
    if family == "ring":
        starts.append([1.0, float(x[np.argmax(y)]), 0.3])
    params = best_of(model, y, starts, bounds)
    residual = y - model(x, *params)
    jacobian = _jacobian(model, x, params)
    return params, _covariance(jacobian, residual, clusters), names, y - residual


def _jacobian(model: object, x: Array, params: Array) -> Array:
    """Derivatives of a model by its parameters `[n, p]`, by central differences."""
    columns = []
    for i, value in enumerate(params):
        step = 1e-5 * max(abs(float(value)), 1e-2)
        up, down = params.copy(), params.copy()
        up[i] += step
        down[i] = max(down[i] - step, 0.0) if value >= 0 else down[i] - step
        columns.append((model(x, *up) - model(x, *down)) / (up[i] - down[i]))  # type: ignore[operator]
    return np.stack(columns, axis=1)


def _covariance(jacobian: Array, residual: Array, clusters: Array | None) -> Array:
    """Covariance of a least-squares fit; with clusters, errors may be correlated within each (sandwich estimator)."""
    n, p = jacobian.shape
    bread = inverse(jacobian.T @ jacobian)
    if clusters is None:
        return bread * float(residual @ residual) / max(n - p, 1)
    _, label = np.unique(clusters, return_inverse=True)
    scores = np.zeros((int(label.max()) + 1, p))
    np.add.at(scores, label, jacobian * residual[:, None])
    count = scores.shape[0]
    return bread @ (scores.T @ scores) @ bread * count / max(count - 1, 1)


def inverse(information: Array) -> Array:
    """Inverse of an information matrix; a direction without information gets an infinite variance, not an error."""
    scale = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    lost = values <= 1e-13 * max(values.max(), 1e-300)
    kept = np.where(lost, 0.0, 1.0 / np.where(lost, 1.0, values))
    result = (vectors * kept) @ vectors.T / np.outer(scale, scale)
    touched = (np.abs(vectors[:, lost]) > 1e-3).any(axis=1)
    result[touched, touched] = np.inf
    return np.asarray(result, dtype=np.float64)


def _fit_disc(x: Array, y: Array) -> tuple[Array, Array, tuple[str, ...], Array]:
    """The radius that splits the samples best: the only family whose derivative vanishes, so it is searched."""
    total = np.cumsum(y)
    inside = np.arange(1, y.size)
    gain = total[:-1] ** 2 / inside
    gain[np.diff(x) == 0] = -np.inf  # a split between equal radii is none
    k = int(np.argmax(gain))
    radius, strength = 0.5 * (x[k] + x[k + 1]), total[k] / (k + 1)
    curve = np.where(np.arange(y.size) <= k, strength, 0.0)
    variance = float(np.sum((y - curve) ** 2)) / max(y.size - 2, 1)
    # the edge lies anywhere between two samples, or farther where noise hides the step
    slack = (x[k + 1] - x[k]) ** 2 / 12 + (variance / strength**2 * np.mean(np.diff(x)) * 2) ** 2
    return np.array([strength, radius]), np.diag([variance / (k + 1), slack]), ("N", "radius"), curve


def _fit_radial(x: Array, y: Array, knots: int | None) -> tuple[Array, Array, tuple[str, ...], Array]:
    """Values, covariance, names and fitted curve of a free non-negative profile, linear between its knots."""
    from scipy.optimize import nnls

    count = knots if knots is not None else int(np.clip(np.unique(x).size // 3, 4, 32))
    if not 2 <= count < y.size:
        raise FitError(f"knots must be between 2 and the number of samples ({y.size}), got {count}")
    hats = hat_functions(x, count)
    # knots without samples of their own follow their neighbours
    rough = np.diff(np.eye(count), 2, axis=0) * 1e-4
    values, _ = nnls(np.vstack([hats, rough]), np.concatenate([y, np.zeros(len(rough))]))
    curve = hats @ values
    free = values > 0
    covariance = np.zeros((count, count))
    variance = float(np.sum((y - curve) ** 2)) / max(y.size - int(free.sum()), 1)
    normal = hats[:, free].T @ hats[:, free] + rough[:, free].T @ rough[:, free]
    covariance[np.ix_(free, free)] = inverse(normal) * variance
    return values, covariance, tuple(f"values[{i}]" for i in range(count)), curve


def hat_functions(x: Array, count: int) -> Array:
    """Piecewise linear basis on `count` knots over [0, 1], evaluated at x: `[n, count]`, 0 beyond 1."""
    where = np.clip(x, 0, 1) * (count - 1)
    distance = np.abs(where[:, None] - np.arange(count)[None, :])
    return np.clip(1 - distance, 0, None) * (x <= 1)[:, None]


def _warn_if_undetermined(fit: BlurFit, unit: float) -> None:
    """Warn about lengths with a large standard error, and about those that ended on their bound."""
    loose: Sequence[str] = [n for n in ("r_c", "sigma", "radius") if n in fit.params]
    for name in loose:
        value, error = float(fit.params[name]), float(fit.stderr[name])
        # a ring whose peak is at the centre has an r_c of 0 +- something: judged against the width
        whole = max(value, float(fit.params.get("sigma", 0.0)) if name == "r_c" else 0.0)
        if not error < 0.25 * whole:
            warn(
                FlatProfileWarning(
                    f"the profile is too flat, or too different from the family, to fix {name} = {value:.4g} +- "
                    f"{error:.2g}; sample farther out, or try another family",
                    number=error / whole if whole else np.inf,
                ),
                stacklevel=4,
            )
    for name in ("r_c", "sigma", "radius"):
        if name in fit.params and float(fit.params[name]) >= 0.999 * _BOUNDS[name][1] * unit:
            bound = _BOUNDS[name][1] * unit
            warn(BoundaryWarning(f"{name} ended on its bound {bound:.4g}; it is only a limit", number=bound), 4)
