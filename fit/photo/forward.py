"""The forward model: defocused picture = gain * (kernel convolved with the moved sharp picture) + background.

The model is compared with all pixels of the window and divides nothing, so dot size, exposure, stray light,
displacement and magnification do not bias the kernel. Gain and background are linear and are solved for given values of
the other parameters (variable projection): the kernel's parameters, displacement and magnification.
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

from ..result import Array, Mask
from ..solve import best_of, inverse
from .dot import Dot, distance_from
from .noise import correlate, correlation_of, noise_beside
from .source import Source

ALL_MOVES = ("dx", "dy", "magnification")
OPENINGS = {"polygon": ("radius", "rotation_deg", "curvature"), "image": ("radius",)}
"""Parameters of kernels that are not round: discs seen through a lens's opening."""

SHAPES = {**FAMILIES, **OPENINGS}
"""Parameters of all kernels."""

_STARTS = {  # lengths relative to the increase of the dot's standard deviation along an axis
    "gaussian": [{"sigma": 1.0}, {"sigma": 0.5}],
    "disc": [{"radius": 2.0}, {"radius": 1.7}],
    "ring": [{"sigma": 0.9, "r_c": 0.2}, {"sigma": 0.6, "r_c": 0.9}, {"sigma": 0.25, "r_c": 1.3}],
    "softm": [{"radius": 2.0, "sigma": 0.15, "b": 0.0, "m": 2.0}, {"radius": 1.7, "sigma": 0.4, "b": 0.5, "m": 3.0}],
}
# Finite differences
_LOWER, _UPPER = {"b": -1.0, "rotation_deg": -np.inf}, {"curvature": 1.0}  # limits of the kernel's parameters
_STEP = {"dx": 1e-4, "dy": 1e-4, "magnification": 1e-5}  # steps of the moves

_RMS_DRAWN_PX = 16.0  # px; rms radius at which a PSF is drawn to measure it; larger: more exact, slower


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

    def __post_init__(self) -> None:
        self.pixels = np.indices(self.data.shape).astype(np.float64)  # rows and columns [2, H, W]
        self.half = min(self.data.shape) // 2  # half the window, px: limits the kernel
        self.grid = tuple(next_fast_len(n + self.half + 1, real=True) for n in self.data.shape)  # for FFTs
        margin = int(np.ceil(self.source.reach * self.magnification * 1.4)) + 4
        x, y = int(round(self.dot.x)), int(round(self.dot.y))
        # part of the picture in which the source is drawn
        self.box = (slice(max(y - margin, 0), y + margin + 1), slice(max(x - margin, 0), x + margin + 1))
        self._last_moved: tuple[tuple[float, ...], Array, Array] | None = None
        self.flat = self.used.ravel()
        self.values = self.data[self.used]  # [pixels used]
        self.distance = distance_from(self.dot, self.data.shape)  # of each pixel from the blurred dot's centre, px
        self.lit = self.used & (self.distance <= self.dot.reach + 1)  # lit pixels
        dark = self.used & (self.distance > self.dot.reach + 2)
        # correlation of the paper's noise, and the share of it seen in second differences
        self.noise_correlation, self.fine_share = noise_beside(self.data, self.dot.background, dark)
        # the largest level, so that one tolerance suits all pictures
        self.unit = max(float(np.abs(self.values - self.dot.background).max()), np.finfo(float).tiny)

    def moved_source(self, moves: Mapping[str, float]) -> Array:
        """Fourier transform, on the padded grid, of the displaced and magnified source."""
        return self._moved(moves)[1]

    def _moved(self, moves: Mapping[str, float]) -> tuple[Array, Array]:
        """The displaced and magnified source, and its Fourier transform; the last one is kept.

        A step of the fit needs them twice: for the model and for its derivatives.
        """
        place = tuple(moves[n] for n in ALL_MOVES)
        if self._last_moved is None or self._last_moved[0] != place:
            picture = self._drawn(moves)
            self._last_moved = place, picture, rfft2(picture, self.grid)
        return self._last_moved[1:]

    def _drawn(self, moves: Mapping[str, float]) -> Array:
        rows, columns = self.pixels[(slice(None), *self.box)]
        x, y = self.dot.x + moves["dx"], self.dot.y + moves["dy"]
        picture = np.zeros(self.data.shape)
        picture[self.box] = self.source.draw(rows, columns, x, y, moves["magnification"])
        return picture

    def transformed(self, kernels: Array) -> Array:
        """Fourier transforms, on the padded grid, of kernels `[n, k, k]` with their centres in pixel (0, 0)."""
        wrapped = np.zeros((*kernels.shape[:-2], *self.grid))
        offsets = np.arange(kernels.shape[-1]) - kernels.shape[-1] // 2  # negative ones wrap around
        wrapped[..., offsets[:, None], offsets] = kernels
        return rfft2(wrapped, self.grid)

    def convolve(self, source: Array, kernels: Array, all_pixels: bool = False) -> Array:
        """Convolves a transformed source `[h, w]` or `[n, h, w]` with kernels `[n, k, k]`: `[n, pixels used]`."""
        return self.product(source, self.transformed(kernels), all_pixels)

    def product(self, source: Array, kernels: Array, all_pixels: bool = False) -> Array:
        """Convolves a transformed source with transformed kernels `[n, h, w]`; results as in `convolve`."""
        blurred = irfft2(source * kernels, self.grid)
        flat = blurred[..., : self.data.shape[0], : self.data.shape[1]].reshape(*blurred.shape[:-2], -1)
        return np.asarray(flat if all_pixels else flat[..., self.flat])

    def correlate(self, source: Array, picture: Array, size: int) -> Array:
        """The adjoint of `convolve` for one kernel `[size, size]`, from the used pixels."""
        spread = irfft2(np.conj(source) * rfft2(self.picture(picture), self.grid), self.grid)
        return np.asarray(np.roll(spread, (size // 2, size // 2), (0, 1))[:size, :size])

    def picture(self, values: Array) -> Array:
        """Pictures `[..., H, W]` from values of the used pixels `[..., pixels used]`; 0 elsewhere."""
        pictures = np.zeros((*values.shape[:-1], self.flat.size))
        pictures[..., self.flat] = values
        return pictures.reshape(*values.shape[:-1], *self.data.shape)

    def kernels(self, family: str, params: Mapping[str, Array], widest: int | None = None) -> Array:
        """Kernels `[n, k, k]` for parameters `[n]`, as wide as needed, at most `widest` px or the window."""
        limit = self.half if widest is None else widest
        tensors = {k: torch.from_numpy(np.atleast_1d(v)) for k, v in params.items()}
        if family in OPENINGS:
            radius = tensors["radius"]
            size = 2 * min(int(np.ceil(float(radius.max()))) + 1, limit) + 1
            openings = [self.opening_with({n: v[i] for n, v in tensors.items()}) for i in range(len(radius))]
            shapes = zip(radius, openings, strict=True)
            return torch.stack([pixel_kernels("disc", {"radius": r}, size, o) for r, o in shapes]).numpy()
        half = min(int(np.ceil(support(family, tensors))) + 1, limit)
        return pixel_kernels(family, tensors, 2 * half + 1).numpy()

    def opening_with(self, params: Mapping[str, Any]) -> Aperture:
        """The lens's opening with these of its parameters."""
        changed: dict[str, Any] = {n: float(params[n]) for n in ("rotation_deg", "curvature") if n in params}
        return replace(self.opening, **changed)

    def rms(self, family: str, params: Mapping[str, Array]) -> Array:
        """Rms radius of the PSFs `[n]` for parameters `[n]`, px.

        They are drawn so large that the effect of the kernels' pixels, which are never negative, is negligible.
        """
        lengths = [np.abs(v).max() for n, v in params.items() if n in LENGTHS]
        scale = max(1.0, _RMS_DRAWN_PX / max(lengths))
        scaled = {n: scale * np.asarray(v) if n in LENGTHS else np.asarray(v) for n, v in params.items()}
        kernels = self.kernels(family, scaled, int(np.ceil(scale * self.half)))
        offset = np.arange(kernels.shape[-1]) - kernels.shape[-1] // 2
        return np.asarray(np.sqrt((kernels * (offset[:, None] ** 2 + offset**2)).sum((1, 2))) / scale)

    def solve(self, family: str, start: Mapping[str, float] | None = None) -> Solution:
        """Fits one family, from given kernel parameters or from several shapes."""
        shape = SHAPES[family]
        names = (*shape, *self.fit_moves)
        unmoved, starts = self.moves({}), self._starts(family) if start is None else [start]
        numbers = best_of(
            lambda p: self.project(self._shaped(family, names, p))[0] / self.unit,
            self.values / self.unit,
            [[one[n] if n in one else unmoved[n] for n in names] for one in starts],
            self.bounds(names),
            jacobian=lambda p: self._jacobian(family, names, p) / self.unit,
            tolerance=1e-7,
        )
        params = {n: float(v) for n, v in zip(names, numbers, strict=True)}
        fitted, gain, background = self.project(self._shaped(family, names, numbers))
        slopes = self._jacobian(family, names, numbers)
        kernel = self.kernels(family, {n: np.array([params[n]]) for n in shape})[0]
        covariance = self.covariance(slopes, self.values - fitted, kernel, gain)
        kernel_params: dict[str, float | Array] = {n: params[n] for n in shape}
        moves = self.moves(params)
        return Solution(self, family, kernel_params, moves, gain, background, fitted, names, covariance, slopes)

    def moves(self, params: Mapping[str, float]) -> dict[str, float]:
        """The fitted moves, completed by the fixed ones."""
        magnification = self.magnification if self.held_magnification is None else self.held_magnification
        return {n: params.get(n, magnification if n == "magnification" else 0.0) for n in ALL_MOVES}

    def covariance(
        self, slopes: Array, residual: Array, kernel: Array, gain: float, penalty: Array | float = 0.0
    ) -> Array:
        """Covariance of the parameters under the noise of both pictures (a sandwich estimator).

        With J the model's derivatives and B the inverse of J' J + penalty, it is B M B, where M is the covariance of J'
        (noise). The defocused picture's noise is as large as the residual of the lit pixels, and correlated like the
        residual or the paper. The sharp picture's noise passes through the kernel, which correlates it. Ignoring either
        would make the errors too small. A smoothing penalty `[p, p]` reduces them.
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
        own_variance = max(variance - source_variance * float(np.sum(kernel**2)), 0.1 * variance)
        score_cov = own_variance * (slopes.T @ self.correlated_noise(slopes, correlation))
        if source_variance > 0:  # (K' J)' (K' J) over the source's pixels with noise
            pictures = rfft2(self.picture(slopes.T), self.grid)
            has_source_noise = (self.distance <= self.source.reach * self.magnification).ravel()
            spread = np.where(has_source_noise, self.convolve(pictures, kernel[None], all_pixels=True), 0.0)
            correlated_spread = correlate(spread.reshape(-1, *self.data.shape), self.noise_correlation)
            score_cov = score_cov + source_variance * (spread @ correlated_spread.reshape(spread.shape).T)
        covariance = information_inverse @ score_cov @ information_inverse
        covariance[~is_determined, ~is_determined] = np.inf
        return np.asarray(covariance)

    def correlated_noise(self, columns: Array, correlation: Array) -> Array:
        """Product of the noise's correlation matrix with columns `[pixels used, p]`."""
        return np.asarray(correlate(self.picture(columns.T), correlation)[:, self.used].T)

    def _shaped(self, family: str, names: tuple[str, ...], p: Array) -> Array:
        """The moved source convolved with the kernel, without gain and background: `[pixels used]`."""
        params = dict(zip(names, p, strict=True))
        kernels = self.kernels(family, {n: np.array([params[n]]) for n in SHAPES[family]})
        return self.convolve(self.moved_source(self.moves(params)), kernels)[0]

    def project(self, shaped: Array) -> tuple[Array, float, float]:
        """Fits gain and background by linear least squares; returns the model of the used pixels, and both."""
        mean, level = float(shaped.mean()), float(self.values.mean())
        centred = shaped - mean
        size = float(centred @ centred)
        gain = max(float(centred @ (self.values - level)) / size if size > 0 else 0.0, 0.0)
        return level + gain * centred, gain, level - gain * mean

    def _jacobian(self, family: str, names: tuple[str, ...], p: Array) -> Array:
        """Derivatives of the projected model `[pixels used, parameters]` (Kaufman's approximation)."""
        params = dict(zip(names, p, strict=True))
        shape = SHAPES[family]
        varied = {n: np.repeat(params[n], 2 * len(shape) + 1) for n in shape}
        for i, n in enumerate(shape):
            step = 1e-4 * max(abs(params[n]), 0.1)
            varied[n][2 * i + 1] += step
            varied[n][2 * i + 2] = max(varied[n][2 * i + 2] - step, _LOWER.get(n, 0.0))
            varied[n] = np.minimum(varied[n], _UPPER.get(n, np.inf))
        kernels = self.kernels(family, varied)
        slopes = [
            (kernels[2 * i + 1] - kernels[2 * i + 2]) / (varied[n][2 * i + 1] - varied[n][2 * i + 2])
            for i, n in enumerate(shape)
        ]
        blurred = self.convolve(self.moved_source(self.moves(params)), np.stack([kernels[0], *slopes]))
        columns = [*blurred[1:], *self.move_columns(params, names[len(shape) :], kernels[0])]
        return without_level(self.project(blurred[0])[1] * np.stack(columns, axis=1), blurred[0])

    def move_columns(self, params: Mapping[str, float], names: tuple[str, ...], kernel: Array) -> list[Array]:
        """Derivatives of the blurred source with respect to displacement and magnification."""
        unmoved, _ = self._moved(self.moves(params))
        transformed, columns = self.transformed(kernel), []
        for n in names:
            changed = self.moves(params)
            changed[n] += _STEP[n]
            change = rfft2((self._drawn(changed) - unmoved) / _STEP[n], self.grid)
            columns.append(self.product(change, transformed))
        return columns

    def bounds(self, names: tuple[str, ...]) -> tuple[list[float], list[float]]:
        """Lower and upper bounds of the named parameters."""
        largest_shift = max(2.0, 0.3 * self.dot.radius)
        table = {
            **{"sigma": (0.05, self.half), "r_c": (0.0, self.half), "radius": (0.1, self.half), "m": (0.5, 12.0)},
            **{"b": (-0.98, 8.0), "rotation_deg": (-400.0, 400.0), "curvature": (0.0, 1.0)},
            **dict.fromkeys(("dx", "dy"), (-largest_shift, largest_shift)),
            "magnification": (0.7 * self.magnification, 1.4 * self.magnification),
        }
        return [table[n][0] for n in names], [table[n][1] for n in names]

    def _starts(self, family: str) -> list[Mapping[str, float]]:
        """Initial kernel parameters: shapes with the second moment that the blur has added."""
        added_variance = (self.dot.radius**2 - (self.magnification * self.source.radius) ** 2) / 4
        size = min(float(np.sqrt(max(added_variance, 0.15))), self.half / 3)
        if family not in OPENINGS:
            return [{n: v * size if n in LENGTHS else v for n, v in s.items()} for s in _STARTS[family]]
        return [{"radius": np.sqrt(2) * size / float(self.rms(family, {"radius": np.ones(1)})[0])}]


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
        params = {k: np.asarray(v, dtype=np.float64)[None] for k, v in self.params.items()}
        return np.asarray(self.pair.kernels(self.family, params)[0])

    @cached_property
    def residual(self) -> Array:
        """Data minus model `[pixels used]`."""
        return np.asarray(self.pair.values - self.fitted)

    @cached_property
    def squares(self) -> float:
        """Sum of squared residuals."""
        return float(self.residual @ self.residual)
