"""One pair of pictures, sharp and defocused, to one fitted kernel."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from torchdof.kernel import FAMILIES

from .choose import COST, choose
from .clipped import used_pixels
from .dot import find_dot, noise_of
from .doubt import EXPLAINED, asymmetry_of, doubt_forward, doubt_linearity, signal_pixels
from .edge import soft_edge
from .forward import Forward, Solution
from .gaussian import fit_profile
from .problems import FitError, NonFiniteError, NotInFocusWarning, SaturatedWarning, warn
from .profile import blur_strength
from .radial import solve_radial
from .result import Array, BlurFit
from .solve import information_criterion
from .source import IdealDot, PictureOfDot, point_source

__all__ = ["fit_pair"]

Model = Literal["forward", "ratio"]
SourceKind = Literal["auto", "image", "dot"]

_SMALLEST_WINDOW = 15
_SOFT = 1.5  # px: an edge softer than this is not in focus
_SIGNIFICANT = 12.0  # drop of chi squared that calls for a fitted magnification: 3.5 sigma


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
    start: BlurFit | None = None,
    knots: int | None = None,
    files: tuple[str | None, str | None] = (None, None),
) -> BlurFit:
    """The kernel that turns a picture of a sharp dot into the picture of the same dot out of focus.

    The forward model explains every pixel of the window: `blurred = gain * (kernel convolved with the sharp picture,
    moved and magnified) + background`. Exposure, stray light, displacement and magnification are fitted, so they do
    not bias the kernel. The kernel is pixel-integrated and acts on the picture's pixels, as in rendering: it is what
    turns *this* sharp picture into *this* blurred one (a pixel's own blur, 1/12 px^2 of variance, is already in both).

    `model="ratio"` is the paper's: `blurred / sharp` along spokes inside the dot, then eq. (1). It measures the dot
    convolved with the kernel, so its widths depend on the dot. Use it to compare with the paper.

    Args:
        sharp: `[H, W]`, linear light, the dot in focus on a dark ground; None for a point of light (a star).
        blurred: `[H, W]`, linear light, the same dot out of focus, the whole blur inside the window.
        family: "gaussian", "ring", "disc", "softm", "radial", or "auto": the cheapest that reaches `accuracy_db`.
        model: "forward" or "ratio".
        accuracy_db: PSNR on a natural image that "auto" asks of a family, against the free profile `radial`.
        source: what stands for the sharp dot. "image": its picture; "dot": an ideal round dot fitted to it, which has
            no noise; "auto": the ideal one where it explains the picture to within its noise, or the picture is clipped.
        magnification: expected size of the dot in the blurred picture over its size in the sharp one.
        fit_magnification: True fits it, False holds it, None fits it only where the pictures contradict the expected
            one by more than 3.5 standard errors. Where it is held, the standard errors take it as known.
        white: level at and above which a pixel is clipped; None looks for a plateau.
        start: a fit of a similar pair, to start from (several distances of one lens).
        knots: number of values of a "radial" profile; None takes two a pixel.
        files: names of the two pictures, for errors and warnings.

    Returns:
        A `BlurFit` with lengths in pixels.

    Raises:
        FitError: wrong shapes, family or model; or one of its kinds, named after what is wrong with the capture.

    Warns:
        FitWarning: one of its kinds; the result is given, and what to doubt about it.

    Reference:
        Sato, Dobashi, Yamamoto, section 2 (model="ratio").

    Example:
        >>> import torch
        >>> from torchdof import kernel
        >>> sharp = torch.nn.functional.pad(kernel.disc(6.0), (20, 20, 20, 20))  # a picture of a dot
        >>> blurred = torch.nn.functional.conv2d(sharp[None, None], kernel.disc(8.0)[None, None], padding=8)[0, 0]
        >>> fit = fit_pair(sharp.numpy(), blurred.numpy())
        >>> fit.family, round(fit.params["radius"], 3)
        ('disc', 8.0)
    """
    if family not in (*FAMILIES, "auto"):
        raise FitError(f"family must be 'auto' or one of {', '.join(FAMILIES)}, got {family!r}")
    if model not in get_args(Model) or source not in get_args(SourceKind):
        raise FitError(f"model must be 'forward' or 'ratio', source 'auto', 'image' or 'dot'; got {model!r}, {source!r}")
    if not (0 < magnification < np.inf):
        raise FitError(f"magnification must be positive, got {magnification}", number=magnification)
    data = _picture("blurred", blurred, files[1])
    still = None if sharp is None else _picture("sharp", sharp, files[0])
    if still is not None and still.shape != data.shape:
        raise FitError(
            f"sharp and blurred must have the same shape, got {list(still.shape)} and {list(data.shape)}; "
            "cut the same window from both"
        )
    if model == "ratio":
        if still is None:
            raise FitError("model='ratio' divides by the sharp picture, got sharp=None; use model='forward'")
        return _ratio(still, data, "ring" if family == "auto" else family)
    pair = _prepare(still, data, source, magnification, white, files)
    if start is not None and start.family in FAMILIES:
        pair.start[start.family] = {k: float(v) for k, v in start.params.items() if not isinstance(v, np.ndarray)}
    held = _held(pair, fit_magnification, sharp is None)
    solutions = {f: pair.solve(f) for f in (COST[:-1] if family in ("auto", "radial") else (family,))}
    if held is None and _needs_magnification(pair, solutions):
        pair.fit_moves = ("dx", "dy", "magnification")
        solutions = {f: pair.solve(f) for f in solutions}
    why, psnr = "", {}
    if family in ("auto", "radial"):
        likeliest = min(solutions.values(), key=lambda s: s.squares)
        solutions["radial"] = solve_radial(pair, likeliest, _reach(pair, solutions["softm"]), knots)
        if family == "auto":
            kernels = {f: pair.kernels(f, _lists(s))[0] for f, s in solutions.items()}
            family, why, psnr = choose(kernels, {f: _bic(pair, s) for f, s in solutions.items()}, accuracy_db)
    fit = _finish(pair, solutions[family], why)
    doubt_forward(pair, solutions[family], fit, files)
    return replace(fit, psnr=psnr)


def _picture(name: str, picture: ArrayLike, file: str | None) -> Array:
    try:
        array = np.asarray(picture)
        if array.dtype == bool or not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
            raise TypeError
        array = array.astype(np.float64)
    except (TypeError, ValueError, RuntimeError):
        raise FitError(f"{name} must be an array of real numbers [H, W] in linear light", file=file) from None
    if array.ndim != 2 or min(array.shape) < _SMALLEST_WINDOW:
        raise FitError(
            f"{name} must be [H, W] with at least {_SMALLEST_WINDOW} pixels on a side, got {list(array.shape)}; "
            "fit the colours of a picture one by one",
            file=file,
        )
    bad = int(np.sum(~np.isfinite(array)))
    if bad:
        raise NonFiniteError(f"{bad} pixels of {name} are NaN or infinite", file=file, number=float(bad))
    return array


def _ratio(still: Array, data: Array, family: str) -> BlurFit:
    r, strength, spokes = blur_strength(still, data)
    return replace(fit_profile(r, strength, family, groups=spokes), model="ratio")


def _prepare(
    still: Array | None,
    data: Array,
    source: SourceKind,
    magnification: float,
    white: float | None,
    files: tuple[str | None, str | None],
) -> Forward:
    """Find the dots, leave out what is clipped, doubt the focus, and decide what stands for the sharp dot."""
    data_dot = find_dot(data, file=files[1])
    used = used_pixels(data, data_dot, white, files[1], "blurred")
    if still is None:
        return Forward(point_source(data.shape, data_dot), data, used, data_dot, magnification)
    dot = find_dot(still, file=files[0])
    whole = used_pixels(still, dot, white, files[0], "sharp", refuse=False)
    clipped = int(np.sum(~whole))
    edge = soft_edge(still, dot, white=float(still[~whole].min()) if clipped else None)
    if edge.softness > _SOFT and edge.radius > 2 * _SOFT:
        warn(
            NotInFocusWarning(
                f"the sharp picture is soft: its dot's edge has a width of {edge.softness:.1f} px (at most {_SOFT}); "
                "focus on the dot, or expect a kernel that is too small",
                file=files[0],
                number=edge.softness,
            ),
            stacklevel=4,
        )
    if not clipped:
        doubt_linearity(still, dot, edge, files[0])
    if clipped:
        warn(
            SaturatedWarning(
                f"{clipped} pixels of the sharp picture are clipped; an ideal dot of radius {edge.radius:.2f} px stands "
                "in for it",
                file=files[0],
                number=float(clipped),
            ),
            stacklevel=4,
        )
    explained = edge.misfit < EXPLAINED and edge.radius > 2 * edge.softness
    if clipped or source == "dot" or (source == "auto" and explained):
        return Forward(IdealDot.of(dot, edge), data, used, data_dot, magnification)
    return Forward(PictureOfDot.of(still, dot), data, used, data_dot, magnification)


def _held(pair: Forward, fit_magnification: bool | None, point: bool) -> bool | None:
    """Whether the magnification is settled before the fit: a point has none."""
    held = True if point else None if fit_magnification is None else not fit_magnification
    pair.fit_moves = ("dx", "dy", "magnification") if held is False else ("dx", "dy")
    return held


def _needs_magnification(pair: Forward, solutions: dict[str, Solution]) -> bool:
    family = min(solutions, key=lambda f: solutions[f].squares)
    held = solutions[family]
    free = Forward(pair.source, pair.data, pair.used, pair.data_dot, pair.magnification)
    free.start[family] = {k: float(v) for k, v in held.params.items()}
    squares = free.solve(family).squares
    # the scale of chi squared: what remains, or the rounding of a spline where there is no noise
    floor = max(squares / pair.values.size, (1e-4 * pair.unit) ** 2)
    return (held.squares - squares) / floor > _SIGNIFICANT


def _reach(pair: Forward, soft: Solution) -> float:
    """Where a free profile may end: a little beyond what the soft disc says."""
    reach = float(soft.params["radius"]) + 3.5 * float(soft.params["sigma"]) + 1.0
    return min(reach, pair.half - 1.0)


def _lists(solution: Solution) -> dict[str, Array]:
    return {k: np.asarray(v, dtype=np.float64)[None] for k, v in solution.params.items()}


def _bic(pair: Forward, solution: Solution) -> float:
    floor = pair.values.size * (1e-6 * pair.unit) ** 2
    return information_criterion(
        solution.squares + floor, pair.values.size, _free_parameters(solution) + len(pair.fit_moves) + 2
    )


def _free_parameters(solution: Solution) -> int:
    if solution.family == "radial":
        return int(np.sum(np.asarray(solution.params["values"]) > 0))
    return len(FAMILIES[solution.family])


def _finish(pair: Forward, solution: Solution, why: str) -> BlurFit:
    near = signal_pixels(pair)
    light = pair.data[near] - solution.background
    size = float(np.sqrt(np.sum(light**2)))
    error = pair.data[near] - solution.model[near]
    kernel = pair.kernels(solution.family, _lists(solution))[0]
    through = (solution.gain * pair.source.noise) ** 2 * float(np.sum(kernel**2))
    spread = np.sqrt(np.diag(solution.covariance))
    if solution.family == "radial":
        stderr: dict[str, float | Array] = {"values": spread, "radius": 0.0}
    else:
        stderr = {n: float(s) for n, s in zip(solution.names, spread, strict=True) if n in solution.params}
    return BlurFit(
        family=solution.family,
        params=dict(solution.params),
        stderr=stderr,
        residual=float(np.sqrt(np.sum(error**2))) / size,
        noise=float(np.sqrt(error.size * (own_noise(pair, solution, near) ** 2 + through))) / size,
        covariance=solution.covariance,
        names=solution.names,
        bic=_bic(pair, solution),
        count=pair.values.size,
        model="forward",
        gain=solution.gain,
        background=solution.background,
        shift=(
            pair.data_dot.x + solution.moves["dx"] - pair.source.dot.x,
            pair.data_dot.y + solution.moves["dy"] - pair.source.dot.y,
        ),
        magnification=solution.moves["magnification"],
        asymmetry=asymmetry_of(pair, solution),
        why=why,
        samples=_samples(pair, solution),
        curve=_samples(pair, solution, modelled=True),
    )


def own_noise(pair: Forward, solution: Solution, near: Array) -> float:
    """Noise of the blurred picture's pixels where the light is: what varies from pixel to pixel in the residual."""
    residual = np.where(pair.used, pair.data - np.nan_to_num(solution.model), 0.0)
    rows = residual[:, 2:] - 2 * residual[:, 1:-1] + residual[:, :-2]
    both = (rows[2:] - 2 * rows[1:-1] + rows[:-2]) / 6.0
    inside = near[1:-1, 1:-1]
    here = float(np.sqrt(np.mean(both[inside] ** 2))) if inside.any() else 0.0
    return max(here, noise_of(pair.data))


def _samples(pair: Forward, solution: Solution, modelled: bool = False) -> Array:
    """Radii and levels over gain of the blurred picture (or its model) around its centre, for the picture of a fit."""
    x, y = pair.data_dot.x + solution.moves["dx"], pair.data_dot.y + solution.moves["dy"]
    rows, columns = np.indices(pair.data.shape)
    distance = np.hypot(columns - x, rows - y)
    near = (distance <= 1.2 * pair.data_dot.reach) & pair.used
    levels = (solution.model if modelled else pair.data)[near] - solution.background
    order = np.argsort(distance[near])
    scale = solution.gain if solution.gain > 0 else 1.0
    return np.stack([distance[near][order], levels[order] / scale])
