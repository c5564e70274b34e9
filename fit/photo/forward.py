"""The forward model: the defocused picture is gain x (kernel convolved with the moved sharp picture) + background.

Nothing is divided and the whole window speaks, so dot size, exposure, stray light, displacement and magnification do
not bias the kernel. Gain and background enter linearly and are solved inside (variable projection); the kernel's
parameters, the displacement and the magnification are searched.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from scipy.fft import irfft2, next_fast_len, rfft2

from torchdof.optics.aperture import Aperture
from torchdof.optics.psf import FAMILIES, LENGTHS, pixel_kernels, support

from ..result import Array, Mask
from ..solve import best_of, inverse
from .dot import Dot, distance_from
from .noise import correlate, correlation_of, noise_beside, noise_of
from .source import Source

ALL_MOVES = ("dx", "dy", "magnification")
OPENINGS = {"polygon": ("radius", "rotation_deg", "curvature"), "image": ("radius",)}
"""Parameters of the kernels that are not round: discs seen through a lens's opening."""

SHAPES = {**FAMILIES, **OPENINGS}
"""Parameters of every kernel that can be fitted."""

_STARTS = {  # lengths in units of what the blur added to the dot's deviation along an axis
    "gaussian": [{"sigma": 1.0}, {"sigma": 0.5}],
    "disc": [{"radius": 2.0}, {"radius": 1.7}],
    "ring": [{"sigma": 0.9, "r_c": 0.2}, {"sigma": 0.6, "r_c": 0.9}, {"sigma": 0.25, "r_c": 1.3}],
    "softm": [{"radius": 2.0, "sigma": 0.15, "b": 0.0, "m": 2.0}, {"radius": 1.7, "sigma": 0.4, "b": 0.5, "m": 3.0}],
}
_LEAST, _MOST = {"b": -1.0, "rotation_deg": -np.inf}, {"curvature": 1.0}
_DRAWN_PX = 16.0
_STEP = {"dx": 1e-4, "dy": 1e-4, "magnification": 1e-5}


@dataclass(frozen=True)
class Solution:
    """Kernel parameters and moves that explain the defocused picture best, with everything needed to judge them."""

    family: str
    params: dict[str, float | Array]
    moves: dict[str, float]
    gain: float
    background: float
    model: Array  # the defocused picture as it is drawn [H, W], NaN where pixels are not used
    names: tuple[str, ...]  # of the parameters that the covariance is of
    covariance: Array
    squares: float  # sum of the residual's
    slopes: Array  # derivatives of the model [pixels used, parameters]


@dataclass
class Forward:
    """One pair of pictures, ready to be explained by any family."""

    source: Source  # what stands for the sharp dot
    data: Array  # the defocused picture [H, W]
    used: Mask  # which of its pixels count [H, W]
    dot: Dot  # where the blurred dot is
    magnification: float = 1.0  # size of the blurred picture's dot over the sharp one's, as expected
    fit_moves: tuple[str, ...] = ALL_MOVES  # which of displacement and magnification are fitted
    held_magnification: float | None = None  # to start from, and to use where it is not fitted; None is the expected
    start: dict[str, Mapping[str, float]] = field(default_factory=dict)  # kernel parameters to start from, by family
    prior: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # expected kernel parameters, deviations
    shot_noise: float = 0.0  # how much the variance of a pixel's noise, by second differences, grows with its level
    fine_share_of_light: float | None = None  # of that growth, that second differences see; None is the dark paper's
    opening: Aperture | None = None  # of the lens, for the kernels in OPENINGS: its blades, or its image

    def __post_init__(self) -> None:
        """Prepare what is the same for all families."""
        self.pixels = np.indices(self.data.shape).astype(np.float64)  # rows and columns [2, H, W]
        self.half = min(self.data.shape) // 2  # of the window, px: the widest kernel
        self.grid = tuple(next_fast_len(n + self.half + 1, real=True) for n in self.data.shape)  # of Fourier transforms
        margin = int(np.ceil(self.source.reach * self.magnification * 1.4)) + 4
        x, y = int(round(self.dot.x)), int(round(self.dot.y))
        # in which the source is drawn
        self.box = (slice(max(y - margin, 0), y + margin + 1), slice(max(x - margin, 0), x + margin + 1))
        self.flat = self.used.ravel()
        self.values = self.data[self.used]  # [pixels used]
        self.distance = distance_from(self.dot, self.data.shape)  # of each pixel from the blurred dot's centre, px
        self.lit = self.used & (self.distance <= self.dot.reach + 1)  # pixels with light in them
        dark = self.used & (self.distance > self.dot.reach + 2)
        # how the paper's noise goes together in neighbours, and the share of it that second differences see
        self.noise_correlation, self.fine_share = noise_beside(self.data, self.dot.background, dark)
        # the largest level, so that one tolerance serves all pictures
        self.unit = max(float(np.abs(self.values - self.dot.background).max()), np.finfo(float).tiny)

    def moved_source(self, moves: Mapping[str, float]) -> Array:
        """The source displaced and magnified, Fourier transformed on the padded grid."""
        return rfft2(self._drawn(moves), self.grid)

    def _drawn(self, moves: Mapping[str, float]) -> Array:
        rows, columns = self.pixels[(slice(None), *self.box)]
        x, y = self.dot.x + moves["dx"], self.dot.y + moves["dy"]
        picture = np.zeros(self.data.shape)
        picture[self.box] = self.source.draw(rows, columns, x, y, moves["magnification"])
        return picture

    def convolve(self, source: Array, kernels: Array, whole: bool = False) -> Array:
        """Transformed source `[h, w]` (or `[n, h, w]`) with kernels `[n, k, k]`: `[n, pixels used]`, or all pixels."""
        size = kernels.shape[-1]
        padded = np.zeros((*kernels.shape[:-2], *self.grid))
        padded[..., :size, :size] = kernels
        # the kernel's centre goes to pixel (0, 0) of the cyclic grid
        wrapped = np.roll(padded, (-(size // 2), -(size // 2)), (-2, -1))
        blurred = irfft2(source * rfft2(wrapped, self.grid), self.grid)
        flat = blurred[..., : self.data.shape[0], : self.data.shape[1]].reshape(*blurred.shape[:-2], -1)
        return np.asarray(flat if whole else flat[..., self.flat])

    def correlate(self, source: Array, picture: Array, size: int) -> Array:
        """The adjoint of `convolve` for one kernel `[size, size]`: what the used pixels say of each of its pixels."""
        spread = irfft2(np.conj(source) * rfft2(self.picture(picture, 0.0), self.grid), self.grid)
        return np.asarray(np.roll(spread, (size // 2, size // 2), (0, 1))[:size, :size])

    def picture(self, values: Array, elsewhere: float) -> Array:
        """Pictures `[..., H, W]` of numbers of the pixels used `[..., pixels used]`."""
        full = np.full((*values.shape[:-1], self.flat.size), elsewhere)
        full[..., self.flat] = values
        return full.reshape(*values.shape[:-1], *self.data.shape)

    def kernels(self, family: str, params: Mapping[str, Array], widest: int | None = None) -> Array:
        """Kernels `[n, k, k]` for parameters `[n]`: as wide as they need, at most the window or `widest` px a side."""
        most = self.half if widest is None else widest
        tensors = {k: torch.from_numpy(np.atleast_1d(v)) for k, v in params.items()}
        if family in OPENINGS:
            radius = tensors["radius"]
            size = 2 * min(int(np.ceil(float(radius.max()))) + 1, most) + 1
            each = [self.opening_with({n: float(v[i]) for n, v in tensors.items()}) for i in range(len(radius))]
            drawn = [pixel_kernels("disc", {"radius": r}, size, None, o) for r, o in zip(radius, each, strict=True)]
            return torch.stack(drawn).numpy()
        half = min(int(np.ceil(support(family, tensors))) + 1, most)
        return pixel_kernels(family, tensors, 2 * half + 1).numpy()

    def kernel(self, solution: Solution) -> Array:
        """Kernel `[k, k]` of a solution."""
        params = {k: np.asarray(v, dtype=np.float64)[None] for k, v in solution.params.items()}
        return np.asarray(self.kernels(solution.family, params)[0])

    def opening_with(self, params: Mapping[str, float]) -> Aperture:
        """The lens's opening with the parameters that belong to it."""
        if self.opening is None:
            raise AssertionError("kernels that are not round are those of an opening")
        changed: dict[str, Any] = {n: params[n] for n in ("rotation_deg", "curvature") if n in params}
        return replace(self.opening, **changed)

    def rms(self, family: str, params: Mapping[str, Array]) -> Array:
        """Rms radius of the PSFs `[n]` of parameters `[n]`, px.

        They are drawn so large that their kernels' pixels, which are never negative, do not matter.
        """
        lengths = [np.abs(v).max() for n, v in params.items() if n in LENGTHS]
        enlarged = max(1.0, _DRAWN_PX / max(lengths))
        drawn = {n: enlarged * np.asarray(v) if n in LENGTHS else np.asarray(v) for n, v in params.items()}
        kernels = self.kernels(family, drawn, int(np.ceil(enlarged * self.half)))
        away = np.arange(kernels.shape[-1]) - kernels.shape[-1] // 2
        return np.asarray(np.sqrt((kernels * (away[:, None] ** 2 + away**2)).sum((1, 2))) / enlarged)

    def solve(self, family: str) -> Solution:
        """Fit one family from several starts (or from `start`, and from the moments beside it)."""
        shape = SHAPES[family]
        names = (*shape, *self.fit_moves)
        unmoved = self.moves({})
        # what is expected, as further data that are as uncertain as a pixel
        noise = max(noise_of(self.data), 1e-5 * self.unit) / self.unit
        mean, deviation = np.array([self.prior.get(n, (0.0, np.inf)) for n in names]).T
        pull = noise / deviation
        numbers = best_of(
            lambda p: np.concatenate([self.project(self._shaped(family, names, p))[0] / self.unit, pull * p]),
            np.concatenate([self.values / self.unit, pull * mean]),
            [[start[n] if n in start else unmoved[n] for n in names] for start in self._starts(family)],
            self.bounds(names),
            jacobian=lambda p: np.concatenate([self._jacobian(family, names, p) / self.unit, np.diag(pull)]),
            tolerance=1e-7,
            # a neighbour's branch is left only for one that chi squared prefers by 12
            loyalty=12 / self.values.size if family in self.start else 0.0,
        )
        params = {n: float(v) for n, v in zip(names, numbers, strict=True)}
        fitted, gain, background = self.project(self._shaped(family, names, numbers))
        residual, slopes, moves = self.values - fitted, self._jacobian(family, names, numbers), self.moves(params)
        kernel = self.kernels(family, {n: np.array([params[n]]) for n in shape})[0]
        return Solution(
            family=family,
            params={n: params[n] for n in shape},
            moves=moves,
            gain=gain,
            background=background,
            model=self.picture(fitted, np.nan),
            names=names,
            covariance=self.covariance(slopes, residual, kernel, gain, np.diag((self.unit * pull) ** 2), of_prior=True),
            squares=float(residual @ residual),
            slopes=slopes,
        )

    def moves(self, params: Mapping[str, float]) -> dict[str, float]:
        """The moves among fitted parameters, the fixed ones filled in."""
        held = self.magnification if self.held_magnification is None else self.held_magnification
        return {n: params.get(n, held if n == "magnification" else 0.0) for n in ALL_MOVES}

    def covariance(
        self, slopes: Array, residual: Array, kernel: Array, gain: float, penalty: Array, of_prior: bool = False
    ) -> Array:
        """Covariance of the parameters under both pictures' noise (a sandwich).

        The defocused picture's noise is as large as the residual where the light is, and goes together in neighbours as
        the residual does, or the paper. The sharp picture's passes through the kernel and is then alike in neighbouring
        pixels too. Both make naive errors too small. A penalty `[p, p]` of the fit shrinks them; that of a prior, which
        is a measurement as uncertain as a pixel, adds its own.
        """
        bread = inverse(slopes.T @ slopes + penalty)
        known = np.isfinite(np.diag(bread))
        bread = np.where(np.outer(known, known), bread, 0.0)
        full = self.picture(residual, 0.0)
        variance = float(np.sum(full[self.lit] ** 2)) / max(int(self.lit.sum()) - slopes.shape[1] - 2, 1)
        # few pixels show how far neighbours go together; the paper's many show more, where its noise is alike
        found = correlation_of(full, self.used & (self.distance <= self.dot.reach + 2))
        correlation = max(self.noise_correlation, found, key=np.sum)
        through = (gain * self.source.noise) ** 2 / self.fine_share
        own = max(variance - through * float(np.sum(kernel**2)), 0.1 * variance)
        meat = own * (slopes.T @ self.together(slopes, correlation) + (penalty if of_prior else 0.0))
        if through > 0:  # by (K' J)' (K' J) over the pixels of the source that carry noise
            pictures = rfft2(self.picture(slopes.T, 0.0), self.grid)
            carrying = (self.distance <= self.source.reach * self.magnification).ravel()
            spread = np.where(carrying, self.convolve(pictures, kernel[None], whole=True), 0.0)
            alike = correlate(spread.reshape(-1, *self.data.shape), self.noise_correlation)
            meat = meat + through * (spread @ alike.reshape(spread.shape).T)
        covariance = bread @ meat @ bread
        covariance[~known, ~known] = np.inf
        return np.asarray(covariance)

    def together(self, columns: Array, correlation: Array) -> Array:
        """Correlation of the pixels' noise times columns `[pixels used, p]`."""
        return np.asarray(correlate(self.picture(columns.T, 0.0), correlation)[:, self.used].T)

    def _shaped(self, family: str, names: tuple[str, ...], p: Array) -> Array:
        """Kernel convolved with the moved source, before gain and background: `[pixels used]`."""
        params = dict(zip(names, p, strict=True))
        kernels = self.kernels(family, {n: np.array([params[n]]) for n in SHAPES[family]})
        return self.convolve(self.moved_source(self.moves(params)), kernels)[0]

    def project(self, shaped: Array) -> tuple[Array, float, float]:
        """The model of the pixels used, gain and background included, by linear least squares; and both of them."""
        mean, level = float(shaped.mean()), float(self.values.mean())
        centred = shaped - mean
        size = float(centred @ centred)
        gain = max(float(centred @ (self.values - level)) / size if size > 0 else 0.0, 0.0)
        return level + gain * centred, gain, level - gain * mean

    def _jacobian(self, family: str, names: tuple[str, ...], p: Array) -> Array:
        """Derivatives of the projected model `[pixels used, parameters]` (Kaufman's form)."""
        params = dict(zip(names, p, strict=True))
        shape = SHAPES[family]
        near = {n: np.repeat(params[n], 2 * len(shape) + 1) for n in shape}
        for i, n in enumerate(shape):
            step = 1e-4 * max(abs(params[n]), 0.1)
            near[n][2 * i + 1] += step
            near[n][2 * i + 2] = max(near[n][2 * i + 2] - step, _LEAST.get(n, 0.0))
            near[n] = np.minimum(near[n], _MOST.get(n, np.inf))
        kernels = self.kernels(family, near)
        slopes = [
            (kernels[2 * i + 1] - kernels[2 * i + 2]) / (near[n][2 * i + 1] - near[n][2 * i + 2])
            for i, n in enumerate(shape)
        ]
        blurred = self.convolve(self.moved_source(self.moves(params)), np.stack([kernels[0], *slopes]))
        columns = [*blurred[1:], *self.move_columns(params, names[len(shape) :], kernels[0])]
        return without_level(self.project(blurred[0])[1] * np.stack(columns, axis=1), blurred[0])

    def move_columns(self, params: Mapping[str, float], names: tuple[str, ...], kernel: Array) -> list[Array]:
        """Derivatives of the blurred source with respect to displacement and magnification."""
        unmoved = self._drawn(self.moves(params))
        columns = []
        for n in names:
            moved = self.moves(params)
            moved[n] += _STEP[n]
            change = rfft2((self._drawn(moved) - unmoved) / _STEP[n], self.grid)
            columns.append(self.convolve(change, kernel[None])[0])
        return columns

    def bounds(self, names: tuple[str, ...]) -> tuple[list[float], list[float]]:
        """Lower and upper bounds of the named parameters."""
        width = float(self.half)
        wander = max(2.0, 0.3 * self.dot.radius)
        table = {
            "sigma": (0.05, width),
            "r_c": (0.0, width),
            "radius": (0.1, width),
            "b": (-0.98, 8.0),
            "m": (0.5, 12.0),
            "rotation_deg": (-400.0, 400.0),
            "curvature": (0.0, 1.0),
            "dx": (-wander, wander),
            "dy": (-wander, wander),
            "magnification": (0.7 * self.magnification, 1.4 * self.magnification),
        }
        return [table[n][0] for n in names], [table[n][1] for n in names]

    def _starts(self, family: str) -> list[Mapping[str, float]]:
        """Kernel parameters to start from: a given start, and those with the second moment that the blur added."""
        given = [self.start[family]] if family in self.start else []
        if self.prior:
            # what is expected leads to its own branch; the moments' would be pulled away from theirs
            return [*given, {n: mean for n, (mean, _) in self.prior.items()}]
        added = (self.dot.radius**2 - (self.magnification * self.source.radius) ** 2) / 4
        size = min(float(np.sqrt(max(added, 0.15))), self.half / 3)
        if family not in OPENINGS:
            return [*given, *({n: v * size if n in LENGTHS else v for n, v in s.items()} for s in _STARTS[family])]
        # an opening's turn is given with it
        return given or [{"radius": np.sqrt(2) * size / float(self.rms(family, {"radius": np.ones(1)})[0])}]


def without_level(columns: Array, shaped: Array) -> Array:
    """Columns with their part along the gain's and the background's own taken out."""
    basis = np.stack([np.ones_like(shaped), shaped - shaped.mean()], axis=1)
    basis = basis / np.maximum(np.linalg.norm(basis, axis=0), np.finfo(float).tiny)
    return np.asarray(columns - basis @ (basis.T @ columns))
