"""Checks of a capture and its fit: levels, focus, residual, roundness, window, bounds."""

import numpy as np
from scipy.ndimage import gaussian_filter

from ..problems import FitError, warn
from ..result import Array, BlurFit
from .diagnostics import ASYMMETRIC, P_VALUE, asymmetry_of, size_of_blur, unexplained
from .dot import Dot, inner_pixels
from .forward import Solution
from .noise import fine_variance, independent_share, noise_of
from .source import UNFOCUSED_PX, Edge, soft_edge
from .tone import untoned

EXPLAINED = 1.15
"""Largest misfit of an ideal dot, over the noise, with which it explains a sharp picture."""

FAR_ABOVE = 1.6
"""Residual over noise above which a warning is given."""

# A sharp picture
_FOCUSED_SIGMA_PX = 0.7  # sigma of the edge that demosaicing, a filter before the sensor or a good lens leave in focus
_MIN_SIZE_ERROR = 0.02  # relative error of the kernel's size, from a soft sharp picture, above which to warn
_MAX_EXPONENT = 0.7  # exponent of the edge's levels below which the picture counts as sRGB encoded
_MIN_STEEPNESS, _MIN_SIGMAS = 0.03, 4.0  # steepness of an S-curve: share of the dot's level, and in standard errors
_SHARED_DIFFERENCES = 1.9  # second differences for each independent one: neighbours share pixels
_ENCODED = "as in a picture that is left sRGB encoded; decode it first"

# A tone curve in the residual: its strength, and chi squared (two parameters), above which to warn
_MIN_CURVE, _MIN_CHI = 0.075, 30.0  # a curve of 20 % has this strength in the residual
_SUPPORTING_EDGE, _SUPPORTED_CHI = 0.008, 18.0  # steepness of the sharp dot's edge, and chi squared with its support
_MIN_CONTRAST, _MIN_CONTRAST_CHI = 0.03, 11.0  # at the expected magnification; a curve of 20 % has twice the strength
_MIN_RESIZING = 0.015  # change of magnification above which no curve is sought; a weak curve causes 0.002 to 0.006
_CHI_MARGIN = 4.0  # chi squared by which a curve must explain more than a change of magnification does

# The fit
_MIN_RESIDUAL, _MIN_AT_TWICE = 0.005, 1e-3  # residual, as a share of the light: at FAR_ABOVE, at twice the noise
_SPOT_SIGMAS, _MIN_SPOT = 8.0, 0.003  # of a spot beyond the blur: standard deviations, share of the dot's level
_MAGNIFICATION_LOG = 0.08  # log factor between fitted and expected magnification
_REFUSED_OUTSIDE, _WARNED_OUTSIDE = 0.05, 0.005  # share of the blur's light outside the window


def check_linearity(picture: Array, dot: Dot, edge: Edge, file: str | None) -> bool:
    """Whether noise and edge of a sharp picture's dot are those of linear light; warns if not."""
    inside = inner_pixels(picture, dot)
    if inside is not None:
        bright = fine_variance(picture, inside)
        # rounding to a file's levels hides at most a variance of (level / 2)^2; levels that are means of three colours
        # are three times as close, and equal means may differ in the last digit
        levels = np.unique(picture[picture > dot.background + 0.5 * dot.peak])
        steps = [step for step in np.diff(levels).tolist() if step > 1e-6 * np.abs(levels).max()]
        rounding = 3 * min(steps, default=0.0) ** 2 / 4
        # noise in light can only grow with the level; allow 4 standard errors of its estimate
        largest_noise = (1 + 4 / np.sqrt(int(inside.sum() / _SHARED_DIFFERENCES))) * np.sqrt(bright + rounding)
        if dot.noise > max(largest_noise, 1e-4 * dot.peak):
            ratio = dot.noise / max(float(np.sqrt(bright)), 1e-9 * dot.peak)
            text = f"the dark paper has {ratio:.1f} times the noise of the white dot, {_ENCODED}"
            warn(text, "not linear", file=file, number=ratio)
            return False
    if edge.steepness > max(_MIN_STEEPNESS, _MIN_SIGMAS * edge.steepness_error):
        text = "the dot's edge is steeper than pixels can be: a tone curve or sharpening makes the kernel too small; "
        text += "develop without them"
        warn(text, "not linear", file=file, number=edge.steepness)
        return False
    encoded = soft_edge(picture, dot, fit_exponent=True) if edge.misfit >= EXPLAINED else edge
    if encoded.exponent < _MAX_EXPONENT and encoded.rms < 0.75 * edge.rms:
        text = f"the dot's edge is that of light to the power {encoded.exponent:.2f}, {_ENCODED}"
        warn(text, "not linear", file=file, number=encoded.exponent)
        return False
    return True


def check_levels(solution: Solution, expected: Solution, edge: Edge, file: str | None) -> None:
    """Warns if a tone curve would explain the residual of a fit.

    No kernel makes all pixels of one level brighter and all of another level darker. A tone curve does, even a weak one
    that hardly increases the residual. There are three kinds of evidence:

    1. The part of a curve's effect that the fit's parameters cannot imitate, in the residual of `solution`.
    2. In a JPEG this part is less certain; the sharp dot's `edge`, if slightly too steep, then supports it.
    3. A fitted magnification imitates most of a curve. So the residual of `expected`, the solution with the expected
       magnification, is tested for an S-curve, which must explain more than a change of magnification does.
    """
    products, covariance, visible = unexplained(solution, _curves(solution, edge.level))
    strengths = np.linalg.lstsq(visible.T @ visible, products, rcond=None)[0]
    chi_squared = float(products @ np.linalg.pinv(covariance) @ products)
    steepness = edge.steepness / max(edge.steepness_error, np.finfo(float).tiny)  # in standard errors
    agrees = edge.steepness > _SUPPORTING_EDGE and steepness > 1 and chi_squared + steepness**2 > _SUPPORTED_CHI
    is_bent = float(np.linalg.norm(strengths)) > _MIN_CURVE and (chi_squared > _MIN_CHI or agrees)
    if not is_bent:
        if abs(solution.moves["magnification"] / expected.moves["magnification"] - 1) > _MIN_RESIZING:
            return
        resizing = expected.gain * expected.pair.move_columns(expected.moves, ("magnification",), expected.kernel)[0]
        basis = np.stack([_curves(expected, edge.level)[:, 1], resizing], axis=1)
        products, covariance, visible = unexplained(expected, basis)
        variance = np.maximum(np.diag(covariance), np.finfo(float).tiny)
        contrast_chi, size_chi = np.sign(products) * products**2 / variance
        strength = products[0] / np.sum(visible[:, 0] ** 2)
        margin = contrast_chi + steepness * abs(steepness) - abs(size_chi)
        if not (strength > _MIN_CONTRAST and contrast_chi > _MIN_CONTRAST_CHI and margin > _CHI_MARGIN):
            return
    condition = "" if is_bent else "at the expected size of the dot, "
    text = (
        f"the fit's residual depends on the level, {condition}as with a tone curve, which makes the kernel 5 % or more "
        f"too small; develop without it. Other causes: colours (colours = 'each'), a wrong family {solution.family!r}"
    )
    warn(text, "not linear", file=file, number=float(strengths[1]))


def _curves(solution: Solution, level: float) -> Array:
    """Effects of weak tone curves on a fit's pixels `[pixels used, 2]`: brightening, and an S-curve's contrast."""
    light = ((solution.fitted - solution.background) / (solution.gain * level))[None]  # 0 is the paper
    step = 1e-3
    curved_light = np.concatenate([untoned(light, (-step, 0, 0)), untoned(light, (0, -1.5 * step, 0))])
    return np.asarray(solution.gain * level * (curved_light - untoned(light, (0, 0, 0))) / step).T


def check_focus(edge: Edge, radius_px: float, deconvolved: bool, file: str | None) -> None:
    """Warns if a soft sharp picture changes the kernel's size; `deconvolved`: the dot was fitted as in focus."""
    if edge.softness <= _FOCUSED_SIGMA_PX or edge.radius <= 2 * edge.softness:
        return
    # the variance along an axis of a disc of radius R is R^2 / 4
    excess = edge.softness**2 - _FOCUSED_SIGMA_PX**2
    size_error = 1 - 1 / np.sqrt(1 + 4 * excess / max(radius_px, 1e-9) ** 2)
    if size_error < _MIN_SIZE_ERROR:
        return
    effect = f"the kernel is too small by {100 * size_error:.0f} %"
    if edge.softness <= UNFOCUSED_PX:
        cause = f"; if the printed dot's edge is sharp, {effect}"
    elif not deconvolved:
        cause = f", as out of focus; {effect}: focus again"
    else:
        cause = ", as out of focus; the dot was fitted as it would be in focus: focus again, or print a sharper dot"
    text = f"the sharp picture is soft: its dot's edge has a width of {edge.softness:.1f} px{cause}"
    warn(text, "not in focus", file=file, number=edge.softness)


def check_fit(solution: Solution, fit: BlurFit, file: str | None, freest: BlurFit) -> None:
    """Raises or warns about problems of a fit, which describes the solution; `freest` has the freest kernel."""
    if not fit.gain > 0:
        raise FitError("the blurred picture has nothing in common with the sharp one", file=file, number=fit.gain)
    pair = solution.pair
    # share of the light that the kernel spreads outside the window
    source = pair.drawn(solution.moves)
    total, inside = float(source.sum()), float(pair.blurred(source, solution.kernel[None]).sum())
    outside = 1 - inside / total if total > 0 else 1.0
    size = f"{pair.data.shape[1]}x{pair.data.shape[0]} px"
    if outside > _REFUSED_OUTSIDE:
        text = f"the window cuts the blur: {100 * outside:.0f} % of its light falls outside {size}; cut a larger one"
        raise FitError(text, "window", file=file, number=outside)
    if outside > _WARNED_OUTSIDE:
        text = f"{100 * outside:.1f} % of the blur's light falls outside the window of {size}; cut a larger one"
        warn(text, "window", file=file, number=outside)
    # the freest residual is far above the noise, or the chosen family adds much to it
    residual, ratio = freest.residual, freest.residual_over_noise
    far_above = (residual > _MIN_RESIDUAL and ratio > FAR_ABOVE) or (residual > _MIN_AT_TWICE and ratio > 2.0)
    # a residual far above the noise is reported below; here, only the part that the family adds to it
    warned_ratio = max(2.0, 1.3 * ratio) if far_above else 2.0
    if fit is not freest and fit.residual > _MIN_AT_TWICE and fit.residual_over_noise > warned_ratio:
        text = (
            f"family {fit.family!r} leaves {fit.residual_over_noise:.1f} times the noise, the free profile {ratio:.1f} "
            "times: the difference would not be seen at accuracy_db; ask for more, or for a richer family"
        )
        warn(text, "residual", file=file, number=fit.residual_over_noise)
    if far_above:
        text = f"the residual is {100 * residual:.1f} %, {ratio:.1f} times the noise; is the image linear, a single "
        text += "white dot, and not a strong JPEG?"
        text += f" Family {freest.family!r} may be too simple" if freest.family != "radial" else ""
        warn(text, "residual", file=file, number=ratio)
    change = fit.magnification / pair.magnification
    if abs(np.log(change)) > _MAGNIFICATION_LOG:
        text = f"the blurred dot is {change:.3f} times the size it should have; are distances right and light linear?"
        warn(text, "magnification", file=file, number=change)
    _check_spots(solution, file)
    if fit.asymmetry > ASYMMETRIC and asymmetry_of(solution)[1] < P_VALUE:
        text = f"the blur is not round: {100 * fit.asymmetry:.0f} % of it depends on the angle in a way that family "
        text += f"{fit.family!r} cannot; families 'auto' and 'image' take any shape"
        warn(text, "asymmetry", file=file, number=fit.asymmetry)
    if solution.family != "radial":
        _check_parameters(solution, file)


def _check_spots(solution: Solution, file: str | None) -> None:
    """Warns about light beyond the dot's blur; the residual is not sensitive to small amounts."""
    pair = solution.pair
    beyond = (pair.distance > pair.dot.reach + 4) & pair.used
    if not beyond.any():
        return
    smoothed = gaussian_filter(pair.picture(solution.residual), 2.0, mode="constant")
    smoothed_beyond = np.where(beyond, smoothed, -np.inf)
    y, x = np.unravel_index(int(np.argmax(smoothed_beyond)), smoothed_beyond.shape)
    height, peak = float(smoothed_beyond[y, x]), pair.dot.peak
    # smoothing by sigma = 2 px leaves 0.14 of white noise, and more of correlated noise
    smoothing = pair.fine_share * independent_share(pair.noise_correlation)
    values = smoothed_beyond[beyond]
    spread = 1.4826 * float(np.median(np.abs(values - np.median(values))))  # also of a JPEG's blocks
    if height > max(_SPOT_SIGMAS * max(0.14 * noise_of(pair.data) / np.sqrt(smoothing), spread), _MIN_SPOT * peak):
        text = f"a spot of {100 * height / peak:.1f} % of the dot's level is left at ({x}, {y}), beyond the blur: "
        text += "is there another dot, dust or a reflection? The error bars do not count it"
        warn(text, "residual", file=file, number=height / peak)


def _check_parameters(solution: Solution, file: str | None) -> None:
    """Warns about parameters on their bounds, and about a blur whose size the pictures do not determine."""
    low, high = solution.pair.bounds(solution.names)
    for name, lower, upper in zip(solution.names, low, high, strict=True):
        value = float({**solution.moves, **solution.params}[name])
        at_least, at_most = value <= lower + 1e-6 * abs(lower), value >= upper * (1 - 1e-6)
        is_length = name in ("sigma", "radius", "r_c")
        if at_most and is_length:
            text = f"the blur is wider than the window: {name} ran to {value:.3g} px"
            raise FitError(text, "flat profile", file=file, number=value)
        # exempt: the shape of a blur below a pixel, the exponent of a missing tilt, the curvature of straight or
        # circular blades
        if (at_least and not is_length and name != "b" or at_most) and name not in ("m", "curvature"):
            warn(f"{name} ended on its bound {value:.4g}; it is only a limit", "boundary", file=file, number=value)
    size, error = size_of_blur(solution)
    if not error < 0.5 * size:
        text = f"the blur's rms radius of {size:.3g} ± {error:.2g} px is not determined: too little blur, or too noisy"
        warn(text, "flat profile", file=file, number=error / size if size else np.inf)
