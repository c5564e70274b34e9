"""The forward model: the defocused picture is gain x (kernel convolved with the moved sharp picture) + background.

Nothing is divided and the whole window speaks, so dot size, exposure, stray light, displacement and magnification do
not bias the kernel. Gain and background enter linearly and are solved inside (variable projection); the kernel's
parameters, the displacement and the magnification are searched by `curve_fit`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch

from torchdof.optics.aperture import Aperture
from torchdof.optics.psf import FAMILIES, LENGTHS, pixel_kernels, support

from ..result import Array, Mask
from ..solve import best_of
from .dot import Dot, noise_of
from .noise import correlate, correlation_of, noise_beside
from .profile_fit import inverse
from .source import Source

__all__ = ["ALL_MOVES", "OPENINGS", "SHAPES", "Forward", "Solution"]

ALL_MOVES = ("dx", "dy", "magnification")
OPENINGS = {"polygon": ("radius", "rotation_deg", "curvature"), "image": ("radius",)}
"""Parameters of the kernels that are not round: discs seen through a lens's opening."""

SHAPES = {**FAMILIES, **OPENINGS}
"""Parameters of every kernel that can be fitted."""

_LEAST, _MOST = {"b": -1.0, "rotation_deg": -np.inf}, {"curvature": 1.0}
_DRAWN_PX = 16.0
_STEP = {"dx": 1e-4, "dy": 1e-4, "magnification": 1e-5}


@dataclass(frozen=True)
class Solution:
    """Kernel parameters and moves that explain the defocused picture best, with everything needed to judge them.

    `slopes` are the model's derivatives by the named parameters `[pixels used, parameters]`.
    """

    family: str
    params: dict[str, float | Array]
    moves: dict[str, float]
    gain: float
    background: float
    model: Array
    names: tuple[str, ...]
    covariance: Array
    squares: float
    slopes: Array | None = None


@dataclass
class Forward:
    """One pair of pictures, ready to be explained by any family.

    Attributes:
        source: what stands for the sharp dot.
        data: the defocused picture `[H, W]`.
        used: which of its pixels count `[H, W]`.
        data_dot: where the blurred dot is.
        magnification: size of the blurred picture's dot over the sharp one's, as expected.
        fit_moves: which of displacement and magnification are fitted.
        held_magnification: the one to use where it is not fitted, and to start from; None takes the expected one.
        shot_noise: how much the variance of a pixel's noise, as second differences see it, grows with its level.
        fine_share_of_light: share of that growth that second differences see; None takes the dark paper's.
        distance: of each pixel from the blurred dot's centre `[H, W]`, px.
        noise_correlation: how the noise of neighbouring pixels goes together, from the dark paper.
        fine_share: share of the noise's variance that second differences see.
        start: kernel parameters to start from beside the moments, by family.
        prior: expected value and standard deviation of kernel parameters, as if measured elsewhere.
        opening: of the lens, for the kernels in `OPENINGS`: its blades, or its image.
    """

    source: Source
    data: Array
    used: Mask
    data_dot: Dot
    magnification: float = 1.0
    fit_moves: tuple[str, ...] = ALL_MOVES
    held_magnification: float | None = None
    start: dict[str, dict[str, float]] = field(default_factory=dict)
    prior: dict[str, tuple[float, float]] = field(default_factory=dict)
    shot_noise: float = 0.0
    fine_share_of_light: float | None = None
    opening: Aperture | None = None

    def __post_init__(self) -> None:
        """Prepare the window the source is drawn in and the size of the Fourier grid."""
        from scipy.fft import next_fast_len

        self.half = min(self.data.shape) // 2
        self.grid = tuple(next_fast_len(n + self.half + 1, real=True) for n in self.data.shape)
        margin = int(np.ceil(self.source.reach * self.magnification * 1.4)) + 4
        x, y = int(round(self.data_dot.x)), int(round(self.data_dot.y))
        rows, columns = self.data.shape
        self.box = (
            slice(max(y - margin, 0), min(y + margin + 1, rows)),
            slice(max(x - margin, 0), min(x + margin + 1, columns)),
        )
        self.flat = self.used.ravel()
        self.values = self.data.ravel()[self.flat]
        rows_, columns_ = np.indices(self.data.shape)
        self.distance = np.hypot(columns_ - self.data_dot.x, rows_ - self.data_dot.y)
        dark = self.used & (self.distance > self.data_dot.reach + 2)
        self.noise_correlation, self.fine_share = noise_beside(self.data, self.data_dot.background, dark)
        # every level near 1, so that one tolerance serves all pictures
        self.unit = max(float(np.abs(self.values - self.data_dot.background).max()), np.finfo(float).tiny)

    def moved_source(self, moves: dict[str, float], source: Source | None = None) -> Array:
        """The source displaced and magnified, Fourier transformed on the padded grid."""
        return self._transform(self._sample(moves, source))

    def _sample(self, moves: dict[str, float], source: Source | None = None) -> Array:
        rows, columns = np.mgrid[self.box].astype(np.float64)
        x, y = self.data_dot.x + moves["dx"], self.data_dot.y + moves["dy"]
        picture = np.zeros(self.data.shape)
        picture[self.box] = (source or self.source).draw(rows, columns, x, y, moves["magnification"])
        return picture

    def _transform(self, pictures: Array) -> Array:
        from scipy.fft import rfft2

        return rfft2(pictures, self.grid)

    def convolve(self, source: Array, kernels: Array, whole: bool = False) -> Array:
        """Transformed source `[h, w]` (or `[n, h, w]`) with kernels `[n, k, k]`: `[n, pixels used]`, or all pixels."""
        from scipy.fft import irfft2, rfft2

        size = kernels.shape[-1]
        padded = np.zeros((*kernels.shape[:-2], *self.grid))
        padded[..., :size, :size] = kernels
        # the kernel's centre goes to pixel (0, 0) of the cyclic grid
        wrapped = np.roll(padded, (-(size // 2), -(size // 2)), (-2, -1))
        blurred = irfft2(source * rfft2(wrapped), self.grid)[..., : self.data.shape[0], : self.data.shape[1]]
        flat = blurred.reshape(*blurred.shape[:-2], -1)
        return np.asarray(flat if whole else flat[..., self.flat])

    def correlate(self, source: Array, picture: Array, size: int) -> Array:
        """The adjoint of `convolve` for one kernel `[size, size]`: what the used pixels say of each of its pixels."""
        from scipy.fft import irfft2

        full = np.zeros(self.flat.size)
        full[self.flat] = picture
        spread = irfft2(np.conj(source) * self._transform(full.reshape(self.data.shape)), self.grid)
        return np.asarray(np.roll(spread, (size // 2, size // 2), (0, 1))[:size, :size])

    def kernels(self, family: str, params: dict[str, Array], widest: int | None = None) -> Array:
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

    def opening_with(self, params: dict[str, float]) -> Aperture:
        """The lens's opening with the parameters that belong to it."""
        if self.opening is None:
            raise AssertionError("kernels that are not round are those of an opening")
        known = self.opening
        turn, curvature = params.get("rotation_deg", known.rotation_deg), params.get("curvature", known.curvature)
        return replace(known, rotation_deg=turn, curvature=curvature)

    def rms(self, family: str, params: dict[str, Array]) -> Array:
        """Rms radius of the PSFs `[n]` of parameters `[n]`, px.

        They are drawn so large that their kernels' pixels, which are never negative, do not matter.
        """
        lengths = [np.abs(v).max() for n, v in params.items() if n in LENGTHS]
        enlarged = max(1.0, _DRAWN_PX / max(lengths))
        drawn = {n: enlarged * np.asarray(v) if n in LENGTHS else np.asarray(v) for n, v in params.items()}
        kernels = self.kernels(family, drawn, int(np.ceil(enlarged * self.half)))
        away = np.arange(kernels.shape[-1]) - kernels.shape[-1] // 2
        return np.asarray(np.sqrt((kernels * (away[:, None] ** 2 + away**2)).sum((1, 2))) / enlarged)

    def solve(self, family: str, tolerance: float = 1e-7) -> Solution:
        """Fit one family from several starts (or from `start`, and from the moments beside it).

        Raises:
            NotConvergedError: when no start converges.
        """
        shape = SHAPES[family]
        names = (*shape, *self.fit_moves)
        low, high = self.bounds(names)
        starts = [self._start(names, s) for s in self._seeds(family)]
        if family in self.start:
            starts.insert(0, self._start(names, self.start[family]))
        if self.prior:
            # what is expected leads to its own branch; the moments' would be pulled away from theirs
            starts = [*starts[: family in self.start], self._start(names, {n: m for n, (m, _) in self.prior.items()})]
        scale, expected, pull = self._prior_rows(names)

        def model(_: Array, *p: float) -> Array:
            shaped = self._shaped(family, names, np.asarray(p))
            return np.concatenate([self._project(shaped)[0] / self.unit, pull @ np.asarray(p)])

        def jacobian(_: Array, *p: float) -> Array:
            return np.concatenate([self._jacobian(family, names, np.asarray(p)) / self.unit, pull])

        numbers = best_of(
            model,
            np.concatenate([self.values / self.unit, expected]),
            starts,
            (low, high),
            jacobian=jacobian,
            tolerance=tolerance,
            # a neighbour's branch is left only for one that chi squared prefers by 12
            loyalty=12 / self.values.size if family in self.start else 0.0,
        )
        fitted, gain, background = self._project(self._shaped(family, names, numbers))
        residual = self.values - fitted
        params = {n: float(v) for n, v in zip(names, numbers, strict=True)}
        slopes = self._jacobian(family, names, numbers)
        full = np.full(self.flat.shape, np.nan)
        full[self.flat] = fitted
        kernel = self.kernels(family, {n: np.array([params[n]]) for n in shape})[0]
        return Solution(
            family=family,
            params={**{n: params[n] for n in shape}},
            moves=self.moves(params),
            gain=gain,
            background=background,
            model=full.reshape(self.data.shape),
            names=names,
            covariance=self.covariance(slopes, residual, kernel, gain, self.moves(params), pull * scale),
            squares=float(residual @ residual),
            slopes=slopes,
        )

    def moves(self, params: dict[str, float]) -> dict[str, float]:
        """The moves among fitted parameters, the fixed ones filled in."""
        held = self.magnification if self.held_magnification is None else self.held_magnification
        return {n: params.get(n, held if n == "magnification" else 0.0) for n in ALL_MOVES}

    def _prior_rows(self, names: tuple[str, ...]) -> tuple[float, Array, Array]:
        """The prior as further data: levels per unit of the fit, what is expected `[k]`, and its slopes `[k, p]`."""
        rows = [(i, *self.prior[n]) for i, n in enumerate(names) if n in self.prior]
        noise = max(noise_of(self.data), 1e-5 * self.unit) / self.unit
        pull = np.zeros((len(rows), len(names)))
        for k, (i, _, deviation) in enumerate(rows):
            pull[k, i] = noise / deviation
        return self.unit, np.array([noise * mean / deviation for _, mean, deviation in rows]), pull

    def covariance(
        self,
        jacobian: Array,
        residual: Array,
        kernel: Array,
        gain: float,
        moves: dict[str, float],
        prior: Array | None = None,
    ) -> Array:
        """Covariance of the parameters under both pictures' noise (a sandwich).

        The defocused picture's noise is as large as the residual says around each pixel, and goes together in
        neighbours as the residual does. The sharp picture's passes through the kernel and is then alike in neighbouring
        pixels too. Both make naive errors too small. An ideal dot brings the errors of its radius and softness instead.
        """
        known_before = 0.0 if prior is None else prior.T @ prior
        bread = inverse(jacobian.T @ jacobian + known_before)
        known = np.isfinite(np.diag(bread))
        bread = np.where(np.outer(known, known), bread, 0.0)
        n, p = jacobian.shape
        through = (gain * self.source.noise) ** 2 / self.fine_share
        deviation, correlation = self.residual_noise(residual, n / max(n - p - 2, 1))
        if through > 0:
            least = np.sqrt(0.1) * deviation
            deviation = np.sqrt(np.maximum(deviation**2 - through * float(np.sum(kernel**2)), least**2))
        meat = jacobian.T @ self.noise_times(jacobian, deviation, correlation) + known_before
        if through > 0:
            meat = meat + through * self._source_scores(jacobian, kernel)
        covariance = bread @ meat @ bread
        variants, spread = self.source.variants()
        if variants:
            plain = self.moved_source(moves)
            changes = [self.convolve(self.moved_source(moves, v) - plain, kernel[None])[0] for v in variants]
            pulled = bread @ (jacobian.T @ (gain * np.stack(changes, axis=1)))
            covariance = covariance + pulled @ spread @ pulled.T
        covariance[~known, ~known] = np.inf
        return np.asarray(covariance)

    def _source_scores(self, jacobian: Array, kernel: Array) -> Array:
        """`(K' J)' (K' J)` over the pixels of the source that carry noise."""
        pictures = np.zeros((jacobian.shape[1], self.flat.size))
        pictures[:, self.flat] = jacobian.T
        spread = self.convolve(self._transform(pictures.reshape(-1, *self.data.shape)), kernel[None], whole=True)
        rows, columns = np.indices(self.data.shape)
        near = np.hypot(columns - self.data_dot.x, rows - self.data_dot.y) <= self.source.reach * self.magnification
        spread = np.where(near.ravel(), spread, 0.0)
        shaped = spread.reshape(-1, *self.data.shape)
        return np.asarray(spread @ correlate(shaped, self.noise_correlation).reshape(spread.shape).T)

    def residual_noise(self, residual: Array, factor: float = 1.0) -> tuple[Array, Array]:
        """Deviation of each used pixel's noise `[pixels used]`, and how neighbours' go together, from a residual."""
        from scipy.ndimage import gaussian_filter

        full = np.zeros(self.data.shape)
        full[self.flat.reshape(self.data.shape)] = residual
        share = np.maximum(gaussian_filter(self.used.astype(np.float64), 2.0), 1e-6)
        deviation = np.sqrt(factor * np.maximum(gaussian_filter(full**2, 2.0) / share, 0.0))
        near = self.used & (self.distance <= self.data_dot.reach + 2)
        scaled = full / np.maximum(deviation, 1e-12 * self.unit)
        # few pixels show how far neighbours go together; the paper's many show more, where its noise is alike
        found = correlation_of(scaled, near)
        correlation = self.noise_correlation if self.noise_correlation.sum() > found.sum() else found
        return deviation.ravel()[self.flat], correlation

    def noise_times(self, columns: Array, deviation: Array, correlation: Array) -> Array:
        """Covariance of the pixels' noise times columns `[pixels used, p]`."""
        pictures = np.zeros((columns.shape[1], self.flat.size))
        pictures[:, self.flat] = (deviation[:, None] * columns).T
        together = correlate(pictures.reshape(-1, *self.data.shape), correlation).reshape(pictures.shape)
        return np.asarray(deviation[:, None] * together[:, self.flat].T)

    def _shaped(self, family: str, names: tuple[str, ...], p: Array) -> Array:
        """Kernel convolved with the moved source, before gain and background: `[pixels used]`."""
        params = dict(zip(names, p, strict=True))
        kernels = self.kernels(family, {n: np.array([params[n]]) for n in SHAPES[family]})
        return self.convolve(self.moved_source(self.moves(params)), kernels)[0]

    def _project(self, shaped: Array) -> tuple[Array, float, float]:
        """Gain and background by linear least squares."""
        mean, level = float(shaped.mean()), float(self.values.mean())
        centred = shaped - mean
        size = float(centred @ centred)
        gain = float(centred @ (self.values - level)) / size if size > 0 else 0.0
        gain = max(gain, 0.0)
        return level + gain * centred, gain, level - gain * mean

    def _jacobian(self, family: str, names: tuple[str, ...], p: Array) -> Array:
        """Derivatives of the projected model `[pixels used, parameters]` (Kaufman's form)."""
        params = dict(zip(names, p, strict=True))
        shape = SHAPES[family]
        source = self.moved_source(self.moves(params))
        near = {n: np.repeat(params[n], 2 * len(shape) + 1) for n in shape}
        steps = [1e-4 * max(abs(params[n]), 0.1) for n in shape]
        for i, n in enumerate(shape):
            near[n][2 * i + 1] += steps[i]
            near[n][2 * i + 2] = max(near[n][2 * i + 2] - steps[i], _LEAST.get(n, 0.0))
            near[n] = np.minimum(near[n], _MOST.get(n, np.inf))
        kernels = self.kernels(family, near)
        slopes = [
            (kernels[2 * i + 1] - kernels[2 * i + 2]) / (near[n][2 * i + 1] - near[n][2 * i + 2])
            for i, n in enumerate(shape)
        ]
        blurred = self.convolve(source, np.stack([kernels[0], *slopes]))
        shaped, columns = blurred[0], [*blurred[1:]]
        columns += self.move_columns(params, names[len(shape) :], kernels[:1])
        gain = self._project(shaped)[1]
        stacked = gain * np.stack(columns, axis=1)
        return without_level(stacked, shaped)

    def move_columns(self, params: dict[str, float], names: tuple[str, ...], kernel: Array) -> list[Array]:
        """Derivatives of the blurred source with respect to displacement and magnification."""
        unmoved = self._sample(self.moves(params))
        columns = []
        for n in names:
            moved = self.moves(params)
            moved[n] += _STEP[n]
            columns.append(self.convolve(self._transform((self._sample(moved) - unmoved) / _STEP[n]), kernel)[0])
        return columns

    def bounds(self, names: tuple[str, ...]) -> tuple[list[float], list[float]]:
        """Lower and upper bounds of the named parameters."""
        width = float(self.half)
        wander = max(2.0, 0.3 * self.data_dot.radius)
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

    def _start(self, names: tuple[str, ...], seed: dict[str, float]) -> list[float]:
        unmoved = self.moves({})
        return [float(seed[n]) if n in seed else unmoved[n] for n in names]

    def _seeds(self, family: str) -> list[dict[str, float]]:
        """Starts from the second moments: what the blur added to the dot's own, per axis; an opening's are given."""
        if family in OPENINGS:
            if family in self.start:
                return []
            added = (self.data_dot.radius**2 - (self.magnification * self.source.dot.radius) ** 2) / 4
            of_one = np.sqrt(2) * float(self.rms(family, {n: np.ones(1) for n in SHAPES[family] if n == "radius"})[0])
            return [{"radius": float(np.sqrt(max(4 * added, 0.6))) / of_one}]
        added = (self.data_dot.radius**2 - (self.magnification * self.source.dot.radius) ** 2) / 4
        s = float(np.sqrt(max(added, 0.15)))
        s = min(s, self.half / 3)
        if family == "gaussian":
            return [{"sigma": s}, {"sigma": 0.5 * s}]
        if family == "disc":
            return [{"radius": 2 * s}, {"radius": 1.7 * s}]
        if family == "ring":
            return [
                {"sigma": 0.9 * s, "r_c": 0.2 * s},
                {"sigma": 0.6 * s, "r_c": 0.9 * s},
                {"sigma": 0.25 * s, "r_c": 1.3 * s},
            ]
        return [
            {"radius": 2 * s, "sigma": 0.15 * s, "b": 0.0, "m": 2.0},
            {"radius": 1.7 * s, "sigma": 0.4 * s, "b": 0.5, "m": 3.0},
        ]


def without_level(columns: Array, shaped: Array) -> Array:
    """Columns with their part along the gain's and the background's own taken out."""
    basis = np.stack([np.ones_like(shaped), shaped - shaped.mean()], axis=1)
    basis = basis / np.maximum(np.linalg.norm(basis, axis=0), np.finfo(float).tiny)
    return np.asarray(columns - basis @ (basis.T @ columns))
