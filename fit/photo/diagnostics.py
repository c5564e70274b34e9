"""Statistics of a solution of the forward model, as a `BlurFit`, and warnings of doubtful captures and fits."""

import numpy as np
from scipy.linalg import orth
from scipy.ndimage import gaussian_filter
from scipy.special import chdtrc

from torchdof.optics.psf import LENGTHS

from ..problems import FitError, warn
from ..result import Array, BlurFit
from .dot import Dot, correlate, fine_variance, independent_share, inner_pixels, noise_of
from .forward import OPENINGS, SHAPES, Solution, without_level
from .source import UNFOCUSED_PX, Edge, soft_edge
from .target import untoned

ASYMMETRIC = 0.02  # share of a blur's light that depends on the angle, above which it is not round
P_VALUE = 1e-6  # probability of a deviation by noise alone, below which it is significant
EXPLAINED = 1.15  # largest misfit of an ideal dot, over the noise, with which it explains a sharp picture
FAR_ABOVE = 1.6  # residual over noise above which a warning is given
_HARMONICS, _RINGS = 8, 4
_RMS_DRAWN_PX = 16.0  # px; size at which a PSF is drawn to measure it; larger: more exact, slower
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


def residual_rms(solution: Solution) -> float:
    """Root mean square of the residual over the lit pixels."""
    return float(np.sqrt(np.mean(solution.residual[solution.pair.lit[solution.pair.used]] ** 2)))


def noise_near(solution: Solution) -> float:
    """Standard deviation of a pixel's noise where the light is, from the fine (pixel to pixel) part of the residual."""
    pair = solution.pair
    fine = np.nan_to_num(fine_variance(pair.picture(solution.residual), pair.lit))
    lit = pair.data[pair.lit] - solution.background
    dark, light = noise_of(pair.data) ** 2, pair.shot_noise * float(np.mean(np.maximum(lit, 0.0)))
    camera_variance = dark / pair.fine_share + light / (pair.fine_share_of_light or pair.fine_share)
    # additional fine variance is not camera noise and may be uncorrelated
    return float(np.sqrt(camera_variance + max(fine - dark - light, 0.0)))


def unexplained(solution: Solution, basis: Array) -> tuple[Array, Array, Array]:
    """Products of patterns `[pixels used, n]` and the residual, their covariance by noise, and the visible patterns."""
    # what the parameters imitate is not in the residual
    imitable, _ = np.linalg.qr(solution.slopes[:, np.abs(solution.slopes).max(axis=0) > 0])
    visible = without_level(basis - imitable @ (imitable.T @ basis), solution.fitted)
    # a smooth deviation is not noise, which in turn cannot exceed the residual: a JPEG's dark areas have little
    variance = min(noise_near(solution), residual_rms(solution)) ** 2
    pair = solution.pair
    correlated = correlate(pair.picture(visible.T), pair.noise_correlation)[:, pair.used].T
    return visible.T @ solution.residual, variance * visible.T @ correlated, visible


def asymmetry_of(solution: Solution) -> tuple[float, float]:
    """Norm of the blur's angle-dependent part over its light's, without noise, and the probability of it by noise."""
    pair = solution.pair
    (x, y), (rows, columns) = solution.centre, np.indices(pair.data.shape)
    angle = np.arctan2(rows - y, columns - x)
    ring_at = np.hypot(columns - x, rows - y) / max(pair.dot.reach, 2.0) * _RINGS
    near = (ring_at <= _RINGS) & pair.used
    hats = [(np.clip(1 - np.abs(ring_at - ring + 0.5), 0, None) * near)[pair.used] for ring in range(1, _RINGS + 1)]
    # the whitened squared coefficients of noise follow a chi squared distribution
    waves = [wave(n * angle[pair.used]) for n in range(1, _HARMONICS + 1) for wave in (np.cos, np.sin)]
    _, _, visible = unexplained(solution, np.stack([hat * wave for hat in hats for wave in waves], axis=1))
    found, spread, _ = unexplained(solution, orth(visible, rcond=1e-6))
    probability = float(chdtrc(found.size, found @ np.linalg.solve(spread, found))) if np.trace(spread) > 0 else 0.0
    light = float(np.sum((pair.data[near] - solution.background) ** 2))
    share = np.sqrt(max(float(found @ found) - float(np.trace(spread)), 0.0) / light) if light > 0 else np.inf
    return float(share), probability


def size_of_blur(solution: Solution) -> tuple[float, float]:
    """The PSF's rms radius and its standard error, px; better determined than single, correlated parameters."""
    if solution.family == "radial":  # light and second moment are sums over the values, each with a hat function
        values, radius = np.asarray(solution.params["values"]), float(solution.params["radius"])
        r = np.linspace(0, radius, 64 * values.size + 1)
        hats = np.clip(1 - np.abs(r / radius * (values.size - 1) - np.arange(values.size)[:, None]), 0, None)
        light, moment = hats @ r, hats @ r**3
        rms = float(np.sqrt(moment @ values / (light @ values)))
        # derivative of a quotient: the total light depends on the values too
        slope = (moment - rms**2 * light) / (light @ values) / (2 * rms)
        return rms, float(np.sqrt(max(slope @ solution.covariance @ slope, 0.0)))
    pair, shape, values = solution.pair, list(solution.params), np.array([*solution.params.values()], np.float64)
    steps = 1e-3 * np.maximum(np.abs(values), 0.1)
    varied = np.vstack([values, values + np.diag(steps)]).T  # a row for each parameter, changed in one column
    is_length = np.array([n in LENGTHS for n in shape])
    scale = max(1.0, _RMS_DRAWN_PX / np.abs(varied[is_length]).max())  # drawn large, pixels have no effect
    varied[is_length] *= scale
    kernels = pair.kernels(solution.family, dict(zip(shape, varied, strict=True)), int(np.ceil(scale * pair.half)))
    offset = np.arange(kernels.shape[-1]) - kernels.shape[-1] // 2
    rms, *varied_rms = (np.sqrt((kernels * (offset[:, None] ** 2 + offset**2)).sum((1, 2))) / scale).tolist()
    slope = (np.array(varied_rms) - rms) / steps
    covariance = solution.covariance[: len(shape), : len(shape)]
    if np.abs(slope[np.isinf(np.diag(covariance))]).sum() > 0.1 * np.abs(slope).sum():
        return rms, np.inf
    variance, moment_error = max(float(slope @ np.where(np.isinf(covariance), 0.0, covariance) @ slope), 0.0), 0.0
    if solution.family == "image":  # its shape is free: only the picture's second moment determines its size
        squared, light = pair.distance[pair.lit] ** 2, pair.data[pair.lit] - solution.background
        centred = squared - float(light @ squared / light.sum())
        noise = noise_near(solution) / np.sqrt(independent_share(pair.noise_correlation))
        moment_error = float(noise * np.linalg.norm(centred) / abs(light.sum()) / (2 * max(rms, 1e-9)))
    return rms, float(np.sqrt(variance + moment_error**2))


def bic_of(solution: Solution) -> float:
    """Bayesian information criterion of a profile or polygon, up to a constant that depends on the pictures only."""
    pair = solution.pair
    parameters = len(SHAPES[solution.family]) + (solution.family == "polygon")  # and the number of blades
    if solution.family == "radial":
        parameters = int(np.sum(np.asarray(solution.params["values"]) > 0))
    # correlated neighbours are not independent samples
    count = max(round(pair.values.size * independent_share(pair.noise_correlation)), 1)
    variance = max(float(np.mean(solution.residual**2)) + (1e-6 * pair.unit) ** 2, np.finfo(float).tiny)
    return count * float(np.log(variance)) + parameters * float(np.log(count))


def describe(solution: Solution, why: str) -> BlurFit:
    """The solution as a `BlurFit`: errors by name, residual and noise of the lit pixels, samples for plotting."""
    pair = solution.pair
    (x, y), (rows, columns) = solution.centre, np.indices(pair.data.shape)
    size = float(np.sqrt(np.mean((pair.data[pair.lit] - solution.background) ** 2)))
    source_variance = (solution.gain * pair.source.noise) ** 2 / pair.fine_share
    noise = np.sqrt(noise_near(solution) ** 2 + source_variance * float(np.sum(solution.kernel**2)))
    errors = np.sqrt(np.diag(solution.covariance))
    stderr = dict[str, float | Array](zip(solution.names, errors.tolist(), strict=True))
    if solution.family == "radial":
        stderr = {"values": errors, "radius": 0.0}
    radius, radius_stderr = (float(np.sqrt(2) * rms) for rms in size_of_blur(solution))
    distance = np.hypot(columns - x, rows - y)
    is_near = (distance <= 1.2 * pair.dot.reach) & pair.used
    order = np.argsort(distance[is_near])
    samples, curve = (
        np.stack([distance[is_near], (levels - solution.background) / (solution.gain or 1.0)])[:, order]
        for levels in (pair.data[is_near], solution.fitted[is_near[pair.used]])
    )
    return BlurFit(
        solution.family,
        dict(solution.params),
        {n: stderr[n] for n in solution.params},
        residual_rms(solution) / size,
        float(noise) / size,
        solution.covariance,
        solution.names,
        model="forward",
        gain=solution.gain,
        background=solution.background,
        shift=(x - pair.source.x, y - pair.source.y),
        centre=(x, y),
        magnification=solution.moves["magnification"],
        asymmetry=asymmetry_of(solution)[0],
        radius=radius,
        radius_stderr=radius_stderr,
        why=why,
        aperture=pair.opening_with(solution.params) if solution.family in OPENINGS else None,
        samples=samples,
        curve=curve,
    )


def check_linearity(picture: Array, dot: Dot, edge: Edge, file: str | None) -> bool:
    """Whether noise and edge of a sharp picture's dot are those of linear light; warns if not."""
    inside, text = inner_pixels(picture, dot), ""
    if inside is not None:
        bright = fine_variance(picture, inside)
        # rounding hides at most a variance of (level / 2)^2; means of three colours are three times as close
        levels = np.unique(picture[picture > dot.background + 0.5 * dot.peak])
        steps = [step for step in np.diff(levels).tolist() if step > 1e-6 * np.abs(levels).max()]
        rounding = 3 * min(steps, default=0.0) ** 2 / 4
        # noise in light can only grow with the level; allow 4 standard errors of its estimate
        largest_noise = (1 + 4 / np.sqrt(int(inside.sum() / _SHARED_DIFFERENCES))) * np.sqrt(bright + rounding)
        if dot.noise > max(largest_noise, 1e-4 * dot.peak):
            ratio = dot.noise / max(float(np.sqrt(bright)), 1e-9 * dot.peak)
            text = f"the dark paper has {ratio:.1f} times the noise of the white dot, {_ENCODED}"
    if not text and edge.steepness > max(_MIN_STEEPNESS, _MIN_SIGMAS * edge.steepness_error):
        text = "the dot's edge is steeper than pixels can be: develop without a tone curve and sharpening"
    if not text and edge.misfit >= EXPLAINED:
        encoded = soft_edge(picture, dot, fit_exponent=True)
        if encoded.exponent < _MAX_EXPONENT and encoded.rms < 0.75 * edge.rms:
            text = f"the dot's edge is that of light to the power {encoded.exponent:.2f}, {_ENCODED}"
    if text:
        warn(text, "not linear", file)
    return not text


def check_levels(solution: Solution, expected: Solution, edge: Edge, file: str | None) -> None:
    """Warns if a tone curve would explain the residual of a fit, or of `expected`, at the expected magnification."""
    products, covariance, visible = unexplained(solution, _curves(solution, edge.level))
    strengths = np.linalg.lstsq(visible.T @ visible, products, rcond=None)[0]
    chi_squared = float(products @ np.linalg.pinv(covariance) @ products)
    steepness = edge.steepness / max(edge.steepness_error, np.finfo(float).tiny)  # in standard errors
    agrees = edge.steepness > _SUPPORTING_EDGE and steepness > 1 and chi_squared + steepness**2 > _SUPPORTED_CHI
    # a residual too weak to prove a curve, as in a JPEG, is enough beside a steep edge
    is_bent = float(np.linalg.norm(strengths)) > _MIN_CURVE and (chi_squared > _MIN_CHI or agrees)
    if not is_bent:  # a fitted magnification imitates most of a curve
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
    where = "" if is_bent else "at the expected size of the dot, "
    text = f"the fit's residual depends on the level, {where}as with a tone curve: develop without it. Or it is colour "
    warn(f"{text}(colours = 'each'), or a wrong family {solution.family!r}", "not linear", file)


def _curves(solution: Solution, level: float) -> Array:
    """Effects of weak tone curves on a fit's pixels `[pixels used, 2]`: brightening, and an S-curve's contrast."""
    peak, step = solution.gain * level, 1e-3
    light = ((solution.fitted - solution.background) / peak)[None]  # 0 is the paper
    straight, *curved = (untoned(light, bend)[0] for bend in ((0, 0, 0), (-step, 0, 0), (0, -1.5 * step, 0)))
    return peak / step * np.stack([one - straight for one in curved], axis=1)


def check_focus(edge: Edge, radius_px: float, deconvolved: bool, file: str | None) -> None:
    """Warns if a soft sharp picture changes the kernel's size; `deconvolved`: the dot was fitted as in focus."""
    excess = max(edge.softness**2 - _FOCUSED_SIGMA_PX**2, 0.0)  # of the variance along an axis; R^2 / 4 for a disc
    size_error = 1 - 1 / np.sqrt(1 + 4 * excess / max(radius_px, 1e-9) ** 2)
    if size_error < _MIN_SIZE_ERROR or edge.radius <= 2 * edge.softness:
        return
    effect = f"the kernel is too small by {100 * size_error:.0f} %"
    cause = f", as out of focus; {effect}: focus again"
    if edge.softness <= UNFOCUSED_PX:
        cause = f"; if the printed dot's edge is sharp, {effect}"
    elif deconvolved:
        cause = ", as out of focus; the dot was fitted as it would be in focus: focus again, or print a sharper dot"
    warn(f"the sharp picture is soft: its dot's edge is blurred by {edge.softness:.1f} px{cause}", "not in focus", file)


def check_fit(solution: Solution, fit: BlurFit, file: str | None, freest: BlurFit) -> None:
    """Raises or warns about problems of a fit, which describes the solution; `freest` has the freest kernel."""
    if not fit.gain > 0:
        raise FitError("the blurred picture has nothing in common with the sharp one", file=file)
    pair, source = solution.pair, solution.pair.drawn(solution.moves)
    total, inside = float(source.sum()), float(pair.blurred(source, solution.kernel[None]).sum())
    outside, (height, width) = 1 - inside / total if total > 0 else 1.0, pair.data.shape  # share of the light
    text = f"{100 * outside:.1f} % of the blur lies outside the window of {width}x{height} px: cut a larger one"
    if outside > _REFUSED_OUTSIDE:
        raise FitError(text, "window", file)
    if outside > _WARNED_OUTSIDE:
        warn(text, "window", file)
    # the freest residual is far above the noise, or the chosen family adds much to it
    residual, ratio = freest.residual, freest.residual_over_noise
    far_above = (residual > _MIN_RESIDUAL and ratio > FAR_ABOVE) or (residual > _MIN_AT_TWICE and ratio > 2.0)
    warned_ratio = max(2.0, 1.3 * ratio) if far_above else 2.0
    if fit is not freest and fit.residual > _MIN_AT_TWICE and fit.residual_over_noise > warned_ratio:
        text = f"family {fit.family!r} leaves {fit.residual_over_noise:.1f} times the noise, a free profile {ratio:.1f}"
        warn(f"{text}: that would not be seen at accuracy_db; ask for more, or for a richer family", "residual", file)
    if far_above:
        simple = f" Family {freest.family!r} may be too simple" if freest.family != "radial" else ""
        text = f"the residual of {100 * residual:.1f} % is {ratio:.1f} times the noise; is the picture linear, one dot"
        warn(f"{text}, and not a strong JPEG?{simple}", "residual", file)
    change = fit.magnification / pair.magnification
    if abs(np.log(change)) > _MAGNIFICATION_LOG:
        warn(f"the blurred dot is {change:.3f} times the size it should have; check distances", "magnification", file)
    beyond = (pair.distance > pair.dot.reach + 4) & pair.used
    if beyond.any():  # the residual is not sensitive to small spots
        smoothed = np.where(beyond, gaussian_filter(pair.picture(solution.residual), 2.0, mode="constant"), -np.inf)
        y, x = np.unravel_index(int(np.argmax(smoothed)), smoothed.shape)
        # smoothing by sigma = 2 px leaves 0.14 of white noise, and more of correlated noise
        smoothing = pair.fine_share * independent_share(pair.noise_correlation)
        spread = 1.4826 * float(np.median(np.abs(smoothed[beyond] - np.median(smoothed[beyond]))))  # a JPEG's blocks
        noise = max(0.14 * noise_of(pair.data) / np.sqrt(smoothing), spread)
        if (height := float(smoothed[y, x])) > max(_SPOT_SIGMAS * noise, _MIN_SPOT * pair.dot.peak):
            text = f"a spot of {100 * height / pair.dot.peak:.1f} % of the dot's level at ({x}, {y}), beyond the blur: "
            warn(f"{text}another dot, dust, a reflection? The error bars do not count it", "residual", file)
    if fit.asymmetry > ASYMMETRIC and asymmetry_of(solution)[1] < P_VALUE:
        text = f"the blur is not round: {100 * fit.asymmetry:.0f} % of it depends on the angle, which family "
        warn(f"{text}{fit.family!r} cannot; 'auto' and 'image' take any shape", "asymmetry", file)
    if solution.family == "radial":
        return
    for name, lower, upper in zip(solution.names, *pair.bounds(solution.names), strict=True):
        value = float({**solution.moves, **solution.params}[name])
        at_least, at_most = value <= lower + 1e-6 * abs(lower), value >= upper * (1 - 1e-6)
        if at_most and name in LENGTHS:
            raise FitError(f"the blur is wider than the window: {name} ran to {value:.3g} px", "flat profile", file)
        # exempt: the shape of a blur below a pixel, the exponent of a missing tilt, the curvature of any blades
        if (at_most or (at_least and name not in {"b", *LENGTHS})) and name not in ("m", "curvature"):
            warn(f"{name} ended on its bound {value:.4g}; it is only a limit", "boundary", file)
    if not fit.radius_stderr < 0.5 * fit.radius:
        text = f"too little blur or light: its radius is {fit.radius:.3g} ± {fit.radius_stderr:.2g} px"
        warn(text, "flat profile", file)
