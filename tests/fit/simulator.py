"""A simulated camera that photographs a white dot, sharp and blurred by a kernel, with the faults of real cameras."""

from __future__ import annotations

import inspect
import io
import warnings
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image
from scipy.signal import fftconvolve

from tests.files import store
from torchdof.fit import FitError, FitWarning
from torchdof.fit.photo.captures import demosaiced
from torchdof.io.images import Picture, write_image
from torchdof.optics.psf import pixel_kernels


def draw_dot(size: int, radius: float, centre: tuple[float, float] = (0.0, 0.0), oversample: int = 16) -> np.ndarray:
    """Coverage `[size, size]` of a disc of `radius` px at `centre` (x, y) px from the picture's centre."""
    axis = (np.arange(size * oversample) + 0.5) / oversample - size / 2
    inside = (axis[None, :] - centre[0]) ** 2 + (axis[:, None] - centre[1]) ** 2 <= radius**2
    return inside.reshape(size, oversample, size, oversample).mean((1, 3))


def shape(kind: str, radius: float) -> np.ndarray:
    """Kernel `[41, 41]` of a blur that no round family can fit; it sums to 1 and is not centred on its mass."""
    size, fine = 41, 8
    axis = (np.arange(size * fine) + 0.5) / fine - size / 2
    x, y = np.meshgrid(axis, axis)
    r = np.hypot(x, y) / radius
    if kind == "hexagon":
        from_corner = (np.arctan2(y, x) - np.deg2rad(11.0)) % (np.pi / 3)
        light = r * np.cos(from_corner - np.pi / 6) < np.cos(np.pi / 6)
    elif kind == "coma":  # rays are displaced by the square of their height in the pupil
        a, b, far = x[r < 1], y[r < 1], 0.15 / radius
        edges = np.arange(size * fine + 1) / fine - size / 2
        light = np.histogram2d(b + far * 2 * a * b, a + far * (3 * a**2 + b**2), bins=(edges, edges))[0]
    else:
        light = (r < 1) & (np.hypot(x - 0.7 * radius, y) < radius if kind == "cat's eye" else r > 0.45)
    kernel = np.asarray(light, dtype=np.float64).reshape(size, fine, size, fine).mean((1, 3))
    return kernel / kernel.sum()


def blur(picture: np.ndarray, family: str | np.ndarray, params: dict) -> np.ndarray:
    """The picture convolved with a kernel `[k, k]`, or with that of a family."""
    if isinstance(family, str):
        tensors = {k: torch.as_tensor(v, dtype=torch.float64) for k, v in params.items()}
        family = pixel_kernels(family, tensors).numpy()
    return fftconvolve(picture, family, mode="same")


@dataclass
class Simulator:
    """A camera and its faults; the defaults have noise only."""

    size: int = 101  # side of the square window, px
    dot_radius: float = 12.0  # radius of the sharp dot, px
    snr_db: float | None = 40.0  # 20 log10(1 / sigma of the read noise); None: no noise. The sharp dot has level 1
    full_well: float | None = None  # electrons at level 1, for shot noise
    level: float = 1.0  # level of the sharp dot; below 1 encoded pictures do not clip
    exposure: float = 1.0  # light of the defocused picture over that of the sharp one
    black: float = 0.0  # level added to both pictures
    offset: float = 0.0  # level added to the defocused picture only (stray light)
    shift: tuple[float, float] = (0.0, 0.0)  # displacement (x, y) of the defocused dot, px
    magnification: float = 1.0  # size of the dot in the defocused picture over that in the sharp one
    bits: int | None = None  # bits of the quantization, which also clips to 0..1
    clip: float | None = None  # level above which the picture is clipped
    srgb: bool = False  # leave both pictures sRGB encoded
    jpeg: int | None = None  # quality of the JPEG through which the sRGB-encoded pictures go
    edge_sigma: float = 0.0  # sigma in px of a Gaussian blur of both pictures
    misfocus: float = 0.0  # sigma in px of a Gaussian blur of the sharp picture only
    tone: float = 0.0  # strength from 0 to 1 of an S-curve over the encoded levels, which is not undone
    bayer: bool = False  # sample with an RGGB mosaic, demosaic bilinearly, take the mean of the colours

    def pair(self, family: str | np.ndarray, params: dict, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Sharp and defocused picture `[size, size]` of one dot."""
        rng = np.random.default_rng(seed)
        sharp = draw_dot(self.size, self.dot_radius)
        moved = np.pad(draw_dot(self.size, self.dot_radius * self.magnification, self.shift), self.size)
        if self.edge_sigma:
            sharp, moved = (blur(p, "gaussian", {"sigma": self.edge_sigma}) for p in (sharp, moved))
        if self.misfocus:
            sharp = blur(sharp, "gaussian", {"sigma": self.misfocus})
        blurred = blur(moved, family, params)[self.size : 2 * self.size, self.size : 2 * self.size]
        still, defocused = self.level * sharp, self.level * self.exposure * blurred + self.offset
        return self.record(still, rng), self.record(defocused, rng)

    def record(self, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The recorded picture of `light`, in linear light, or sRGB encoded if `srgb`."""
        picture = np.maximum(light, 0.0) + self.black
        if self.full_well is not None:
            picture = rng.poisson(picture * self.full_well) / self.full_well
        if self.snr_db is not None:
            picture = picture + rng.normal(0.0, 10 ** (-self.snr_db / 20), picture.shape)
        if self.bayer:
            picture = demosaiced(picture, "RGGB").mean(0)  # the scene is grey: all colours have the same light
        if self.clip is not None:
            picture = np.minimum(picture, self.clip)
        if self.tone:
            encoded = encode_srgb(picture)
            picture = decode_srgb((1 - self.tone) * encoded + self.tone * encoded**2 * (3 - 2 * encoded))
        if self.jpeg is not None:
            stored = io.BytesIO()
            levels = np.round(255 * encode_srgb(picture)).astype(np.uint8)
            Image.fromarray(levels).save(stored, "jpeg", quality=self.jpeg)
            return decode_srgb(np.asarray(Image.open(stored), dtype=np.float64) / 255)
        if self.srgb:
            picture = encode_srgb(picture)
        if self.bits is not None:
            levels = 2**self.bits - 1
            picture = np.round(np.clip(picture, 0, 1) * levels) / levels
        return picture


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear light to sRGB, clipped to 0..1."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-12) ** (1 / 2.4) - 0.055)


def decode_srgb(encoded: np.ndarray) -> np.ndarray:
    """sRGB to linear light."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def result_and_warnings(call) -> tuple:
    """The result of a call, or its `FitError`, and a list of its `FitWarning`s; other warnings are errors."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("error")
        warnings.simplefilter("always", FitWarning)
        try:
            result = call()
        except FitError as error:
            result = error
    return result, [w.message for w in caught]


def write_captures(folder, camera, focus_m, distances, kernel, width=400, height=240, camera_fields="", grid=()):
    """Writes 16-bit sRGB PNGs of one dot or a grid, with capture.toml; ``kernel(distance[, x, y])`` is the blur."""
    folder.mkdir(parents=True, exist_ok=True)
    shots, arguments = [], len(inspect.signature(kernel).parameters)
    for i, distance in enumerate([focus_m, *distances]):
        m = focus_m / distance
        light = np.zeros((height, width))
        for x, y in grid or [(0.0, 0.0)]:
            square = draw_dot(max(width, height) + 1, camera.dot_radius * m, (x * m, y * m), oversample=8)
            top, left = (square.shape[0] - height) // 2, (square.shape[1] - width) // 2
            dot = square[top : top + height, left : left + width]
            light += dot if distance == focus_m else blur(dot, *kernel(*(distance, x, y)[:arguments]))
        picture = camera.record(camera.level * light, np.random.default_rng(100 + i))
        name = f"{round(distance * 1000):04d}mm.png"
        pixels = torch.from_numpy(np.repeat(picture[None, None], 3, 1)).float()
        write_image(folder / name, Picture(pixels), transfer="srgb", sample="16")
        shots.append(f'[[shot]]\nfile = "{name}"\ndistance_m = {distance}\n' if i else f'sharp = "{name}"')
    text = [f"focus_m = {focus_m}", shots[0], 'transfer = "srgb"', camera_fields, *shots[1:]]
    (folder / "capture.toml").write_text("\n".join(text))
    return folder


def write_photographs(folder, focus_m, distances, width=800, tone=0.5, noise=0.01, jpeg=90, exif=True):
    """Writes a phone's JPEGs of the printed target on a grey desk; `tone` is the strength of its S-curve."""
    folder.mkdir(parents=True, exist_ok=True)
    focal_mm, f_number = 5.4, 1.8
    image_px = focal_mm / (36 * focal_mm / 26) * width / (1 - focal_mm / 1000 / focus_m)
    height, fine = width * 3 // 4, 3
    for i, distance in enumerate([focus_m, *distances]):
        scale = image_px / distance / 1000  # px a mm
        turn, (x0, y0) = np.deg2rad(1.5), place_of_target(i, width)
        axis_x, axis_y = ((np.arange(n * fine) + 0.5) / fine - n / 2 for n in (width, height))
        x, y = np.meshgrid(axis_x - x0, axis_y - y0)
        x, y = (x * np.cos(turn) + y * np.sin(turn)) / scale, (y * np.cos(turn) - x * np.sin(turn)) / scale
        light = np.where((np.abs(x) < 105) & (np.abs(y + 17) < 148), 0.8, 0.3 + 0.05 * np.sin(x / 30))
        # anti-aliased: each sample gets its distance from the edge in samples, clipped to 0..1
        inside = np.minimum(*(np.clip((50 - np.abs(v)) * scale * fine + 0.5, 0, 1) for v in (x, y)))
        light += inside * (0.035 - light)
        light += np.clip((2.5 - np.hypot(x, y)) * scale * fine + 0.5, 0, 1) * (0.8 - light)
        light = light.reshape(height, fine, width, fine).mean((1, 3)) * (1 + 0.1 * np.linspace(-1, 1, width))
        radius = focal_mm / 2000 / f_number * image_px * abs(1 / focus_m - 1 / distance)
        if radius:
            light = blur(np.pad(light, 40, mode="edge"), "disc", {"radius": radius})[40:-40, 40:-40]
        camera = Simulator(snr_db=-20 * np.log10(noise), bayer=True, tone=tone)
        pixels = np.round(255 * encode_srgb(camera.record(light, np.random.default_rng(i)))).astype(np.uint8)
        tags = {"Exif__FocalLength": focal_mm, "FNumber": f_number, "Exif__FocalLengthIn35mmFilm": 26} if exif else {}
        grey = np.repeat(pixels[..., None], 3, 2)
        store(folder / f"img_{i:04d}.jpg", grey, "uint8", Compression=f"jpeg:{jpeg}", **tags)


def place_of_target(i: int, width: int) -> tuple[float, float]:
    """Position (x, y) in px of the target's centre in photograph `i` from the frame's, as with a hand-held phone."""
    x, y = np.random.default_rng(900 + i).uniform(-3, 3, 2)
    return 0.02 * width + x, -0.015 * width + y
