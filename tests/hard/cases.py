"""The hard cases, each with a measured error: tests hold them to their limits, `write_table.py` writes them down.

An error is the largest difference of a pixel from the truth, relative to that pixel's truth. The truth is a closed form
where there is one, else the same rendering in float64 of the same (rounded) input.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc
from torchdof.render.border import continued
from torchdof.render.highlights import threshold
from torchdof.render.layer_weights import from_blur_axis
from torchdof.render.plan import Plan

HEIGHT, WIDTH = 24, 32
CAMERA = Camera(focal_length_mm=50.0, f_number=2.0, focus_m=2.0, sensor_width_mm=4.0)  # 4 px at infinity
DISC = BlurTable.disc()
LIMIT = {torch.float32: 1e-5, torch.float16: 2**-11 + 1e-5}

Measure = Callable[[torch.dtype], float]


@dataclasses.dataclass(frozen=True)
class Case:
    """One hard case: a group, a sentence, what it is measured against, and the error for an image of a type."""

    group: str
    name: str
    truth: str
    measure: Measure
    limit: dict[torch.dtype, float] = dataclasses.field(default_factory=lambda: LIMIT)
    onnx_limit: float = 1e-5


CASES: list[Case] = []


def case(group: str, name: str, truth: str, **limits: float) -> Callable[[Measure], Measure]:
    """Registers a measurement as a case."""
    limit = {**LIMIT, **{getattr(torch, k): v for k, v in limits.items()}}

    def register(measure: Measure) -> Measure:
        CASES.append(Case(group, name, truth, measure, limit))
        return measure

    return register


def texture(dtype: torch.dtype, channels: int = 3, seed: int = 0) -> Tensor:
    """Random light from 0.05 to 1."""
    noise = torch.rand(1, channels, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed))
    return (0.05 + 0.95 * noise).to(dtype)


def error(out: Tensor, truth: Tensor) -> float:
    """Largest relative difference of a pixel; infinite where one is not finite."""
    out, truth = out.detach().double(), truth.detach().double()
    apart = (out - truth).abs() / truth.abs().clamp_min(1e-300)
    apart = torch.where(out == truth, 0.0, apart)
    return float(torch.nan_to_num(apart, nan=math.inf).max())


def convolved(image: Tensor, coc_px: float) -> Tensor:
    """Closed form of a plane: the image, continued over its border, convolved with the disc, in float64."""
    half = max(image.shape[-2:]) - 1  # from one pixel of the frame to another
    kernel = DISC.kernels(torch.tensor([coc_px], dtype=torch.float64), image.shape[-1], window=2 * half + 1)[0]
    half = min(half, kernel.shape[-1] // 2)
    wide = continued(image.double(), None, threshold(image.double()), (half,) * 4, half)
    return functional.conv2d(wide, kernel.expand(image.shape[1], 1, -1, -1), groups=image.shape[1])


def flattened(image: Tensor) -> Tensor:
    """Closed form of an endless blur: means over as much as lies within the frame's longer side, in float64."""
    half = max(image.shape[-2:]) - 1
    wide = continued(image.double(), None, threshold(image.double()), (half,) * 4, half)
    return functional.avg_pool2d(wide, 2 * half + 1, stride=1)


def whole(value: float, dtype: torch.dtype = torch.float32) -> Tensor:
    """A map of one value."""
    return torch.full((1, 1, HEIGHT, WIDTH), value, dtype=dtype)


def against_double(image: Tensor, depth: Tensor, camera: Camera = CAMERA, **options: Any) -> float:
    """Error of a rendering against the same one in float64."""
    dof = DepthOfField(camera, **options)
    return error(dof(image, depth), dof(image.double(), depth.double()))


def coc_against_double(image: Tensor, coc: Tensor, **options: Any) -> float:
    """Error of a rendering from a coc map against the same one in float64."""
    return error(blur_by_coc(image, coc, **options), blur_by_coc(image.double(), coc.double(), **options))


# Depth


@case("depth", "infinity everywhere", "convolution with the disc of the thin lens")
def _(dtype: torch.dtype) -> float:
    image = texture(dtype)
    radius = float(CAMERA.coc_px(whole(math.inf, torch.float64), WIDTH)[0, 0, 0, 0])
    return error(DepthOfField(CAMERA)(image, whole(math.inf)), convolved(image, radius))


@case("depth", "1e12 m everywhere", "infinity")
def _(dtype: torch.dtype) -> float:
    image = texture(dtype)
    return error(DepthOfField(CAMERA)(image, whole(1e12)), DepthOfField(CAMERA)(image.double(), whole(math.inf)))


@case("depth", "1e-6 m everywhere: a blur of 4e6 px", "mean of the frame, continued")
def _(dtype: torch.dtype) -> float:
    image = texture(dtype)
    return error(DepthOfField(CAMERA)(image, whole(1e-6)), flattened(image))


@case("depth", "1e-6 m, 1e12 m and infinity side by side", "float64")
def _(dtype: torch.dtype) -> float:
    depth = whole(1e-6)
    depth[..., 8:20] = 1e12
    depth[..., 20:] = math.inf
    return against_double(texture(dtype), depth)


@case("depth", "all equal, off focus", "convolution with the disc of the thin lens")
def _(dtype: torch.dtype) -> float:
    image = texture(dtype)
    radius = float(CAMERA.coc_px(whole(3.1, torch.float64), WIDTH)[0, 0, 0, 0])
    return error(DepthOfField(CAMERA)(image, whole(3.1)), convolved(image, radius))


@case("depth", "all equal, in focus", "the image itself, bit by bit", float32=0.0, float16=0.0)
def _(dtype: torch.dtype) -> float:
    image = texture(dtype)
    return error(DepthOfField(CAMERA)(image, whole(2.0)), image)


@case("depth", "two values, half of the frame each", "float64")
def _(dtype: torch.dtype) -> float:
    depth = whole(1.2)
    depth[..., WIDTH // 2 :] = 9.0
    return against_double(texture(dtype), depth)


@case("depth", "a step at every pixel: checkerboard of near and far", "float64")
def _(dtype: torch.dtype) -> float:
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    return against_double(texture(dtype), torch.where((x + y) % 2 == 0, 1.2, 30.0)[None, None])


@case("depth", "noise over four decades", "float64")
def _(dtype: torch.dtype) -> float:
    noise = torch.randn(1, 1, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))
    return against_double(texture(dtype), 2.0 * 10 ** noise.clamp(-1, 3))


@case("depth", "a slope through focus", "float64")
def _(dtype: torch.dtype) -> float:
    return against_double(texture(dtype), torch.linspace(1.2, 6.0, WIDTH).expand(1, 1, HEIGHT, WIDTH))


def _on_node(offset: int) -> Tensor:
    """Two planes; the nearer one sits on a layer's node, or some units in the last place off it."""
    coc = whole(9.0)
    node = torch.tensor([c for c in Plan.of_scene(torch.tensor([[[[0.0, 9.0]]]]), 1 / 255).coc_px if 2 < c < 6][0])
    for _ in range(abs(offset)):
        node = torch.nextafter(node, torch.tensor(math.copysign(math.inf, offset)))
    coc[..., : WIDTH // 2] = node
    coc[..., 0, 0] = 0.0
    return coc


@case("depth", "a plane exactly on a layer's node", "float64")
def _(dtype: torch.dtype) -> float:
    return coc_against_double(texture(dtype), _on_node(0))


@case("depth", "one unit in the last place to either side of a node", "on the node")
def _(dtype: torch.dtype) -> float:
    image = texture(dtype)
    truth = blur_by_coc(image.double(), _on_node(0).double())
    return max(error(blur_by_coc(image, _on_node(offset)), truth) for offset in (-1, 1))


@case("depth", "a hair to either side of where focus ends", "the image itself, and convolution with the disc")
def _(dtype: torch.dtype) -> float:
    image = texture(dtype)
    inside, outside = 0.9999 * from_blur_axis(1e-12), 1.0001 * from_blur_axis(1e-12)
    left = max(error(blur_by_coc(image, whole(c)), image) for c in (inside, -inside))
    return max(left, *(error(blur_by_coc(image, whole(c)), convolved(image, c)) for c in (outside, -outside)))


@case("depth", "focus exactly at one pixel's depth", "float64")
def _(dtype: torch.dtype) -> float:
    depth = torch.linspace(1.2, 6.0, WIDTH).expand(1, 1, HEIGHT, WIDTH)
    return against_double(texture(dtype), depth, CAMERA.replace(focus_m=float(depth[0, 0, 0, 11])))


@case("depth", "focus at infinity", "float64")
def _(dtype: torch.dtype) -> float:
    depth = torch.linspace(3.0, 50.0, WIDTH).expand(1, 1, HEIGHT, WIDTH).clone()
    depth[..., -4:] = math.inf
    return against_double(texture(dtype), depth, CAMERA.replace(focus_m=math.inf))


@case("depth", "focus in front of everything", "float64")
def _(dtype: torch.dtype) -> float:
    depth = torch.linspace(1.0, 9.0, WIDTH).expand(1, 1, HEIGHT, WIDTH)
    return against_double(texture(dtype), depth, CAMERA.replace(focus_m=0.6))


@case("depth", "focus behind everything", "float64")
def _(dtype: torch.dtype) -> float:
    depth = torch.linspace(1.0, 9.0, WIDTH).expand(1, 1, HEIGHT, WIDTH)
    return against_double(texture(dtype), depth, CAMERA.replace(focus_m=40.0))


@case("depth", "f-number 0.5, 1, 4, 1e3", "float64")
def _(dtype: torch.dtype) -> float:
    depth = torch.linspace(1.2, 6.0, WIDTH).expand(1, 1, HEIGHT, WIDTH)
    return max(against_double(texture(dtype), depth, CAMERA.replace(f_number=n)) for n in (0.5, 1.0, 4.0, 1e3))


@case("depth", "f-number 1e6: a pinhole", "the image itself, bit by bit", float32=0.0, float16=0.0)
def _(dtype: torch.dtype) -> float:
    image = texture(dtype)
    depth = torch.linspace(0.1, 6.0, WIDTH).expand(1, 1, HEIGHT, WIDTH)
    return error(DepthOfField(CAMERA.replace(f_number=1e6))(image, depth), image)


@case("depth", "coc 0, 1e-7 and 0.009", "the image itself, bit by bit", float32=0.0, float16=0.0)
def _(dtype: torch.dtype) -> float:
    image = texture(dtype)
    return max(error(blur_by_coc(image, whole(c)), image) for c in (0.0, 1e-7, -1e-7, 0.009, -0.009))


@case("depth", "coc 0.6 to 23 px, planes", "convolution with the disc")
def _(dtype: torch.dtype) -> float:
    image = texture(dtype)
    return max(error(blur_by_coc(image, whole(c)), convolved(image, c)) for c in (0.625, -1.5, 3.375, -8.75, 23.0))


@case("depth", "coc 1e5 px and larger than the frame", "mean of the frame, continued")
def _(dtype: torch.dtype) -> float:
    image = texture(dtype)
    return max(error(blur_by_coc(image, whole(c)), flattened(image)) for c in (45.0, -45.0, 1e5, -1e5))


@case("depth", "coc from -1e5 to 1e5 px in one frame", "float64")
def _(dtype: torch.dtype) -> float:
    return coc_against_double(texture(dtype), torch.linspace(-1e5, 1e5, WIDTH).expand(1, 1, HEIGHT, WIDTH))


# Light


def _highlight(value: float, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    dark = torch.full((1, 1, HEIGHT, WIDTH), 1e-4, dtype=dtype)
    lit = dark.clone()
    lit[..., HEIGHT // 2, WIDTH // 2] = value
    return dark, lit


def _beyond(radius: float) -> Tensor:
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    return torch.hypot((y - HEIGHT // 2).double(), (x - WIDTH // 2).double()) > radius


def _far_from_highlight(value: float, dtype: torch.dtype, radius: float, support: float) -> float:
    dark, lit = _highlight(value, dtype)
    far = _beyond(support)
    return error(blur_by_coc(lit, whole(radius))[..., far], blur_by_coc(dark, whole(radius))[..., far])


@case("light", "6.5e4 in 1e-4, outside its disc of 5 px", "the dark frame", float32=1e-6, float16=0.0)
def _(dtype: torch.dtype) -> float:
    return _far_from_highlight(6.5e4, dtype, 5.0, 6.0)


@case("light", "1e6 in 1e-4, outside its disc of 5 px (image in float32)", "the dark frame", float32=1e-6, float16=1e-6)
def _(dtype: torch.dtype) -> float:
    return _far_from_highlight(1e6, torch.float32, 5.0, 6.0)


@case("light", "6.5e4 in 1e-4 on a slope, beyond its largest disc", "the dark frame", float32=1e-6, float16=0.0)
def _(dtype: torch.dtype) -> float:
    dark, lit = _highlight(6.5e4, dtype)
    coc = torch.linspace(-3, 5, WIDTH).expand(1, 1, HEIGHT, WIDTH)
    far = _beyond(8.0)
    return error(blur_by_coc(lit, coc)[..., far], blur_by_coc(dark, coc)[..., far])


@case("light", "6.5e4 in 1e-4, inside its disc of 5 px", "convolution with the disc")
def _(dtype: torch.dtype) -> float:
    _, lit = _highlight(6.5e4, dtype)
    near = ~_beyond(4.0)
    return error(blur_by_coc(lit, whole(5.0))[..., near], convolved(lit, 5.0)[..., near])


@case("light", "all zero", "zero, bit by bit", float32=0.0, float16=0.0)
def _(dtype: torch.dtype) -> float:
    black = torch.zeros(1, 3, HEIGHT, WIDTH, dtype=dtype)
    return error(blur_by_coc(black, torch.linspace(-5, 5, WIDTH).expand(1, 1, HEIGHT, WIDTH)), black)


@case("light", "1e-30 everywhere (float16: 1e-7)", "the same constant", float32=1e-6, float16=1e-2)
def _(dtype: torch.dtype) -> float:
    faint = torch.full((1, 3, HEIGHT, WIDTH), 1e-30 if dtype == torch.float32 else 1e-7, dtype=dtype)
    return error(blur_by_coc(faint, torch.linspace(-5, 5, WIDTH).expand(1, 1, HEIGHT, WIDTH)), faint)


# half a unit is lost at each of the hundred taps of a kernel
@case("light", "denormal: 1e-40 everywhere, in units of the smallest float32", "the same constant",
      float32=50.0, float16=0.0)  # fmt: skip
def _(dtype: torch.dtype) -> float:
    faint = torch.full((1, 1, HEIGHT, WIDTH), 1e-40).to(dtype)
    out = blur_by_coc(faint, torch.linspace(-5, 5, WIDTH).expand(1, 1, HEIGHT, WIDTH))
    return float((out.double() - faint.double()).abs().max()) / 2.0**-149


@case("light", "a single pixel lit", "the kernel")
def _(dtype: torch.dtype) -> float:
    image = torch.zeros(1, 1, HEIGHT, WIDTH, dtype=dtype)
    image[..., 12, 16] = 1.0
    kernel = DISC.kernels(torch.tensor([4.5], dtype=torch.float64), WIDTH)[0]
    half = kernel.shape[-1] // 2
    truth = torch.zeros(1, 1, HEIGHT, WIDTH, dtype=torch.float64)
    truth[..., 12 - half : 13 + half, 16 - half : 17 + half] = kernel
    # in float16 what is below its smallest normal number has fewer digits
    apart = blur_by_coc(image, whole(4.5)).double() - truth
    return float((apart.abs() / truth.clamp_min(1e-3)).max())


@case("light", "negative values, a plane", "convolution with the disc, relative to the largest", float32=1e-6)
def _(dtype: torch.dtype) -> float:
    image = texture(dtype) - 0.5
    truth = convolved(image, 3.25)
    return float((blur_by_coc(image, whole(3.25)).double() - truth).abs().max() / truth.abs().max())


@case("light", "negative values, a slope", "float64, relative to the largest", float32=1e-6)
def _(dtype: torch.dtype) -> float:
    image, coc = texture(dtype) - 0.5, torch.linspace(-5, 5, WIDTH).expand(1, 1, HEIGHT, WIDTH)
    truth = blur_by_coc(image.double(), coc.double())
    return float((blur_by_coc(image, coc).double() - truth).abs().max() / truth.abs().max())


@case("light", "65504 everywhere: the largest of float16", "the same constant", float32=1e-6, float16=0.0)
def _(dtype: torch.dtype) -> float:
    bright = torch.full((1, 3, HEIGHT, WIDTH), 65504.0, dtype=dtype)
    return error(blur_by_coc(bright, torch.linspace(-5, 5, WIDTH).expand(1, 1, HEIGHT, WIDTH)), bright)


@case("light", "3e38 everywhere (float16: 65504)", "the same constant", float32=1e-6, float16=0.0)
def _(dtype: torch.dtype) -> float:
    bright = torch.full((1, 1, HEIGHT, WIDTH), min(3e38, torch.finfo(dtype).max), dtype=dtype)
    return error(blur_by_coc(bright, whole(4.0)), bright)


def _step() -> Tensor:
    coc = whole(-5.0)
    coc[..., WIDTH // 2 :] = 4.0
    return coc


@case("light", "1e30 at random beside a depth step (float16: 65504)", "float64")
def _(dtype: torch.dtype) -> float:
    return coc_against_double(texture(torch.float32).mul(min(1e30, torch.finfo(dtype).max)).to(dtype), _step())


@case("light", "1e30 in 0.1, 3 x 3 pixels, beside a depth step (float16: 65504)", "float64, relative to the largest",
      float32=1e-6)  # fmt: skip
def _(dtype: torch.dtype) -> float:
    image = torch.full((1, 3, HEIGHT, WIDTH), 0.1, dtype=dtype)
    image[..., 11:14, 15:18] = min(1e30, torch.finfo(dtype).max)
    truth = blur_by_coc(image.double(), _step())
    return float((blur_by_coc(image, _step()).double() - truth).abs().max() / truth.abs().max())


@case("light", "negative values, a depth step", "float64, relative to the largest")
def _(dtype: torch.dtype) -> float:
    image = texture(dtype) - 0.5
    truth = blur_by_coc(image.double(), _step())
    return float((blur_by_coc(image, _step()).double() - truth).abs().max() / truth.abs().max())


# Sums and quotients


def _constant(coc: Tensor, dtype: torch.dtype, **options: Any) -> float:
    flat = torch.full((1, 3, HEIGHT, WIDTH), 0.75, dtype=dtype)
    return error(blur_by_coc(flat, coc, **options), flat)


@case("sums", "constant image, slope from -20 to 20 px", "the constant", float32=1e-6, float16=0.0)
def _(dtype: torch.dtype) -> float:
    return _constant(torch.linspace(-20, 20, WIDTH).expand(1, 1, HEIGHT, WIDTH), dtype)


@case("sums", "constant image, a depth of its own for every pixel", "the constant", float32=1.2e-6, float16=0.0)
def _(dtype: torch.dtype) -> float:
    noise = torch.randn(1, 1, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(2))
    return max(_constant(reach * noise, dtype) for reach in (1.0, 8.0, 30.0))


@case("sums", "a hole surrounded by nothing: one near pixel before infinity", "the constant", float32=1e-6, float16=0.0)
def _(dtype: torch.dtype) -> float:
    coc = whole(0.0)
    coc[..., 12, 16] = -30.0
    return _constant(coc, dtype)


@case("sums", "empty layers: two far groups of depth", "float64")
def _(dtype: torch.dtype) -> float:
    coc = whole(-18.0)
    coc[..., WIDTH // 2 :] = 18.0
    return coc_against_double(texture(dtype), coc)


@case("sums", "energy of a highlight of 5000 in 0.1", "5000 - 0.1, as a share of it")
def _(dtype: torch.dtype) -> float:
    dark = torch.full((1, 1, HEIGHT, WIDTH), 0.1, dtype=dtype)
    lit = dark.clone()
    lit[..., HEIGHT // 2, WIDTH // 2] = 5000.0
    out = blur_by_coc(lit, whole(4.0)).double() - blur_by_coc(dark, whole(4.0)).double()
    gained = float(lit[..., HEIGHT // 2, WIDTH // 2].double() - dark[..., 0, 0].double())
    return abs(float(out.sum()) / gained - 1)


@case("sums", "2001 layers accumulated", "float64")
def _(dtype: torch.dtype) -> float:
    plan = Plan(tuple(torch.linspace(-1, 1, 2001, dtype=torch.float64).tolist()), 0.0)
    coc = torch.linspace(-1.5, 1.5, HEIGHT * WIDTH).reshape(1, 1, HEIGHT, WIDTH)
    return coc_against_double(texture(dtype, 1), coc, plan=plan)


# Types


@case("types", "HDR: 1e-3 to 6e4 at random", "float64")
def _(dtype: torch.dtype) -> float:
    noise = torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(3))
    image = (10 ** (-3 + 7.75 * noise)).to(dtype)
    return coc_against_double(image, torch.linspace(-5, 5, WIDTH).expand(1, 1, HEIGHT, WIDTH))


@case("types", "the paper's sum, slope from -4 to 4 px", "float64")
def _(dtype: torch.dtype) -> float:
    return coc_against_double(texture(dtype), torch.linspace(-4, 4, WIDTH).expand(1, 1, HEIGHT, WIDTH), occlusion=False)


@case("types", "fold, slope from -4 to 4 px", "float64")
def _(dtype: torch.dtype) -> float:
    return coc_against_double(texture(dtype), torch.linspace(-4, 4, WIDTH).expand(1, 1, HEIGHT, WIDTH), method="fold")


@case("types", "inside autocast to bfloat16", "float64")
def _(dtype: torch.dtype) -> float:
    image, coc = texture(dtype), torch.linspace(-4, 4, WIDTH).expand(1, 1, HEIGHT, WIDTH)
    with torch.autocast("cpu", torch.bfloat16):
        out = blur_by_coc(image, coc)
    return error(out, blur_by_coc(image.double(), coc.double()))
