"""The steps of a differentiated rendering that the compiled engine computes equal the plain engine's."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchdof import BlurTable, blur_by_coc, native
from torchdof.render.engines.ops import EAGER, Level
from torchdof.render.layers.plan import Plan
from torchdof.render.surfaces import disocclusion
from torchdof.render.surfaces.frame import Beyond, Surface, pad_to_frame
from torchdof.render.surfaces.matting import matte
from torchdof.tensors import TRACEABLE

pytestmark = pytest.mark.skipif(not native.chosen(), reason="the compiled engine is not built")

BY_COLOUR = BlurTable("gaussian", [1.0], {"sigma": torch.tensor([[0.4], [0.5], [0.6]])})
WAYS: dict[str, dict[str, Any]] = {
    "over": {},
    "no light behind": {"coc": (3.0, 3.0)},
    "sum": {"occlusion": False},
    "plain sum": {"occlusion": False, "normalize": False},
    "coarse": {"coc": (-40.0, 40.0)},
    "coarse only": {"coc": (20.0, 40.0)},
    "coarse sum": {"coc": (-40.0, 40.0), "occlusion": False},
    "in front of focus": {"coc": (-30.0, -9.0)},
    "by colour": {"table": BY_COLOUR},
    "by colour, sum": {"table": BY_COLOUR, "occlusion": False},
    "triangle": {"table": BlurTable.polygon(3, 20.0, squeeze=1.6)},
    "holes": {"check": False, "hole": True},
    "nodes in the map": {"plan": Plan((-9.0, -2.0, 0.0, 3.0, 8.0), 1 / 255)},
    "two channels": {"channels": 2},
}


def scene(coc: tuple[float, float] = (-12.0, 12.0), channels: int = 3, hole: bool = False) -> tuple[Tensor, Tensor]:
    """Two images with patches of two slopes, none of their sides a multiple of a block's."""
    generator = torch.Generator().manual_seed(5)
    image = 0.05 + torch.rand(2, channels, 54, 75, generator=generator)
    patch = torch.rand(2, 1, 6, 8, generator=generator).repeat_interleave(10, 2).repeat_interleave(10, 3)
    slopes = torch.linspace(0.0, 0.6, 75) + torch.linspace(0.0, 0.4, 54)[:, None]
    part = torch.where(patch[..., :54, :75] > 0.7, 1.0 - slopes, slopes)
    radius = coc[0] + (coc[1] - coc[0]) * part
    if hole:
        radius[..., 20:24, 30:33] = math.nan
    return image, radius


def rendered(way: dict[str, Any], dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor, Tensor]:
    """A picture, and the gradients of a random sum over it by light and coc."""
    options = dict(way)
    made = {name: options.pop(name) for name in ("coc", "channels", "hole") if name in options}
    image, coc = scene(**made)
    if "plan" in options:  # some pixels lie exactly at nodes, where ramps have a kink
        coc[..., 30:40, :] = options["plan"].coc_px[3]
    image, coc = image.to(dtype).requires_grad_(), coc.to(dtype if dtype == torch.float64 else torch.float32)
    out = blur_by_coc(image, coc.requires_grad_(), **options)
    seen = torch.rand(out.shape, generator=torch.Generator().manual_seed(1)) - 0.3
    of_light, of_coc = torch.autograd.grad((out * seen).sum(), (image, coc))
    return out.detach(), of_light, of_coc


STEPS = ("blend", "continued", "farthest", "look_behind", "matte")


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[tuple[Any, ...]]]:
    """The arguments of every gradient that the compiled engine computes, by the name of its step."""
    found: dict[str, list[tuple[Any, ...]]] = {step: [] for step in STEPS}

    def recorded(step: str, gradient: Any, *arguments: Any) -> list[Tensor]:
        found[step].append(arguments)
        return list(gradient(*arguments))

    for step in STEPS:
        gradient = getattr(native, f"{step}_gradient")
        monkeypatch.setattr(native, f"{step}_gradient", functools.partial(recorded, step, gradient))
    return found


def difference(values: Tensor, other: Tensor) -> float:
    """Norm of a difference, relative to the second argument's."""
    return float((values - other).norm() / other.norm())


def assert_both_engines_agree(
    computed: Callable[[], Sequence[Tensor]], of_step: list[Any], most: Sequence[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The compiled engine computes a gradient for each of two items; the plain engine's results are the same."""
    found = computed()
    assert len(of_step) == 2
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    for ours, plain, limit in zip(found, computed(), most, strict=True):
        assert difference(ours, plain) < limit
    assert len(of_step) == 2


@pytest.mark.parametrize("name", WAYS)
def test_pictures_and_gradients_equal_the_plain_engines(
    name: str, calls: dict[str, list[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert_both_engines_agree(lambda: rendered(WAYS[name]), calls["blend"], (1e-6, 1e-5, 5e-5), monkeypatch)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("name", ["over", "coarse", "sum", "by colour", "holes"])
def test_gradients_have_the_same_bits_for_any_number_of_threads(
    name: str, step: str, calls: dict[str, list[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered(WAYS[name])
    if "sum" in name and step not in ("blend", "continued"):
        assert not calls[step]
        return
    gradient, threads = getattr(native, f"{step}_gradient"), torch.get_num_threads()
    of_second = calls[step][1::2]
    assert of_second

    def computed() -> list[Tensor]:
        return [t for arguments in of_second for t in gradient(*arguments)]

    try:
        results = []
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            results.append(computed())
    finally:
        torch.set_num_threads(threads)
    monkeypatch.setattr(native, "_instructions", "baseline")
    baseline = computed()
    for one, two, five, other in zip(*results, baseline, strict=True):
        assert torch.equal(one, two) and torch.equal(one, five)
        assert float((other - one).norm()) <= 5e-5 * float(one.norm())


def test_float64_is_the_plain_engines_and_differs_by_rounding_alone(calls: dict[str, list[Any]]) -> None:
    exact = rendered({}, torch.float64)
    assert not any(calls.values())
    for ours, other in zip(rendered({}), exact, strict=True):
        assert difference(ours.double(), other) < 2e-5


@pytest.mark.parametrize("left", [0, 22])
def test_the_gradient_of_a_gradient_is_the_plain_engines(left: int) -> None:
    def curvature(dtype: torch.dtype) -> list[Tensor]:
        image, coc = (t[:1, :, :20, left : left + 30].to(dtype).requires_grad_() for t in scene((-4.0, 4.0)))
        out = blur_by_coc(image, coc)
        (first,) = torch.autograd.grad(out.square().sum(), coc, create_graph=True)
        (second,) = torch.autograd.grad(first.square().sum(), image)
        return [first.detach(), second]

    for ours, exact in zip(curvature(torch.float32), curvature(torch.float64), strict=True):
        assert difference(ours.double(), exact) < 5e-5


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # raised inside PyTorch for tangents
def test_forward_mode_and_torch_func_agree_with_reverse_mode() -> None:
    image, coc = (t[:1, :, :20, :30] for t in scene((-4.0, 4.0)))
    step, seen = torch.rand_like(image), torch.rand_like(image)

    def total(light: Tensor) -> Tensor:
        return (blur_by_coc(light, coc) * seen).sum()

    (slope,) = torch.autograd.grad(total(leaf := image.clone().requires_grad_()), leaf)
    with forward_ad.dual_level():
        along = forward_ad.unpack_dual(total(forward_ad.make_dual(image, step))).tangent
    torch.testing.assert_close(along, (slope * step).sum())
    if TRACEABLE:  # older PyTorch is refused by name
        torch.testing.assert_close(torch.func.grad(total)(image), slope, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("channels", [1, 3])
def test_surfaces_behind_and_their_gradients_equal_the_plain_engines(
    channels: int, calls: dict[str, list[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Levels of random samples, some empty; some pixels lie exactly where a level begins or ceases to count more."""
    generator, levels = torch.Generator().manual_seed(3), []
    coc = 20.0 * torch.rand(2, 1, 70, 101, generator=generator) - 10.0
    coc[..., 5:9] = 2.0
    for step, slope, most in ((2, 4.0, 0.5), (4, 2.0, 0.25), (4, 1.0, math.inf)):
        values = torch.rand(2, channels + 2, 80 // step, 112 // step, generator=generator)
        values[:, -2] = 20.0 * values[:, -2] - 8.0
        values[:, -1] *= torch.rand(values[:, -1].shape, generator=generator) > 0.3
        values[:, -2, :6, :6], values[:, -1, :6, :6] = 30.0, min(most / slope, 1.0)
        levels.append(Level(values, step, step / 4.0, slope, most))
    seen = torch.rand(2, channels + 2, 70, 101, generator=generator) - 0.3

    def looked() -> list[Tensor]:
        leaves = [t.clone().requires_grad_() for t in (coc, *(level.values for level in levels))]
        given = [level._replace(values=t) for level, t in zip(levels, leaves[1:], strict=True)]
        out = torch.cat(disocclusion._seen(given, leaves[0]), 1)
        return [out.detach(), *torch.autograd.grad((out * seen).sum(), leaves)]

    assert_both_engines_agree(looked, calls["look_behind"], [1e-4] * 5, monkeypatch)


@pytest.mark.parametrize(("channels", "count"), [(1, 1), (3, 2), (3, 4), (native.MOST_PLANES, 7)])
@pytest.mark.parametrize("size", [(70, 101), (1, 1), (5, 260)])
def test_coarser_levels_and_surfaces_behind_cells_equal_the_plain_engines(
    channels: int, count: int, size: tuple[int, int], calls: dict[str, list[Any]]
) -> None:
    """A pyramid of random samples, some empty or equal; the pixels of some cells are equal, or none is wanted."""
    generator = torch.Generator().manual_seed(4)
    whole = [disocclusion._continued(n, 2**count) for n in size]
    finest = torch.rand(2, channels + 2, whole[0] // 2, whole[1] // 2, generator=generator)
    finest[:, -2] = 20.0 * finest[:, -2] - 8.0
    finest[:, -1] *= torch.rand(finest[:, -1].shape, generator=generator) > 0.3
    finest[:, -2, :8] = 11.0 - torch.arange(finest.shape[-1]) % 2  # equal ones in front of equal ones
    finest[:, -1, :8] = 1.0
    coc = 20.0 * torch.rand(2, 1, *size, generator=generator) - 10.0
    coc[..., :20] = coc[..., :20].round() + 0.3
    wanted = (torch.rand(coc.shape, generator=generator) > 0.9).float()
    wanted[..., 0] = 1.0

    def computed(dtype: torch.dtype) -> list[Tensor]:
        leaves = [t.to(dtype).requires_grad_() for t in (coc, finest)]
        pyramid = [leaves[1]]
        for _ in range(1, count):
            pyramid.append(disocclusion.coarser_level(pyramid[-1]))
        levels = [Level(t, 2**i, 2.0 ** (i - 2), 3.5 * 0.35 ** (i - 1), 0.35**i) for i, t in enumerate(pyramid, 1)]
        cells = (whole[0] // 4, whole[1] // 4)
        out = disocclusion.behind_cells(levels, cells, leaves[0], wanted.to(dtype), EAGER)
        values, votes, coarse = out.split([channels + 1, 1, out.shape[1] - channels - 2], 1)
        out = torch.cat([values * (votes > 0), votes, coarse], 1)
        seen = torch.rand(out.shape, generator=torch.Generator().manual_seed(1)) - 0.3
        return [out.detach(), *torch.autograd.grad((out * seen).sum(), leaves)]

    exact = computed(torch.float64)
    assert not any(calls.values())
    for ours, plain in zip(computed(torch.float32), exact, strict=True):
        assert (ours - plain).norm() <= 1e-4 * plain.norm()
    assert [len(calls[step]) for step in ("farthest", "look_behind")] == [2 * count - 2, 2]


def edges(channels: int, hole: bool) -> tuple[Tensor, Tensor, Tensor | None]:
    """Light, coc with steps, slopes and single pixels off both, and pixels that are left out."""
    generator = torch.Generator().manual_seed(7)
    light = torch.rand(2, channels, 54, 75, generator=generator) ** 3
    coc = scene((-4.0, 6.0), channels)[1]
    noise = torch.rand(coc.shape, generator=generator)
    coc = coc + torch.where(noise > 0.8, 2.0 * noise - 1.6, 0.0)
    coc[..., :10] = 1.0  # surfaces of one coc, whose extremes are equal
    coc[..., 4:12, 3:5] = 2.5
    return light, coc, (noise > 0.1).float() if hole else None


@pytest.mark.parametrize("hole", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
def test_the_finest_level_and_its_gradients_equal_the_plain_engines(
    channels: int, hole: bool, calls: dict[str, list[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    light, coc, valid = edges(channels, hole)
    weight = 0.5 * torch.rand(coc.shape, generator=torch.Generator().manual_seed(8))
    given = (light, coc, light.flip(-1), coc.flip(-1), torch.where(weight > 0.2, weight, 0.0))
    constant = [torch.full_like(coc, 0.7), *([] if valid is None else [valid])]

    def computed() -> list[Tensor]:
        leaves = [t.clone().requires_grad_() for t in given]
        out = disocclusion.finest_level((32, 44), *leaves, *constant)
        out = torch.where(out < -1e8, 0.0, out)
        seen = torch.rand(out.shape, generator=torch.Generator().manual_seed(1)) - 0.3
        return [out.detach(), *torch.autograd.grad((out * seen).sum(), leaves)]

    assert_both_engines_agree(computed, calls["farthest"], [1e-4] * 6, monkeypatch)


@pytest.mark.parametrize("hole", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
def test_mixed_pixels_and_their_gradients_equal_the_plain_engines(
    channels: int, hole: bool, calls: dict[str, list[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some parts reach the image's darkest or brightest light, which limits them."""
    light, coc, valid = edges(channels, hole)

    def computed() -> list[Tensor]:
        given, its_coc = light.clone().requires_grad_(), coc.clone().requires_grad_()
        own, other, other_coc, weight = matte(given, its_coc, valid)
        out = torch.cat([own, other * weight, other_coc, weight], 1)  # light of hardly any weight is undefined
        seen = torch.rand(out.shape, generator=torch.Generator().manual_seed(1)) - 0.3
        return [out.detach(), *torch.autograd.grad((out * seen).sum(), (given, its_coc))]

    assert_both_engines_agree(computed, calls["matte"], [1e-4] * 3, monkeypatch)


@pytest.mark.parametrize("size", [(1, 1), (5, 9), (40, 53)])
@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("given", ["", "weight", "weight limit"])
@pytest.mark.parametrize(("count", "image"), [(1, 0), (2, 0), (3, 1), (3, None)])
def test_surfaces_beyond_the_border_and_their_gradients_equal_the_plain_engines(
    count: int, image: int | None, given: str, channels: int, size: tuple[int, int], calls: dict[str, list[Any]]
) -> None:
    """Along the border are steps between surfaces and slopes; the ends are wider than the frame."""
    generator, nodes = torch.Generator().manual_seed(9), [[-1.0, 0.0, 1.5, 2.6]]

    def noise(channels: int = 1) -> Tensor:
        return torch.rand(2, channels, *size, generator=generator)

    def steps() -> Tensor:
        blocks = torch.randint(0, 4, (2, 1, 8, 8), generator=generator).float()
        blocks = blocks.repeat_interleave(7, 2).repeat_interleave(7, 3)
        return 1.7 * blocks[..., : size[0], : size[1]] + 0.3 * noise() - 1.8

    limit = 0.3 + noise() if "limit" in given else None
    maps = [[noise(channels) ** 3, steps()] for _ in range(count)]
    for of_surface in maps:
        of_surface += [torch.where(noise() > 0.2, noise(), 0.0)] if "weight" in given else []
    seen = torch.rand(2, count * (channels + len(maps[0]) - 1), size[0] + 70, size[1] + 70, generator=generator)

    def computed(dtype: torch.dtype) -> list[Tensor]:
        surfaces = [Surface(*(t.to(dtype).requires_grad_() for t in of_surface)) for of_surface in maps]
        bound = None if limit is None else limit.to(dtype)
        frame = pad_to_frame(surfaces, None, nodes, Beyond(30, 4, True, bound), True, image)
        out = torch.cat([t for surface in frame.surfaces for t in surface if t is not None], 1)
        leaves = [t for surface in surfaces for t in surface if t is not None]
        total = (out * seen[..., : out.shape[-2], : out.shape[-1]]).sum()
        return [out.detach(), *torch.autograd.grad(total, leaves)]

    for ours, exact in zip(computed(torch.float32), computed(torch.float64), strict=True):
        assert float((ours - exact).norm()) < 1e-5 * max(float(exact.norm()), seen.numel() ** 0.5)
    assert len(calls["continued"]) == 2
