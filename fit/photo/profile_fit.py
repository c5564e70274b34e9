"""The paper's procedure: blur strength along spokes around a dot, and a fit of eq. (1) or another profile."""

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates
from scipy.optimize import approx_fprime

from torchdof.optics.psf import LENGTHS, profile
from torchdof.validation import choice, show

from ..problems import FitError, a_picture, checked, real_numbers, warn
from ..result import Array, BlurFit, Indices
from ..solve import best_of, inverse
from .dot import find_dot

_NAMES = {"gaussian": ("N", "sigma"), "ring": ("N", "r_c", "sigma"), "softm": ("N", "radius", "sigma", "b", "m")}
# relative to the largest r; N relative to the largest strength
_BOUNDS = {
    **{"N": (0.0, np.inf), "r_c": (0.0, 3.0), "sigma": (1e-3, 30.0)},
    **{"radius": (1e-2, 3.0), "b": (-1.0, 20.0), "m": (0.5, 12.0)},
}
_STARTS = {
    "gaussian": [[1.0, 0.2], [1.0, 0.5], [1.0, 1.5]],
    "ring": [[1.0, 0.05, 0.3], [1.0, 0.5, 0.2], [1.0, 0.1, 1.0]],
    "softm": [[1.0, 0.5, 0.1, 0.0, 2.0], [1.0, 0.9, 0.1, 0.0, 4.0], [1.0, 0.3, 0.1, 0.5, 2.0]],
}
_FLAT_F = 8.0  # F statistic of a parabola against a constant, below which samples are flat: 1 chance in 1500
_MIN_SIDE_PX = 5  # noise is estimated from second differences
_STEP_DEG = 10


def fit_profile(r: ArrayLike, strength: ArrayLike, family: str = "ring", *, groups: ArrayLike | None = None) -> BlurFit:
    """Fits `f(r) = N exp(-(r - r_c)^2 / (2 sigma^2))`, or another profile times N, to samples of blur strength.

    Radii may have any unit (the paper's are metres on the paper); lengths among the parameters are returned in it.

    Args:
        r: distance from the dot's centre `[n]`, >= 0.
        strength: blur strength `[n]`, in any positive unit.
        family: "gaussian", "ring" (the paper's) or "softm".
        groups: group of each sample `[n]`, integers (its spoke), whose common errors the standard errors then include.

    Returns:
        A `BlurFit` with the family's parameters and "N".

    Raises:
        FitError: wrong shapes, too few samples, negative radii, unknown family, NaN; of kind "flat profile" if the
        strength does not vary beyond its noise. A parameter that is not determined, or on its bound, gives a
        `FitWarning`.

    Reference:
        Sato, Dobashi, Yamamoto, eq. (1): N -> "N", r_c -> "r_c", sigma -> "sigma" (the paper prints sigma^2).

    Example:
        >>> import numpy as np
        >>> r = np.linspace(0, 5e-3, 50)
        >>> fit = fit_profile(r, 0.58 * np.exp(-((r - 4e-4) ** 2) / (2 * 2e-3**2)))
        >>> f"{fit.params['sigma']:.6f} {fit.params['r_c']:.6f} {fit.params['N']:.4f}"
        '0.002000 0.000400 0.5800'
    """
    checked(choice, "family", family, tuple(_NAMES))
    names, radii, values = _NAMES[family], real_numbers("r", r, "[n]"), real_numbers("strength", strength, "[n]")
    if radii.shape != values.shape:
        raise FitError(f"r and strength must both be [n], got {list(radii.shape)} and {list(values.shape)}")
    if radii.min(initial=0.0) < 0:
        raise FitError(f"r must be >= 0, got {radii.min():g}")
    if (distinct := np.unique(radii).size) < len(names) + 2:
        raise FitError(f"the family takes at least {len(names) + 2} different radii, got {distinct}")
    if values.max() <= 0:
        raise FitError("strength must be positive somewhere; is the dot darker than its paper?")
    labels = np.arange(radii.size) if groups is None else np.asarray(groups)
    if labels.shape != radii.shape or labels.dtype.kind not in "iuf":
        raise FitError(f"groups must be one integer a sample [{radii.size}], got {show(groups)}")
    order = np.argsort(radii, kind="stable")
    unit, peak = float(radii.max()), float(np.abs(values).max())
    x, y = radii[order] / unit, values[order] / peak
    noise = float(np.sqrt(np.mean((y[2:] - 2 * y[1:-1] + y[:-2]) ** 2) / 6.0))  # from second differences
    # F test of a parabola over r against a constant
    parabola = np.stack([np.ones_like(x), x, x * x], axis=1)
    unexplained = float(np.sum((y - parabola @ np.linalg.lstsq(parabola, y, rcond=None)[0]) ** 2))
    explained = float(np.sum((y - y.mean()) ** 2)) - unexplained
    variation = float(np.sqrt(max(explained, 0.0) / y.size))
    if variation < 1e-8 or explained / 2 < _FLAT_F * unexplained / (y.size - 3):
        text = f"the profile is flat: it varies by {variation:.3g} of its peak (noise {noise:.3g}); sample farther out"
        raise FitError(text, "flat profile")

    def model(p: Array) -> Array:
        return evaluate(family, x, dict(zip(names, p, strict=True)))

    starts = [*_STARTS[family], *([[1.0, float(x[np.argmax(y)]), 0.3]] if family == "ring" else [])]
    fitted = best_of(model, y, starts, ([_BOUNDS[n][0] for n in names], [_BOUNDS[n][1] for n in names]))
    residual = y - model(fitted)
    squares = float(residual @ residual)
    jacobian = approx_fprime(fitted, model, 1e-5 * np.maximum(np.abs(fitted), 1e-2))
    covariance = inverse(jacobian.T @ jacobian)
    if groups is None:
        covariance = covariance * squares / max(y.size - len(names), 1)
    else:  # a sandwich estimator for correlated errors
        _, label = np.unique(labels[order], return_inverse=True)
        count = int(label.max()) + 1
        scores = np.stack([np.bincount(label, column, count) for column in (jacobian * residual[:, None]).T], axis=1)
        covariance = covariance @ (scores.T @ scores) @ covariance * count / max(count - 1, 1)
    scale = np.array([unit if n in LENGTHS else peak if n == "N" else 1.0 for n in names])
    covariance = covariance * np.outer(scale, scale)
    spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    params, stderr = (dict[str, float | Array](zip(names, v.tolist(), strict=True)) for v in (fitted * scale, spread))
    size, curve_r = float(np.sqrt(np.sum(y**2))), np.linspace(0.0, unit, 257)
    samples, curve = np.stack([radii, values]), np.stack([curve_r, evaluate(family, curve_r, params)])
    residuals = float(np.sqrt(squares)) / size, float(noise * np.sqrt(y.size)) / size
    fit = BlurFit(family, params, stderr, *residuals, covariance, names, "profile", samples=samples, curve=curve)
    for name in LENGTHS.intersection(names):
        value, error, bound = float(fit.params[name]), float(fit.stderr[name]), _BOUNDS[name][1] * unit
        # compare the error of r_c with sigma if r_c is smaller, because a peak at the centre has r_c near 0
        reference_length = max(value, float(fit.params["sigma"]) if name == "r_c" else 0.0)
        if not error < 0.25 * reference_length:
            warn(f"the profile is flat, or too different from the family, to fix {name} = {value:.4g}", "flat profile")
        if value >= 0.999 * bound:
            warn(f"{name} ended on its bound {bound:.4g}; it is only a limit", "boundary")
    return fit


def evaluate(family: str, r: Array, params: dict[str, float | Array]) -> Array:
    """`N f(r)` of a profile fit at radii `[n]`; N = 1 if it has none."""
    shape = {k: torch.as_tensor(v, dtype=torch.float64) for k, v in params.items() if k != "N"}
    strength = float(params.get("N", 1.0))
    return strength * profile(family, torch.from_numpy(np.ascontiguousarray(r)), shape).numpy()


def blur_strength(sharp: ArrayLike, blurred: ArrayLike) -> tuple[Array, Array, Indices]:
    """`I_b(r, theta) / I(r, theta)` from the dot's centre to its edge, at every pixel of r and every 10 degrees.

    As in the paper, both pictures are read from the centre of the sharp dot: the result is the dot convolved with the
    kernel, for comparison with the paper.

    Args:
        sharp: `[H, W]`, linear light, the dot in focus.
        blurred: `[H, W]`, linear light, the same dot out of focus.

    Returns:
        Radii in px, strengths (interpolated bilinearly) and the number of each sample's spoke, all `[n]`.

    Raises:
        FitError: no usable dot.

    Reference:
        Sato, Dobashi, Yamamoto, section 2.

    Example:
        >>> from torchdof.optics import psf
        >>> dot = psf.pixel_kernels("disc", {"radius": 6.0}, size=31).numpy()
        >>> r, strength, spoke = blur_strength(dot, 0.5 * dot)
        >>> round(float(r.max())), round(float(strength.mean()), 3), len(set(spoke.tolist()))
        (5, 0.5, 36)
    """
    pictures = a_picture("sharp", sharp, _MIN_SIDE_PX), a_picture("blurred", blurred, _MIN_SIDE_PX)
    dot, blurred_dot = map(find_dot, pictures)
    r = np.arange(0.0, max(dot.radius - 1.0, 1.0) + 1e-9)  # the outermost pixel of the dot is half paper
    theta = np.deg2rad(np.arange(0, 360, _STEP_DEG))[:, None]
    positions = [dot.y + r * np.sin(theta), dot.x + r * np.cos(theta)]
    levels, blurred_levels = (map_coordinates(picture, positions, order=1, mode="nearest") for picture in pictures)
    is_lit = levels - dot.background > 0.2 * dot.peak
    spokes, rays = np.nonzero(is_lit)
    strength = (blurred_levels[is_lit] - blurred_dot.background) / (levels[is_lit] - dot.background)
    return r[rays], strength, spokes
