"""Fits one kernel to a pair of pictures, sharp and defocused."""

from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from torchdof.optics.aperture import Aperture
from torchdof.validation import choice, number, show, whole

from ..problems import FitError, a_picture, checked, warn
from ..result import Array, BlurFit
from .diagnostics import EXPLAINED, FAR_ABOVE, bic_of, check_fit, check_focus, check_levels, check_linearity, describe
from .dot import check_blacks, find_dot, fine_share_inside, independent_share, used_pixels
from .family_choice import COST, choose, looks_alike
from .forward import ALL_MOVES, OPENINGS, SHAPES, Forward, Solution
from .free_kernels import solve_image, solve_opening, solve_polygon, solve_radial
from .profile_fit import blur_strength, fit_profile
from .source import Edge, ideal_dot, picture_of_dot, point_source, soft_edge

Model = Literal["forward", "ratio"]
SourceKind = Literal["auto", "image", "dot"]

_MIN_WINDOW_PX = 15
_MIN_DOT_PX = 0.2
_MAX_EDGE_RMS = 2e-3  # largest misfit of the edge, over the level, of a magnified dot that is drawn as an ideal one
_MAX_UNEXPLAINED, _MIN_VARIANCE = 0.02, 0.02  # the same if magnifying its softness adds more than this, px^2
_MIN_RADIUS_PX = 4.0  # smallest radius of a dot and its blur; below, pixels have an effect like a tone curve
_MIN_CHI_GAIN = 12.0  # decrease of chi squared for which the magnification is fitted: 3.5 sigma


def fit_pair(
    sharp: ArrayLike | None,
    blurred: ArrayLike,
    family: str = "auto",
    model: Model = "forward",
    *,
    accuracy_db: float = 45.0,
    source: SourceKind = "auto",
    magnification: float = 1.0,
    fit_magnification: bool | None = None,
    white: float | None = None,
    knots: int | None = None,
    reach: float | None = None,
    aperture: Aperture | None = None,
    softness: float | None = None,
    like: BlurFit | None = None,
    files: tuple[str | None, str | None] = (None, None),
) -> BlurFit:
    """Fits the kernel that turns a picture of a sharp dot into the picture of the same dot out of focus.

    The forward model explains every pixel of the window: `blurred = gain * (kernel convolved with the sharp picture,
    moved and magnified) + background`, all of them fitted. As in rendering, a pixel's own blur is not in the kernel.

    A blur of one or two pixels determines its size only. Its shape, if the family is "ring" or "softm", is then the
    expected one: that of a nearly uniform disc, or of `like`. The expectation counts as one measurement, and enters the
    standard errors.

    `model="ratio"` is the paper's: `blurred / sharp` along spokes inside the dot, then eq. (1). It measures the dot
    convolved with the kernel, so its widths depend on the dot.

    Args:
        sharp: `[H, W]`, linear light, the dot in focus on dark ground; None for a point of light (a star).
        blurred: `[H, W]`, linear light, the same dot out of focus, with the whole blur inside the window.
        family: "gaussian", "ring", "disc", "softm", "radial"; "polygon", an opening formed by blades; "image", a kernel
            of any shape, resolved to the dot's size; or "auto": the cheapest that reaches `accuracy_db`.
        model: "forward" or "ratio".
        accuracy_db: PSNR on a natural image against the free profile `radial` that "auto" requires of a family.
        source: represents the sharp dot. "image": its picture; "dot": an ideal round dot; "auto": the ideal
            dot if it explains the picture within its noise, or if that is clipped.
        magnification: expected size of the dot in the blurred picture over its size in the sharp one.
        fit_magnification: True fits it, False keeps the expected one, None fits it if the pictures contradict the
            expected one by more than 3.5 standard errors.
        white: level from which pixels are clipped; None searches for a plateau.
        knots: number of values of a "radial" profile; None uses two for each pixel.
        reach: end of a "radial" profile, px; None uses a fitted soft disc.
        aperture: the lens's opening as seen in `blurred`, if known, for the family "image"; only its size is fitted.
        softness: sigma of the sharp dot's edge in focus, px, if it is known to be less than in `sharp`.
        like: a fit of the same lens at a slightly different blur; its shape is expected if it has the same family.
        files: names of the two pictures, for messages.

    Returns:
        A `BlurFit` with lengths in pixels.

    Raises:
        FitError: invalid arguments, or problems of the capture, see its `kind`. Doubtful results give a `FitWarning`.

    Reference:
        Sato, Dobashi, Yamamoto, section 2 (model="ratio").

    Example:
        >>> import torch
        >>> from torchdof.optics import psf
        >>> dot, blur = (psf.pixel_kernels("disc", {"radius": radius}) for radius in (6.0, 8.0))
        >>> sharp = torch.nn.functional.pad(dot, (20, 20, 20, 20))  # a picture of a dot
        >>> blurred = torch.nn.functional.conv2d(sharp[None, None], blur[None, None], padding=8)[0, 0]
        >>> fit = fit_pair(sharp.numpy(), blurred.numpy())
        >>> fit.family, round(fit.params["radius"], 3)
        ('disc', 8.0)
    """
    _refuse(**locals())
    data = a_picture("blurred", blurred, _MIN_WINDOW_PX, files[1])
    sharp_picture = None if sharp is None else a_picture("sharp", sharp, _MIN_WINDOW_PX, files[0])
    if sharp_picture is not None and sharp_picture.shape != data.shape:
        shapes = f"{list(sharp_picture.shape)} and {list(data.shape)}"
        raise FitError(f"sharp and blurred must have the same shape, got {shapes}; cut the same window from both")
    if model == "ratio":  # errors common to a spoke enter the standard errors
        if sharp_picture is None:
            raise FitError("model='ratio' divides by the sharp picture, got sharp=None; use model='forward'")
        r, strength, spokes = blur_strength(sharp_picture, data)
        return replace(fit_profile(r, strength, "ring" if family == "auto" else family, groups=spokes), model="ratio")
    with threadpool_limits(limits=1):  # the steps of a fit are too small for more threads
        pair, edge, linear = prepared_pair(sharp_picture, data, source, magnification, white, files, softness)
        pair.fit_moves = ALL_MOVES if fit_magnification and sharp is not None else ("dx", "dy")
        pair.opening, pair.like = aperture or Aperture(), like
        free_profile, end = family in ("auto", "radial", *OPENINGS) and aperture is None, 0.0
        # a free profile gives an unbiased magnification, unlike a wrong family; it ends slightly outside a soft disc
        solution = pair.solve("softm" if free_profile else family)
        if free_profile:
            radius, sigma = float(solution.params["radius"]), float(solution.params["sigma"])
            end = min(radius + 3.5 * sigma + 1.0 if reach is None else reach, pair.half - 1.0)
            solution = solve_radial(pair, solution.moves, end, knots)
        expected = freest = solution
        if sharp is not None and fit_magnification is None:
            free_pair = replace(pair, fit_moves=ALL_MOVES)
            free = solve_radial(free_pair, solution.moves, end, knots) if free_profile else free_pair.solve(family)
            if _contradicts(pair, solution, free):
                pair, freest, solution = free_pair, free, free
        why, opening, pair.held_magnification = "", None, freest.moves["magnification"]
        if free_profile and family == "auto":
            solution, why, opening = _cheapest(pair, freest, accuracy_db)
        elif free_profile and family in OPENINGS:
            opening = (solve_polygon if family == "polygon" else solve_image)(freest), ""
        if opening is not None:
            solution, why = opening
            freest = expected = solution
        fit = describe(solution, why)
        # warn about the pictures by the freest kernel's residual; a family chosen for its cost adds some
        freest_fit = fit if freest is solution else describe(freest, "")
        check_fit(solution, fit, files[1], freest_fit)
        if edge is not None:
            # not after a report of a large residual; that of a smooth picture of a kernel depends on the level
            largest_ratio = EXPLAINED if freest.family in OPENINGS else FAR_ABOVE
            is_large = min(fit.radius, edge.radius * fit.magnification) > _MIN_RADIUS_PX
            if linear and is_large and freest_fit.residual_over_noise < largest_ratio:
                check_levels(freest, expected, edge, files[1])
            check_focus(edge, fit.radius, pair.source.ideal, files[0])
    return fit


def _refuse(
    family: str,
    model: Model,
    accuracy_db: float,
    source: SourceKind,
    magnification: float,
    fit_magnification: bool | None,
    knots: int | None,
    aperture: Aperture | None,
    like: BlurFit | None,
    **others: Any,
) -> None:
    """Refuses arguments of :func:`fit_pair` other than the pictures."""
    checked(choice, "family", family, ("auto", *SHAPES))
    checked(choice, "model", model, get_args(Model))
    checked(choice, "source", source, get_args(SourceKind))
    checked(number, "accuracy_db", accuracy_db, unit="dB")
    checked(number, "magnification", magnification, 1e-3, 1e3)  # a larger ratio makes one dot invisible
    for name, least in (("white", -1e100), ("reach", 0), ("softness", -1e-9)):
        if others[name] is not None:
            checked(number, name, others[name], least, 1e100)
    if knots is not None:
        checked(whole, "knots", knots, 2, 1000)
    if fit_magnification is not None and not isinstance(fit_magnification, bool):
        raise FitError(f"fit_magnification must be True, False or None, got {show(fit_magnification)}")
    if aperture is not None and (not isinstance(aperture, Aperture) or family != "image"):
        raise FitError(f"aperture must be an Aperture, and goes with family='image', got {show(aperture)}")
    if like is not None and not isinstance(like, BlurFit):
        raise FitError(f"like must be a BlurFit, the result of a fit, got {show(like)}")


def _contradicts(pair: Forward, held: Solution, free: Solution) -> bool:
    """Whether the pictures contradict the expected magnification: a free one explains them significantly better."""
    # scale of chi squared: the residual or, without noise, a spline's rounding; correlated noise counts less
    squares, free_squares = (float(one.residual @ one.residual) for one in (held, free))
    scale = max(free_squares / pair.values.size, (1e-4 * pair.unit) ** 2)
    return (squares - free_squares) / scale * independent_share(pair.noise_correlation) > _MIN_CHI_GAIN


def _cheapest(pair: Forward, freest: Solution, accuracy_db: float) -> tuple[Solution, str, tuple[Solution, str] | None]:
    """The cheapest family that is accurate enough, why, and an opening that explains more than that, if there is one.

    Every family is fitted at the free profile's magnification; the chosen one is then fitted with it.
    """
    held_pair = replace(pair, fit_moves=("dx", "dy"))
    solutions = {"radial": freest} | {f: held_pair.solve(f) for f in COST[:-1]}
    kernels, bic = {f: s.kernel for f, s in solutions.items()}, {f: bic_of(s) for f, s in solutions.items()}
    chosen, why = choose(kernels, bic, accuracy_db)
    is_final = chosen == "radial" or pair.fit_moves != ALL_MOVES
    solution = solutions[chosen] if is_final else pair.solve(chosen)
    opening = solve_opening(freest)
    if opening is not None and looks_alike(solution.kernel, opening[0].kernel, accuracy_db):
        opening = None
    return solution, why, opening


def prepared_pair(
    sharp_picture: Array | None,
    data: Array,
    source: SourceKind = "auto",
    magnification: float = 1.0,
    white: float | None = None,
    files: tuple[str | None, str | None] = (None, None),
    softness: float | None = None,
) -> tuple[Forward, Edge | None, bool]:
    """The problem to solve, the sharp dot's edge, and whether the sharp picture appears to be in linear light."""
    data_dot = find_dot(data, file=files[1])
    used = used_pixels(data, data_dot, white, files[1])
    check_blacks(data, data_dot, files[1])
    if sharp_picture is None:
        return Forward(point_source(data.shape, data_dot), data, used, data_dot, magnification), None, False
    dot = find_dot(sharp_picture, file=files[0])
    check_blacks(sharp_picture, dot, files[0])
    clipped_levels = sharp_picture[~used_pixels(sharp_picture, dot, white, files[0], refuse=False)]
    clipped = clipped_levels.size
    edge = soft_edge(sharp_picture, dot, white=float(clipped_levels.min()) if clipped else None)
    if softness is not None and softness < edge.softness:
        source, edge = "dot", edge.with_softness(softness)
    linear = clipped > 0 or softness is not None or check_linearity(sharp_picture, dot, edge, files[0])
    if (radius := edge.radius * magnification) < _MIN_DOT_PX:
        text = f"by its distance the dot has a radius of {radius:.2g} px here, too small to see; is that in metres?"
        raise FitError(text, "distance", files[1])
    if clipped:
        text = f"{clipped} pixels of the sharp picture are clipped; an ideal dot of {edge.radius:.2f} px stands for it"
        warn(text, "saturated", files[0])
    # Magnification makes two errors of a few thousandths, which an ideal dot does not have: in a spline between the
    # pixels of a hard edge, and in the sensor's softness, which does not grow with the dot.
    unexplained = edge.rms * np.sqrt(max(1 - 1 / max(edge.misfit, 1e-9) ** 2, 0.0))
    softness_matters = edge.softness**2 * abs(1 - magnification**2) > _MIN_VARIANCE
    edge_fits = edge.misfit < EXPLAINED or (edge.rms < _MAX_EDGE_RMS and magnification != 1)
    explained = (edge_fits or (softness_matters and unexplained < _MAX_UNEXPLAINED)) and edge.radius > 2 * edge.softness
    ideal = clipped or source == "dot" or (source == "auto" and explained)
    drawn = ideal_dot(edge) if ideal else picture_of_dot(sharp_picture, dot)
    pair = Forward(drawn, data, used, data_dot, magnification)
    pair.shot_noise = edge.shot_noise / edge.level
    pair.fine_share_of_light = fine_share_inside(sharp_picture, dot)
    return pair, edge, linear
