"""Scenes shared by tests: hostile cases with known truth, and random scenes by seed."""

import dataclasses
import math
import random
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc
from torchdof.optics.aperture import Aperture
from torchdof.optics.field import Field
from torchdof.render.highlights import threshold
from torchdof.render.layers.layer_weights import from_blur_axis
from torchdof.render.layers.plan import Plan
from torchdof.render.surfaces.border import continued
from torchdof.render.surfaces.windows import mean_around

HEIGHT, WIDTH = 24, 32
CAMERA = Camera(focal_length_mm=50.0, f_number=2.0, focus_m=2.0, sensor_width_mm=4.0)  # 4 px at infinity
WAYS: dict[str, dict[str, Any]] = {
    "over": {"method": "layered", "occlusion": True},
    "sum": {"method": "layered", "occlusion": False},
    "fold-over": {"method": "fold", "occlusion": True},
    "fold-sum": {"method": "fold", "occlusion": False},
}
EVERY_WAY = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
TURNS: dict[str, Callable[[Tensor], Tensor]] = {
    "left-right": lambda t: t.flip(-1),
    "top-bottom": lambda t: t.flip(-2),
    "diagonal": lambda t: t.mT,
    "quarter": lambda t: t.rot90(1, (-2, -1)),
}
Light = Callable[[torch.dtype], Tensor]


def texture(dtype: torch.dtype = torch.float32, channels: int = 3) -> Tensor:
    """Random light from 0.05 to 1."""
    noise = torch.rand(1, channels, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    return (0.05 + 0.95 * noise).to(dtype)


def smooth(channels: int, height: int, width: int, factor: int = 4) -> Tensor:
    """Random light from 0 to 1 without detail finer than ``factor`` pixels."""
    noise = torch.rand(1, channels, height // factor, width // factor, generator=torch.Generator().manual_seed(3))
    return functional.interpolate(noise, (height, width), mode="bicubic").clamp(0.0, 1.0)


def whole(value: float, height: int = HEIGHT, width: int = WIDTH) -> Tensor:
    """A constant map."""
    return torch.full((1, 1, height, width), value)


def slope(first: float, last: float, height: int = HEIGHT, width: int = WIDTH) -> Tensor:
    """A map that is linear from left to right."""
    return torch.linspace(first, last, width).expand(1, 1, height, width).clone()


def overshoots() -> tuple[Tensor, Tensor]:
    """A dark foreground before walls beyond the focus; some pixels at its edge are too near. Light and coc."""
    dice = torch.Generator().manual_seed(3)
    coc = torch.full((1, 1, 80, 96), -8.0)
    coc[..., 38:46] = torch.where(torch.rand(1, 1, 80, 8, generator=dice) < 0.35, -11.3, -8.0)
    walls = torch.rand(1, 1, 8, 6, generator=dice).repeat_interleave(10, 2).repeat_interleave(8, 3)
    coc[..., 48:] = torch.where(walls > 0.5, 47.0, 30.5)
    return torch.where(coc > 0, 0.2, 0.005), coc


def halves(left: float, right: float) -> Tensor:
    """A map of two planes, left and right."""
    values = whole(left)
    values[..., WIDTH // 2 :] = right
    return values


def post_before_lamps(batch: int = 1) -> tuple[Tensor, Tensor]:
    """Light and coc of a post in front of a slope with lamps; blurs of the items fall from the whole to two fifths."""
    light = 0.05 + torch.rand(batch, 3, 96, 128, generator=torch.Generator().manual_seed(0))
    light[..., 7::20, 9::17] = 40.0
    coc_px = slope(-3.0, 14.0, 96, 128).repeat(batch, 1, 1, 1)
    coc_px[..., 50:58] = -11.0
    return light, coc_px * torch.linspace(1.0, 0.4, batch)[:, None, None, None]


RED, BLUE = torch.tensor([0.7, 0.2, 0.1]), torch.tensor([0.1, 0.3, 0.8])


def mixed_edge(share: float, near_px: float = -12.0, far_px: float = 0.0) -> tuple[Tensor, Tensor]:
    """Red in front of blue. Column 31 is mixed: coverage `share` of red, and the depth of the larger part."""
    red = (torch.arange(64) < 31).float()
    red[31] = share
    image = (red * RED[:, None] + (1 - red) * BLUE[:, None])[None, :, None].expand(1, 3, 48, 64)
    coc = torch.where(red >= 0.5, near_px, far_px).expand(1, 1, 48, 64)
    return image, coc


def beyond_the_border(image: Tensor, pixels: int) -> Tensor:
    """An image of one plane, continued on all sides."""
    one = torch.ones_like(image[:, :1])
    return continued([image], one, threshold(image), (pixels,) * 4, pixels, one, one)[0]


def disc(image: Tensor, coc_px: Tensor, table: BlurTable | None = None) -> Tensor:
    """Closed form for a plane: the image, continued outside its border, convolved with a kernel, in float64."""
    image, radius = image.double(), coc_px.flatten()[:1].double()
    if table is None:
        half = max(image.shape[-2:]) - 1  # the largest distance between two pixels of the frame
        kernel = BlurTable.disc().kernels(radius, image.shape[-1], window=2 * half + 1)[0]
    else:
        kernel = table.kernels(radius, image.shape[-1])[0]
    half = kernel.shape[-1] // 2
    wide = beyond_the_border(image, half)
    return functional.conv2d(wide, kernel.expand(image.shape[1], -1, -1)[:, None], groups=image.shape[1])


def mean(image: Tensor, _: Tensor) -> Tensor:
    """Closed form for a blur far larger than the frame: means over a square of twice its longer side."""
    half = max(image.shape[-2:]) - 1
    wide = beyond_the_border(image, half)
    return functional.avg_pool2d(wide, 2 * half + 1, stride=1)


def itself(image: Tensor, _: Tensor) -> Tensor:
    """Closed form in focus, and for constant light: the image."""
    return image


@dataclasses.dataclass(frozen=True)
class Case:
    """A hostile scene of 32 x 24 pixels with its truth and limits of the error."""

    name: str
    maps: Sequence[Tensor]  # circles of confusion in pixels, or depths in metres if there are cameras; one picture each
    truth: Callable[[Tensor, Tensor], Tensor] | None = None  # of image and coc; None: the same rendering in float64
    light: Light = texture  # the image as a function of the dtype
    cameras: Sequence[Camera] = ()  # one for each map, or one for all
    float32: float = 1e-5  # largest relative errors
    float16: float = 2**-11 + 1e-5
    per: Callable[[Tensor], Tensor] = Tensor.abs  # divisor of the error, as a function of the truth
    where: Tensor | None = None  # pixels that are checked
    options: dict[str, Any] = dataclasses.field(default_factory=dict)

    def pairs(self, dtype: torch.dtype = torch.float32) -> Iterator[tuple[Tensor, Tensor, Camera | None]]:
        """Image, map and camera of each picture; without a camera the map is a circle of confusion."""
        cameras: Sequence[Camera | None] = self.cameras or [None]
        for i in range(max(len(self.maps), len(cameras))):
            yield self.light(dtype), self.maps[i % len(self.maps)], cameras[i % len(cameras)]

    def error(self, dtype: torch.dtype) -> float:
        """The largest error in any of the pictures; infinite if a picture is not finite."""
        errors = []
        for image, values, camera in self.pairs(dtype):
            exact = image.double(), values.double()
            out = rendered(image, values, camera, **self.options).double()
            if self.truth is None:
                truth = rendered(*exact, camera, **self.options)
            else:
                truth = self.truth(exact[0], exact[1] if camera is None else camera.coc_px(exact[1], WIDTH))
            apart = torch.where(out == truth, 0.0, (out - truth).abs() / self.per(truth).clamp_min(1e-300))
            errors.append(torch.nan_to_num(apart if self.where is None else apart[..., self.where], nan=math.inf).max())
        return float(max(errors))


def rendered(image: Tensor, values: Tensor, camera: Camera | None, **options: Any) -> Tensor:
    """The picture; without a camera ``values`` are circles of confusion, else depths."""
    if camera is None:
        return blur_by_coc(image, values, **options)
    return DepthOfField(camera, **options)(image, values)


def even(value: float, channels: int = 3) -> Light:
    """Constant light, clamped to the largest number of the dtype."""
    return lambda dtype: torch.full((1, channels, HEIGHT, WIDTH), min(value, torch.finfo(dtype).max), dtype=dtype)


def highlight(value: float, around: float = 1e-4, side: int = 1) -> Light:
    """A square of light in the middle of the frame."""

    def light(dtype: torch.dtype) -> Tensor:
        image = torch.full((1, 1, HEIGHT, WIDTH), around, dtype=dtype)
        rows, columns = (slice(n // 2 - side // 2, n // 2 + side // 2 + 1) for n in (HEIGHT, WIDTH))
        image[..., rows, columns] = min(value, torch.finfo(image.dtype).max)
        return image

    return light


def beyond(radius: float) -> Tensor:
    """Mask of the pixels farther than ``radius`` from the middle."""
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    return torch.hypot((y - HEIGHT // 2).double(), (x - WIDTH // 2).double()) > radius


def noise(seed: int) -> Tensor:
    """A map of normal numbers."""
    return torch.randn(1, 1, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed))


def _near_a_node(offset: int) -> Tensor:
    """Two planes; the nearer one is ``offset`` units in the last place from a layer's node."""
    plan = Plan.for_scene(torch.tensor([[[[0.0, 9.0]]]]), 1 / 255, adapt=False)
    node = torch.tensor(next(c for c in plan.coc_px if 2 < c < 6))
    coc = halves(float(torch.nextafter(node, node + offset)), 9.0)
    coc[..., 0, 0] = 0.0
    return coc


def _with(values: Tensor, *place: Any, value: float) -> Tensor:
    values = values.clone()
    values[(..., *place)] = value
    return values


_CHECKERBOARD = torch.where((torch.arange(HEIGHT)[:, None] + torch.arange(WIDTH)) % 2 == 0, 1.2, 30.0)[None, None]
_FAR = _with(_with(whole(1e-6), slice(8, 20), value=1e12), slice(20, None), value=math.inf)
_COC = slope(-5.0, 5.0)
_MANY = Plan(tuple(torch.linspace(-1, 1, 2001).double().tolist()), 0.0)
_FOCUS_ENDS = from_blur_axis(1e-12)
_EXACT: dict[str, Any] = {"float32": 0.0, "float16": 0.0}
# outside the disc of a highlight: the light around it
_DARK: dict[str, Any] = {"truth": lambda i, _: torch.full_like(i, float(i.min())), "float32": 1e-6, "float16": 0.0}
_BRIGHTEST: dict[str, Any] = {"per": lambda truth: truth.abs().max()}
_DECADES = torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(3))
_EVEN: dict[str, Any] = {"truth": itself, "float32": 1e-6, "float16": 0.0}

CASES = [
    Case("infinity, 1e12 m and 3.1 m everywhere", [whole(v) for v in (math.inf, 1e12, 3.1)], disc, cameras=[CAMERA]),
    Case("1e-6 m everywhere: a blur of 4e6 px", [whole(1e-6)], mean, cameras=[CAMERA]),
    Case("1e-6 m, 1e12 m and infinity side by side", [_FAR], cameras=[CAMERA]),
    Case("all in focus", [whole(2.0)], itself, cameras=[CAMERA], **_EXACT),
    Case("a step at every pixel", [_CHECKERBOARD], cameras=[CAMERA]),
    Case("noise over four decades", [2.0 * 10 ** noise(1).clamp(-1, 3)], cameras=[CAMERA]),
    Case("focus at infinity", [_with(slope(3.0, 50.0), slice(-4, None), value=math.inf)],
         cameras=[CAMERA.replace(focus_m=math.inf)]),
    Case("f-number 1e6: a pinhole", [slope(0.1, 6.0)], itself, cameras=[CAMERA.replace(f_number=1e6)], **_EXACT),
    Case("one unit in the last place to either side of a node", [_near_a_node(-1), _near_a_node(1)],
         lambda image, _: blur_by_coc(image, _near_a_node(0).double())),
    Case("just in focus", [whole(c * _FOCUS_ENDS) for c in (0.9999, -0.9999)], itself, **_EXACT),
    Case("just out of focus", [whole(c * _FOCUS_ENDS) for c in (1.0001, -1.0001)], disc),
    Case("coc 0.6 to 23 px", [whole(c) for c in (0.625, 1.0, -1.5, 3.375, -8.75, 12.75, 23.0)], disc),
    Case("coc larger than the frame", [whole(c) for c in (45.0, -45.0, 1e5, -1e5)], mean),
    Case("coc from -1e5 to 1e5 px in one frame", [slope(-1e5, 1e5)]),
    Case("two far groups of depth and nothing between", [halves(-18.0, 18.0)]),
    Case("6.5e4 in 1e-4, outside its disc of 5 px", [whole(5.0)], light=highlight(6.5e4), where=beyond(6.0), **_DARK),
    Case("6.5e4 in 1e-4 on a slope, beyond its largest disc", [slope(-3, 5)], light=highlight(6.5e4),
         where=beyond(8.0), **_DARK),
    Case("6.5e4 in 1e-4, inside its disc of 5 px", [whole(5.0)], disc, highlight(6.5e4), where=~beyond(4.0)),
    Case("a single pixel lit", [whole(4.5)], disc, highlight(1.0, 0.0), per=lambda truth: truth.clamp_min(1e-3)),
    Case("all zero", [_COC], itself, even(0.0), **_EXACT),
    Case("1e-30 everywhere (float16: 1e-7)", [_COC], itself, lambda d: even(1e-30 if d == torch.float32 else 1e-7)(d),
         float32=1e-6, float16=1e-2),
    # half a unit is lost at each of the hundred taps of a kernel
    Case("1e-40 everywhere, in units of the smallest float32", [_COC], itself, even(1e-40, 1),
         float32=50.0, float16=0.0, per=lambda truth: torch.full_like(truth, 2.0**-149)),
    Case("negative light, a plane, a slope, a step", [whole(3.25), _COC, halves(-5.0, 4.0)],
         light=lambda d: texture(d) - 0.5, **_BRIGHTEST),
    Case("negative light, a plane, in closed form", [whole(3.25)], disc, lambda d: texture(d) - 0.5, float32=1e-6,
         **_BRIGHTEST),
    Case("3e38 everywhere (float16: 65504)", [whole(4.0)], light=even(3e38, 1), **_EVEN),
    Case("1e30 at random beside a depth step (float16: 65504)", [halves(-5.0, 4.0)], 
         light=lambda d: texture().mul(min(1e30, torch.finfo(d).max)).to(d)),
    Case("1e30 in 0.1, 3 x 3 pixels, beside a depth step (float16: 65504)", [halves(-5.0, 4.0)], **_BRIGHTEST,
         light=highlight(1e30, 0.1, side=3), float32=1e-6),
    Case("even light, a depth of its own for every pixel", [r * noise(2) for r in (1.0, 8.0, 30.0)], itself, even(0.75),
         float32=1.2e-6, float16=0.0),
    Case("even light, cat's eyes", [slope(-12, 14)], itself, even(0.75), float32=1.2e-6, float16=0.0,
         options={"table": BlurTable.disc().replace(aperture=Aperture(vignetting=0.4))}),
    Case("even light, one near pixel before infinity", [_with(whole(0.0), 12, 16, value=-30.0)], light=even(0.75),
         **_EVEN),
    Case("2001 layers accumulated", [torch.linspace(-1.5, 1.5, HEIGHT * WIDTH).reshape(1, 1, HEIGHT, WIDTH)],
         light=lambda d: texture(d, 1), options={"plan": _MANY}),
    Case("light from 1e-3 to 6e4 at random", [_COC], light=lambda d: (10 ** (-3 + 7.75 * _DECADES)).to(d)),
    Case("a slope by the sum of the paper", [slope(-4, 4)], options=WAYS["sum"]),
    Case("a slope by the literal scatter", [slope(-4, 4)], options=WAYS["fold-over"]),
]  # fmt: skip


# Random scenes


def lens_with_a_field(colours: int = 3, unit: float = 1.0, **change: Any) -> BlurTable:
    """A lens with random spots that change across the field; ``unit`` is a factor on all lengths."""
    dice = torch.Generator().manual_seed(colours)
    coc, radius = unit * torch.tensor([-0.4, -0.1, 0.2, 0.5]), unit * torch.tensor([0.0, 9.0, 20.0])
    box = (torch.rand(4, 3, 3, generator=dice) + 0.5) * coc.abs()[:, None, None]
    given = {"coc": coc, "radius": radius, "box": box, "light": torch.rand(colours, 4, 3, 8, 6, generator=dice) + 0.1}
    field = Field(**{**given, **change})
    ends = unit * torch.tensor([-0.4, 0.5])
    params = {"radius": ends.abs().expand(colours, -1)}
    return BlurTable("disc", ends, params, unit="mm", sensor_width_mm=36.0 * unit, field=field)


TABLES = [BlurTable.disc(), BlurTable.gaussian(), BlurTable.load("sato_j15")]
KINDS = ("planes", "planes", "discs", "smooth", "slope", "noise", "checkerboard", "step")
SHARP_PX = 0.5


@dataclasses.dataclass
class Scene:
    """Arguments of :func:`torchdof.blur_by_coc` in float64."""

    image: Tensor
    coc_px: Tensor
    options: dict[str, Any]

    def blurred(self, dtype: torch.dtype = torch.float32, step_px: float | Tensor = 0.0, **options: Any) -> Tensor:
        """The picture rendered in ``dtype``, with ``step_px`` added to the circle of confusion."""
        given = {**self.options, **options}
        given = {k: v.to(dtype) if isinstance(v, Tensor) else v for k, v in given.items()}
        return blur_by_coc(self.image.to(dtype), (self.coc_px + step_px).to(dtype), **given)

    def turned(self, turn: Callable[[Tensor], Tensor]) -> "Scene":
        """The scene with a flip or transpose ``turn`` applied to all maps."""
        options = {k: turn(v).contiguous() if isinstance(v, Tensor) else v for k, v in self.options.items()}
        return Scene(turn(self.image).contiguous(), turn(self.coc_px).contiguous(), options)

    def exposed(self, times: float) -> "Scene":
        """The scene with light multiplied by ``times``."""
        options = {k: v * times if k == "background" else v for k, v in self.options.items()}
        return Scene(self.image * times, self.coc_px, options)


def _beside_the_edge_of_focus(coc_px: Tensor) -> Tensor:
    """Moves radii away from ``SHARP_PX``, where the picture is discontinuous."""
    return torch.where((coc_px.abs() - SHARP_PX).abs() < 0.002, coc_px + 0.01, coc_px).contiguous()


def random_scene(
    seed: int,
    ways: Sequence[str] = ("filled", "background", "accumulated"),
    lamps: bool = True,
    multiple: int = 1,
    side: int = 64,
    kinds: Sequence[str] = KINDS,
) -> Scene:
    """A random image and coc map of random ``kinds``, ways of rendering and sides, with highlights if ``lamps``."""
    draw, generator = random.Random(seed), torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    def blocks(values: Tensor, side: int) -> Tensor:
        return values.repeat_interleave(side, -1).repeat_interleave(side, -2)[..., :height, :width]

    height, width = (multiple * draw.randint(1, side // multiple) for _ in range(2))
    colours, radius = draw.choice([1, 3]), draw.choice([0.7, 1.5, 3.0, 6.0, 12.0, 20.0])
    y, x = torch.arange(height, dtype=torch.float64)[:, None], torch.arange(width, dtype=torch.float64)

    kind = draw.choice(["noise", "gradients", "blocks", "edges"])
    image = uniform(1, colours, height, width)
    if kind == "gradients":
        image = functional.interpolate(uniform(1, colours, 3, 4), size=(height, width), mode="bicubic").clamp(0, 1)
    elif kind == "blocks":
        image = blocks(uniform(1, colours, height // 5 + 1, width // 5 + 1), 5)
    elif kind == "edges":
        image = 0.05 + 0.9 * (image < 0.5).double()

    kind = draw.choice(kinds)
    if kind == "planes":
        planes = (2.0 * uniform(draw.randint(2, 4)) - 1.0) * radius
        which = torch.randint(len(planes), (1, 1, height // 8 + 1, width // 8 + 1), generator=generator)
        coc_px = blocks(planes[which], 8)
    elif kind == "quarters":  # multiples of a quarter pixel lie exactly on many thresholds
        steps = torch.randint(-4, 5, (1, 1, height // 8 + 1, width // 8 + 1), generator=generator)
        coc_px = blocks((steps * radius).round().double() / 4, 8)
    elif kind == "discs":
        coc_px = torch.full((1, 1, height, width), radius, dtype=torch.float64)
        for _ in range(4):
            row, column, size = draw.random() * height, draw.random() * width, draw.uniform(1, height / 3 + 2)
            is_disc = (y - row) ** 2 + (x - column) ** 2 < size**2
            coc_px = torch.where(is_disc, coc_px.clamp(max=draw.uniform(-radius, radius)), coc_px)
            image = torch.where(is_disc, 0.5 * image + 0.5 * draw.random(), image)
    elif kind == "smooth":
        coarse = (2.0 * uniform(1, 1, 3, 4) - 1.0) * radius
        coc_px = functional.interpolate(coarse, size=(height, width), mode="bicubic")
    elif kind == "slope":
        coc_px = (radius * (2.0 * y / height - 1.0) + 0.0 * x)[None, None]
    elif kind == "noise":
        coc_px = (2.0 * uniform(1, 1, height, width) - 1.0) * radius
    elif kind == "checkerboard":
        size = draw.choice([1, 3, 8])
        ends = draw.choice([(-1.1, 0.5), (0.5, 1.5), (-2.0, 0.0), (0.5, 3.0), (-3.0, 3.0)])
        coc_px = torch.where((y // size + x // size) % 2 > 0, *ends).double()[None, None]
    else:
        step = draw.choice([0.5, 0.999, 1.0, 1.5, 2.0, 2.001])
        coc_px = (draw.uniform(-radius, radius) + step * (x > width / 2) + 0.0 * y)[None, None]

    if draw.random() < 0.3 and lamps:
        image = torch.where(uniform(1, 1, height, width) < 0.01, image * draw.choice([20.0, 200.0]), image)
    options: dict[str, Any] = {"table": draw.choice(TABLES)}
    way = draw.choice(ways)
    coc_px = _beside_the_edge_of_focus(coc_px)
    if way == "accumulated":
        options["occlusion"] = False
    elif way == "background":
        options["background"] = uniform(1, colours, height, width)
        options["background_coc_px"] = _beside_the_edge_of_focus(coc_px + radius * draw.random())
    return Scene(image, coc_px, options)


def made(kind: str, height: int, width: int, radius: float, **options: Any) -> Scene:
    """Random light, multiplied by ``lamps`` on a grid of pixels, and a smooth coc map or one of three planes."""
    torch.manual_seed(options.pop("seed", 3))
    items, lamps = options.pop("items", 1), options.pop("lamps", 1.0)
    image = torch.rand(items, 3, height, width)
    image[..., height // 5 :: 9, width // 6 :: 13] *= lamps
    if kind == "smooth":
        coarse = (torch.rand(items, 1, 3, 4) * 2 - 1) * radius
        return Scene(image, functional.interpolate(coarse, size=(height, width), mode="bicubic"), options)
    regions = torch.randint(0, 3, (items, 1, height // 16 + 1, width // 16 + 1))
    planes = ((torch.rand(3) * 2 - 1) * radius)[regions]
    return Scene(image, functional.interpolate(planes, size=(height, width)), options)


def assert_same_picture(plain: Tensor, compiled: Tensor, image: Tensor) -> None:
    """Asserts that pictures differ by at most 1e-5 of the light nearby."""
    assert plain.dtype == compiled.dtype and plain.shape == compiled.shape
    assert torch.equal(torch.isfinite(plain), torch.isfinite(compiled))
    plain, compiled, image = (torch.nan_to_num(t.float(), 0.0, 0.0, 0.0) for t in (plain, compiled, image))
    light = functional.pad(torch.maximum(plain.abs(), image), (8,) * 4, mode="replicate")
    nearby = functional.max_pool2d(light, 17, 1).amax(1, keepdim=True)
    assert float(((plain - compiled).abs() / (nearby + 1e-6)).max()) <= 1e-5


def pixels_from_post(width: int) -> Tensor:
    """Pixels from the post to each column."""
    return (torch.arange(width) - 70).abs() - 20


def wavy_post(height: int = 224, width: int = 160) -> tuple[Tensor, Tensor, Tensor]:
    """An image of a dark post before a background in focus, a soft map whose edges wind about it, and the exact map."""
    generator = torch.Generator().manual_seed(0)
    beside, rows = pixels_from_post(width), torch.arange(height)[:, None]
    light = torch.where(beside < 0, 0.1, 0.8) * (1 + 0.05 * torch.randn(3, height, width, generator=generator))
    bends = beside + 0.5 + 3.5 * torch.sin(2 * math.pi * rows / 20)
    soft = torch.where(bends < 0, -12.0, 0.5)[None, None]
    for _ in range(2):
        soft = mean_around(soft, 2)
    exact = torch.where(beside < 0, -12.0, 0.5).expand(1, 1, height, -1)
    return light.clamp_min(0)[None].contiguous(), soft.contiguous(), exact


def resized_post(spread: float, by_px: int, widths: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
    """An image of a slanted post, a map of the coc in which it is wider by ``by_px`` on each side, and the exact map.

    Light of the post and of its background varies by ``spread``, the standard deviation of its logarithm. Means over
    each of ``widths`` pixels, one after the other, soften the map; without any it is hard.
    """
    columns, rows = torch.arange(160), torch.arange(224)[:, None]
    beside = (columns - 70 + 0.3 * (rows - 112)).abs() - 20
    return _before_background(beside < 0, beside < by_px, spread, widths)


def shifted_disc(spread: float, right: int, down: int, widths: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
    """An image of a disc, a map of the coc that is moved by ``right`` and ``down`` pixels, and the exact map.

    Other arguments as for :func:`resized_post`.
    """
    is_disc = (torch.arange(192) - 90).square() + (torch.arange(176)[:, None] - 80).square() < 60**2
    return _before_background(is_disc, is_disc.roll((down, right), (-2, -1)), spread, widths)


def _before_background(
    is_near: Tensor, is_given: Tensor, spread: float, widths: Sequence[int]
) -> tuple[Tensor, Tensor, Tensor]:
    """The image where ``is_near [H, W]`` is in front, the map where ``is_given`` is, softened, and the exact map."""
    generator = torch.Generator().manual_seed(0)
    light = torch.where(is_near, 0.25, 0.6) * torch.exp(spread * torch.randn(is_near.shape, generator=generator))
    exact, given = (torch.where(near, -12.0, 0.5)[None, None] for near in (is_near, is_given))
    for side in widths:
        given = mean_around(given, side // 2)
    return light.expand(1, 3, -1, -1).contiguous(), given.contiguous(), exact


def furry_post(
    background: float = 0.8, height: int = 224, width: int = 160, noise: float = 0.02
) -> tuple[Tensor, Tensor, Tensor]:
    """An image of a dark furry post before a background, a map of the coc without its hairs, and the exact map.

    Four rows of five have hairs, two to eight px long, on both sides. The background is smooth for the repair with a
    ``noise``, relative to the light, of 0.02, but not with 0.1.
    """
    generator = torch.Generator().manual_seed(0)
    lengths = torch.randint(2, 9, (height // 2 + 1,), generator=generator).repeat_interleave(2)[:height, None]
    beside = pixels_from_post(width) - lengths * (torch.arange(height) % 5 < 4)[:, None]
    is_near = beside < 0
    light = torch.where(is_near, 0.05, background) * (1 + noise * torch.randn(height, width, generator=generator))
    given = torch.where(pixels_from_post(width) < 0, -12.0, 0.5).expand(height, -1)
    exact = torch.where(is_near, -12.0, 0.5)
    return light.clamp_min(0).expand(1, 3, -1, -1).contiguous(), given[None, None].contiguous(), exact[None, None]
