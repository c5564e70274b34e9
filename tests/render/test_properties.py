"""What holds for any scene: pictures are continuous, stay within the range of the light and turn with the image."""

import dataclasses
import random
from collections.abc import Sequence
from typing import Any

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof import BlurTable, blur_by_coc
from torchdof.reference import metrics
from torchdof.render.highlights import threshold

TABLES = [BlurTable.disc(), BlurTable.gaussian(), BlurTable.load("sato_j15")]
ENGINES = [("native", torch.float32), ("torch", torch.float32), ("torch", torch.float64)]
WAYS = ("filled", "background", "accumulated")
STEP_PX = 1e-4
SHARP_PX = 0.5


@dataclasses.dataclass
class Scene:
    """Arguments of :func:`torchdof.blur_by_coc` in float64, by a seed that reproduces them."""

    seed: int
    image: Tensor
    coc_px: Tensor
    options: dict[str, Any]

    def blurred(self, dtype: torch.dtype, tolerance: float, step_px: float | Tensor = 0.0) -> Tensor:
        options: dict[str, Any] = {k: v.to(dtype) if isinstance(v, Tensor) else v for k, v in self.options.items()}
        coc_px = (self.coc_px + step_px).to(dtype)
        return blur_by_coc(self.image.to(dtype), coc_px, tolerance=tolerance, **options).double()

    def turned(self, turn: Any) -> "Scene":
        options = {k: turn(v).contiguous() if isinstance(v, Tensor) else v for k, v in self.options.items()}
        return Scene(self.seed, turn(self.image).contiguous(), turn(self.coc_px).contiguous(), options)

    def exposed(self, times: float) -> "Scene":
        options = dict(self.options)
        if "background" in options:
            options["background"] = options["background"] * times
        return Scene(self.seed, self.image * times, self.coc_px, options)


def beside_the_edge_of_focus(coc_px: Tensor) -> Tensor:
    """What is in focus passes through, and what is blurred by a hair more does not: no scene is on that edge."""
    return torch.where((coc_px.abs() - SHARP_PX).abs() < 0.002, coc_px + 0.01, coc_px).contiguous()


def random_scene(seed: int, ways: Sequence[str] = WAYS, lamps: bool = True, multiple: int = 1) -> Scene:
    """Images of noise, blocks, gradients and edges; coc of planes, discs, slopes, checkerboards, steps and noise.

    Args:
        seed: Of the random numbers.
        ways: With what is hidden filled in (``"filled"``), before a known ``"background"``, or ``"accumulated"``
            without occlusion: one of these.
        lamps: Whether there may be highlights.
        multiple: Of which the sides of the frame are.
    """
    draw, generator = random.Random(seed), torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    def blocks(values: Tensor, side: int) -> Tensor:
        return values.repeat_interleave(side, -1).repeat_interleave(side, -2)[..., :height, :width]

    height, width = (multiple * draw.randint(1, 64 // multiple) for _ in range(2))
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

    kind = draw.choice(["planes", "planes", "discs", "smooth", "slope", "noise", "checkerboard", "step"])
    if kind == "planes":
        planes = (2.0 * uniform(draw.randint(2, 4)) - 1.0) * radius
        which = torch.randint(len(planes), (1, 1, height // 8 + 1, width // 8 + 1), generator=generator)
        coc_px = blocks(planes[which], 8)
    elif kind == "discs":
        coc_px = torch.full((1, 1, height, width), radius, dtype=torch.float64)
        for _ in range(4):
            row, column, side = draw.random() * height, draw.random() * width, draw.uniform(1, height / 3 + 2)
            is_disc = (y - row) ** 2 + (x - column) ** 2 < side**2
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
        side, ends = (
            draw.choice([1, 3, 8]),
            draw.choice([(-1.1, 0.5), (0.5, 1.5), (-2.0, 0.0), (0.5, 3.0), (-3.0, 3.0)]),
        )
        coc_px = torch.where((y // side + x // side) % 2 > 0, *ends).double()[None, None]
    else:
        step = draw.choice([0.5, 0.999, 1.0, 1.5, 2.0, 2.001])
        coc_px = (draw.uniform(-radius, radius) + step * (x > width / 2) + 0.0 * y)[None, None]

    if draw.random() < 0.3 and lamps:
        image = torch.where(uniform(1, 1, height, width) < 0.01, image * draw.choice([20.0, 200.0]), image)
    options: dict[str, Any] = {
        "table": draw.choice(TABLES),
    }
    way = draw.choice(ways)
    coc_px = beside_the_edge_of_focus(coc_px)
    if way == "accumulated":
        options["occlusion"] = False
    elif way == "background":
        options["background"] = uniform(1, colours, height, width)
        options["background_coc_px"] = beside_the_edge_of_focus(coc_px + radius * draw.random())
    return Scene(seed, image, coc_px, options)


def seeds(count: int) -> Any:
    """Some in every run, 500 in `make sweep`."""
    chunks = [pytest.param(range(count), id=f"{count} scenes")]
    chunks += [pytest.param(range(i, i + 50), id=f"from {i}", marks=pytest.mark.sweep) for i in range(0, 500, 50)]
    return pytest.mark.parametrize("seeds", chunks)


@pytest.fixture(params=ENGINES, ids=["native float32", "torch float32", "torch float64"])
def dtype(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> torch.dtype:
    """The type of the numbers; the engine that takes them is in the environment."""
    engine, dtype = request.param
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    assert isinstance(dtype, torch.dtype)
    return dtype


def rms(difference: Tensor) -> float:
    return float(difference.square().mean().sqrt())


@seeds(20)
@pytest.mark.parametrize(
    ("depth_edges", "tolerance", "most_rms", "most"),
    [
        ("as given", 0.0, 0.05 / 255, 5e-3),
        ("auto", 0.0, 0.05 / 255, 5e-3),
        ("auto", 1 / 255, 0.25 / 255, torch.inf),
    ],
    ids=["as given 0", "0", "1/255"],
)
def test_a_hair_of_depth_changes_the_picture_by_a_hair(
    seeds: range, depth_edges: str, tolerance: float, most_rms: float, most: float, dtype: torch.dtype
) -> None:
    """Also where edges are repaired: decisions fade in, or are off what scenes often hold."""
    for seed in seeds:
        scene = random_scene(seed)
        scene.options["depth_edges"] = depth_edges
        noise = torch.rand(scene.coc_px.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        for step_px in (STEP_PX, -STEP_PX, (2.0 * noise - 1.0) * STEP_PX):
            change = scene.blurred(dtype, tolerance, step_px) - scene.blurred(dtype, tolerance)
            change = change / max(1.0, float(scene.image.max()))
            assert rms(change) < most_rms and float(change.abs().max()) < most, f"scene {seed}"


@seeds(20)
@pytest.mark.parametrize("tolerance", [0.0, 1 / 255], ids=["0", "1/255"])
def test_ordinary_light_stays_within_its_range(seeds: range, tolerance: float, dtype: torch.dtype) -> None:
    for seed in seeds:
        scene = random_scene(seed, lamps=False)
        if bool((scene.image > threshold(scene.image)).any()):
            continue
        light = torch.stack([scene.image, scene.options.get("background", scene.image)])
        out = scene.blurred(dtype, tolerance)
        assert float(light.min()) - 1e-3 <= float(out.min()) and float(out.max()) <= float(light.max()) + 1e-3, seed


@seeds(12)
def test_exposure_decides_nothing(seeds: range, dtype: torch.dtype) -> None:
    for seed in seeds:
        scene = random_scene(seed)
        if dtype == torch.float64:
            scene.options["depth_edges"] = "as given"  # they are repaired in float32
        picture = scene.blurred(dtype, 1 / 255)
        for times in (1e-6, 1e6):
            difference = scene.exposed(times).blurred(dtype, 1 / 255) / times - picture
            most = 1e-9 if dtype == torch.float64 else 1e-4
            assert float(difference.abs().max()) < most * max(1.0, float(scene.image.max())), f"scene {seed}"


@seeds(12)
@pytest.mark.parametrize(("tolerance", "multiple"), [(0.0, 1), (1 / 255, 16)], ids=["0", "1/255"])
@pytest.mark.parametrize("depth_edges", ["as given", pytest.param("auto", marks=pytest.mark.sweep)])
def test_a_turned_scene_is_the_turned_picture(
    seeds: range, depth_edges: str, tolerance: float, multiple: int, dtype: torch.dtype
) -> None:
    """Coarse layers are averaged over blocks from the first pixel on: there the sides are multiples of these."""
    turns = [lambda t: t.flip(-1), lambda t: t.flip(-2), lambda t: t.mT, lambda t: t.rot90(1, (-2, -1))]
    for seed in seeds:
        scene = random_scene(seed, multiple=multiple)
        scene.options["depth_edges"] = depth_edges
        out = scene.blurred(dtype, tolerance)
        for turn in turns:
            difference = scene.turned(turn).blurred(dtype, tolerance) - turn(out)
            assert float(difference.abs().max()) < 1e-4 * max(1.0, float(scene.image.max())), f"scene {seed}"


@seeds(12)
def test_a_flip_of_a_frame_of_any_size_stays_within_the_tolerance(seeds: range) -> None:
    """There the blocks of coarse layers are others."""
    for seed in seeds:
        scene = random_scene(seed)
        scene.options["depth_edges"] = "as given"
        flipped = scene.turned(lambda t: t.flip(-1, -2)).blurred(torch.float32, 1 / 255).flip(-1, -2)
        difference = flipped - scene.blurred(torch.float32, 1 / 255)
        assert rms(difference) < 1 / 255 * max(1.0, float(scene.image.max())), f"scene {seed}"


@pytest.mark.parametrize("size", [16, 40, 56])
def test_the_tolerance_holds_where_blurs_are_as_large_as_the_frame(size: int) -> None:
    for seed in range(6):
        generator = torch.Generator().manual_seed(seed)
        image = 0.05 + 0.9 * torch.rand(1, 3, size, size, generator=generator)
        coc_px = functional.interpolate(torch.rand(1, 1, 4, 4, generator=generator), size=(size, size), mode="bicubic")
        coc_px = (2.0 * coc_px - 1.0) * 20.0
        coc_px[..., size // 3 : 2 * size // 3, size // 3 : 2 * size // 3] = -20.0
        exact, fast = (blur_by_coc(image, coc_px, tolerance=tolerance) for tolerance in (0, 1 / 255))
        error = metrics.display(fast) - metrics.display(exact)
        assert 255 * float(error.square().mean().sqrt()) < 1.0
