"""The forward model: defocused picture = gain * (kernel convolved with the moved sharp picture) + background.

Gain and background are linear: they are solved for given values of the other parameters (variable projection).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.fft import irfft2, next_fast_len, rfft2

from torchdof.optics.aperture import Aperture
from torchdof.optics.psf import FAMILIES, LENGTHS, pixel_kernels, support

from ..result import Array, BlurFit, Mask
from ..solve import best_of, inverse
from .dot import Dot, correlate, correlation_of, distance_from, independent_share, noise_beside
from .expected_shape import deviations
from .source import Source

ALL_MOVES = ("dx", "dy", "magnification")
# parameters of kernels that are not round: discs seen through a lens's opening
OPENINGS = {"polygon": ("radius", "rotation_deg", "curvature"), "image": ("radius",)}
SHAPES = {**FAMILIES, **OPENINGS}  # parameters of all kernels
_STARTS = {  # lengths relative to the increase of the dot's standard deviation along an axis
    "gaussian": [{"sigma": 1.0}, {"sigma": 0.5}],
    "disc": [{"radius": 2.0}, {"radius": 1.7}],
    "image": [{"radius": 2.0}, {"radius": 2.8}],
    "ring": [{"sigma": 0.9, "r_c": 0.2}, {"sigma": 0.6, "r_c": 0.9}, {"sigma": 0.25, "r_c": 1.3}],
    "softm": [{"radius": 2.0, "sigma": 0.15, "b": 0.0, "m": 2.0}, {"radius": 1.7, "sigma": 0.4, "b": 0.5, "m": 3.0}],
}
_STEP = {"dx": 1e-4, "dy": 1e-4, "magnification": 1e-5}  # of finite differences of the moves


@dataclass
class Forward:
    """A pair of pictures, prepared for fitting any family."""

    source: Source  # represents the sharp dot
    data: Array  # the defocused picture [H, W]
    used: Mask  # pixels that are fitted [H, W]
    dot: Dot  # the blurred dot
    magnification: float = 1.0  # expected size of the dot in the blurred picture over that in the sharp one
    fit_moves: tuple[str, ...] = ALL_MOVES  # fitted moves
    held_magnification: float | None = None  # initial or fixed value; None is the expected one
    shot_noise: float = 0.0  # growth of a pixel's noise variance (by second differences) with its level
    fine_share_of_light: float | None = None  # share of that growth seen in second differences; None: the dark paper's
    opening: Aperture = Aperture()  # of the lens, for the kernels in OPENINGS: blades or an image
    like: BlurFit | None = None  # of a similar blur, whose shape is expected

    def __post_init__(self) -> None:
        self.half = min(self.data.shape) // 2  # half the window, px: limits the kernel
        self.grid = tuple(next_fast_len(n + self.half + 1, real=True) for n in self.data.shape)  # for FFTs
        self.values = self.data[self.used]  # [pixels used]
        self.distance = distance_from(self.dot, self.data.shape)  # of each pixel from the blurred dot's centre, px
        self.lit = self.used & (self.distance <= self.dot.reach + 1)  # lit pixels
        # correlation of the paper's noise, and the share of it seen in second differences
        dark = self.used & (self.distance > self.dot.reach + 2)
        self.noise_correlation, self.fine_share = noise_beside(self.data, self.dot.background, dark)
        # the largest level, so that one tolerance suits all pictures
        self.unit = max(float(np.abs(self.values - self.dot.background).max()), np.finfo(float).tiny)
        # standard deviation of an independent pixel; without noise, of a spline's rounding
        variance = self.dot.noise**2 / self.fine_share / independent_share(self.noise_correlation)
        self.noise = float(np.sqrt(variance + (1e-4 * self.unit) ** 2))

    def drawn(self, moves: Mapping[str, float]) -> Array:
        """The displaced and magnified source `[H, W]`."""
        x, y = self.dot.x + moves["dx"], self.dot.y + moves["dy"]
        return self.source.draw(self.data.shape, x, y, moves["magnification"])

    def blurred(self, source: Array, kernels: Array) -> Array:
        """Convolves pictures `[H, W]` or `[n, H, W]` with kernels `[n, k, k]`: `[n, H, W]`."""
        half, (height, width) = kernels.shape[-1] // 2, self.data.shape
        blurred = irfft2(rfft2(source, self.grid) * rfft2(kernels, self.grid), self.grid)
        return np.asarray(blurred[:, half : half + height, half : half + width])

    def picture(self, values: Array) -> Array:
        """Pictures `[..., H, W]` from values of the used pixels `[..., pixels used]`; 0 elsewhere."""
        pictures = np.zeros((*values.shape[:-1], *self.data.shape))
        pictures[..., self.used] = values
        return pictures

    def kernels(self, family: str, params: Mapping[str, Any], widest: int | None = None) -> Array:
        """Kernels `[n, k, k]` for parameters `[n]`, as wide as needed, at most `widest` px or the window."""
        tensors = {k: torch.from_numpy(np.atleast_1d(v)) for k, v in params.items()}
        reach = float(tensors["radius"].max()) if family in OPENINGS else support(family, tensors)
        size = 2 * min(int(np.ceil(reach)) + 1, self.half if widest is None else widest) + 1
        if family not in OPENINGS:
            return pixel_kernels(family, tensors, size).numpy()
        openings = [self.opening_with({n: v[i] for n, v in tensors.items()}) for i in range(len(tensors["radius"]))]
        shapes = zip(tensors["radius"], openings, strict=True)
        return torch.stack([pixel_kernels("disc", {"radius": r}, size, o) for r, o in shapes]).numpy()

    def opening_with(self, params: Mapping[str, Any]) -> Aperture:
        """The lens's opening with these of its parameters."""
        changed: dict[str, Any] = {n: float(params[n]) for n in ("rotation_deg", "curvature") if n in params}
        return replace(self.opening, **changed)

    def solve(self, family: str, start: Mapping[str, float] | None = None) -> Solution:
        """Fits one family, from given kernel parameters or from several shapes."""
        shape = SHAPES[family]
        names = (*shape, *self.fit_moves)
        # shapes with the second moment that the blur has added
        added_variance = (self.dot.radius**2 - (self.magnification * self.source.radius) ** 2) / 4
        size = min(float(np.sqrt(max(added_variance, 0.15))), self.half / 3)
        shapes = [{n: v * size if n in LENGTHS else v for n, v in s.items()} for s in _STARTS.get(family, ())]
        starts = [self.moves({}) | dict(one) for one in (shapes if start is None else [start])]

        def shaped(p: Array) -> Array:
            source = self.drawn(self.moves(dict(zip(names, p, strict=True))))
            return self.blurred(source, self.kernels(family, dict(zip(shape, p, strict=False))))[0][self.used]

        def model(p: Array) -> Array:  # the used pixels, then how unusual the shape is
            return np.append(self.project(shaped(p))[0], self.noise * deviations(family, p, self.like)[0]) / self.unit

        def jacobian(p: Array) -> Array:
            shape_slopes = self.noise * deviations(family, p, self.like)[1]
            return np.vstack([self._jacobian(family, names, p), shape_slopes]) / self.unit

        points = [np.array([one[n] for n in names]) for one in starts]
        data = np.append(self.values, 0.0 * deviations(family, points[0], self.like)[0]) / self.unit
        numbers = best_of(model, data, points, self.bounds(names), jacobian=jacobian, tolerance=1e-7)
        params = dict[str, float | Array](zip(shape, numbers.tolist(), strict=False))
        moves = self.moves(dict(zip(names, numbers.tolist(), strict=True)))
        (fitted, gain, background), slopes = self.project(shaped(numbers)), self._jacobian(family, names, numbers)
        shape_slopes = self.noise * deviations(family, numbers, self.like)[1]
        penalty, kernel = shape_slopes.T @ shape_slopes, self.kernels(family, params)[0]
        covariance = self.covariance(slopes, self.values - fitted, kernel, gain, penalty, self.noise**2 * penalty)
        return Solution(self, family, params, moves, gain, background, fitted, names, covariance, slopes)

    def moves(self, params: Mapping[str, float]) -> dict[str, float]:
        """The fitted moves, completed by the fixed ones."""
        magnification = self.magnification if self.held_magnification is None else self.held_magnification
        fixed = {"dx": 0.0, "dy": 0.0, "magnification": magnification}
        return {n: params.get(n, value) for n, value in fixed.items()}

    def covariance(
        self,
        slopes: Array,
        residual: Array,
        kernel: Array,
        gain: float,
        penalty: Array | float = 0.0,
        penalty_covariance: Array | float = 0.0,
    ) -> Array:
        """Covariance of the parameters under the noise of both pictures (a sandwich estimator).

        The `penalty` `[parameters, parameters]` is added to the information of the pictures; the covariance of its
        gradient is 0 if it only smooths.
        """
        information_inverse = inverse(slopes.T @ slopes + penalty)
        is_determined = np.isfinite(np.diag(information_inverse))
        information_inverse = np.where(np.outer(is_determined, is_determined), information_inverse, 0.0)
        full = self.picture(residual)
        variance = float(np.sum(full[self.lit] ** 2)) / max(int(self.lit.sum()) - slopes.shape[1] - 2, 1)
        # few pixels determine the correlation badly; the paper has many, if its noise is similar
        residual_correlation = correlation_of(full, self.used & (self.distance <= self.dot.reach + 2))
        correlation = max(self.noise_correlation, residual_correlation, key=np.sum)
        source_variance = (gain * self.source.noise) ** 2 / self.fine_share
        # the sharp picture's noise passes through the kernel, which correlates it; the rest is the defocused picture's
        own_variance = max(variance - source_variance * float(np.sum(kernel**2)), 0.1 * variance)
        correlated = correlate(self.picture(slopes.T), correlation)[:, self.used].T
        score_cov = own_variance * (slopes.T @ correlated)
        if source_variance > 0:  # (K' J)' (K' J) over the source's pixels with noise
            has_source_noise = self.distance <= self.source.reach * self.magnification
            spread = np.where(has_source_noise, self.blurred(self.picture(slopes.T), kernel[None]), 0.0)
            correlated_spread = correlate(spread, self.noise_correlation)
            score_cov = score_cov + source_variance * np.tensordot(spread, correlated_spread, ((1, 2), (1, 2)))
        covariance = information_inverse @ (score_cov + penalty_covariance) @ information_inverse
        covariance[~is_determined, ~is_determined] = np.inf
        return np.asarray(covariance)

    def project(self, shaped: Array) -> tuple[Array, float, float]:
        """Fits gain and background by linear least squares; returns the model of the used pixels, and both."""
        mean, level = float(shaped.mean()), float(self.values.mean())
        centred = shaped - mean
        size = float(centred @ centred)
        gain = max(float(centred @ (self.values - level)) / size if size > 0 else 0.0, 0.0)
        return level + gain * centred, gain, level - gain * mean

    def _jacobian(self, family: str, names: tuple[str, ...], p: Array) -> Array:
        """Derivatives of the projected model `[pixels used, parameters]` (Kaufman's approximation)."""
        shape, moves = SHAPES[family], self.moves(dict(zip(names, p, strict=True)))
        n, (low, high) = len(shape), self.bounds(shape)
        steps = np.diag(1e-4 * np.maximum(np.abs(p[:n]), 0.1))
        # the values, then one parameter increased in each row, then one decreased
        varied = np.vstack([p[:n], np.minimum(p[:n] + steps, high), np.maximum(p[:n] - steps, low)])
        kernels = self.kernels(family, dict(zip(shape, varied.T, strict=True)))
        widths = np.diag(varied[1 : n + 1] - varied[n + 1 :])
        kernel_slopes = (kernels[1 : n + 1] - kernels[n + 1 :]) / widths[:, None, None]
        blurred = self.blurred(self.drawn(moves), np.concatenate([kernels[:1], kernel_slopes]))[:, self.used]
        columns = np.concatenate([blurred[1:], self.move_columns(moves, names[n:], kernels[0])]).T
        return without_level(self.project(blurred[0])[1] * columns, blurred[0])

    def move_columns(self, moves: Mapping[str, float], names: tuple[str, ...], kernel: Array) -> Array:
        """Derivatives of the blurred source with respect to displacement and magnification `[n, pixels used]`."""
        still = self.drawn(moves)
        changes = [(self.drawn({**moves, n: moves[n] + _STEP[n]}) - still) / _STEP[n] for n in names]
        return self.blurred(np.stack(changes), kernel[None])[:, self.used]

    def bounds(self, names: tuple[str, ...]) -> tuple[list[float], list[float]]:
        """Lower and upper bounds of the named parameters."""
        shift = max(2.0, 0.3 * self.dot.radius)
        table = {
            **{"sigma": (0.05, self.half), "r_c": (0.0, self.half), "radius": (0.1, self.half), "m": (0.5, 12.0)},
            **{"b": (-0.98, 8.0), "rotation_deg": (-400.0, 400.0), "curvature": (0.0, 1.0)},
            **{"dx": (-shift, shift), "dy": (-shift, shift)},
            "magnification": (0.7 * self.magnification, 1.4 * self.magnification),
        }
        return [table[n][0] for n in names], [table[n][1] for n in names]


def without_level(columns: Array, shaped: Array) -> Array:
    """Removes from the columns their components along the gain's and the background's derivatives."""
    basis = np.stack([np.ones_like(shaped), shaped - shaped.mean()], axis=1)
    basis = basis / np.maximum(np.linalg.norm(basis, axis=0), np.finfo(float).tiny)
    return np.asarray(columns - basis @ (basis.T @ columns))


@dataclass(frozen=True)
class Solution:
    """The kernel and moves that best explain a pair of pictures, with their covariance and residuals."""

    pair: Forward
    family: str
    params: dict[str, float | Array]
    moves: dict[str, float]
    gain: float
    background: float
    fitted: Array  # the model of the defocused picture [pixels used]
    names: tuple[str, ...]  # of the covariance's parameters
    covariance: Array
    slopes: Array  # derivatives of the model [pixels used, parameters]

    @cached_property
    def kernel(self) -> Array:
        """The kernel `[k, k]`."""
        return self.pair.kernels(self.family, self.params)[0]

    @property
    def centre(self) -> tuple[float, float]:
        """(x, y) of the blurred dot, px."""
        return self.pair.dot.x + self.moves["dx"], self.pair.dot.y + self.moves["dy"]

    @property
    def residual(self) -> Array:
        """Data minus model `[pixels used]`."""
        return self.pair.values - self.fitted
