"""The compiled engine makes the picture that the plain one states."""

import dataclasses
import random
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor
from torch.autograd import forward_ad

from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc, native
from torchdof.optics.aperture import Aperture
from torchdof.optics.field import Field
from torchdof.render.plan import Plan
from torchdof.render.scatter import fold

BY_COLOUR = BlurTable("gaussian", [1.0], {"sigma": torch.tensor([[0.4], [0.5], [0.6]])}, name="by colour")
SHAPED = [
    BlurTable.polygon(3, 20.0, squeeze=1.6),
    BlurTable.polygon(5, 7.0, 0.4, rim=2.0),
    BlurTable.from_aperture(torch.eye(9).cumsum(0)[:, :6]),
]
CATS_EYES = [
    BlurTable.disc().with_aperture(Aperture(vignetting=0.4)),
    BlurTable.polygon(5, 10.0, squeeze=1.5, vignetting=(0.6, 0.2)),
    BY_COLOUR.with_aperture(Aperture(vignetting=0.5)),
]
TABLES = [BlurTable.disc(), BlurTable.gaussian(), BlurTable.load("sato_j15"), BY_COLOUR]


@dataclasses.dataclass
class Scene:
    """Arguments of :func:`torchdof.blur_by_coc`."""

    image: Tensor
    coc_px: Tensor
    options: dict[str, Any]

    def blurred(self) -> Tensor:
        return blur_by_coc(self.image, self.coc_px, **self.options)


@pytest.fixture
def by_both(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], Tensor]], tuple[Tensor, Tensor]]:
    """A picture by the plain engine and by the compiled one."""
    pictures = []

    def render(*arguments: Any, native_render: Any = native.render, **options: Any) -> Tensor:
        pictures.append(native_render(*arguments, **options))
        return pictures[-1]

    monkeypatch.setattr(native, "render", render)

    def rendered(make: Callable[[], Tensor], served: bool = True) -> tuple[Tensor, Tensor]:
        monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
        plain = make()
        assert not pictures
        monkeypatch.setenv("TORCHDOF_ENGINE", "native")
        compiled = make()
        assert pictures or not served  # it was the compiled engine
        pictures.clear()
        return plain, compiled

    return rendered


def assert_same_picture(pictures: tuple[Tensor, Tensor], image: Tensor) -> None:
    """Those of the plain and of the compiled engine: within 1e-5 of the light nearby."""
    plain, compiled = pictures
    assert plain.dtype == compiled.dtype and plain.shape == compiled.shape
    assert torch.equal(torch.isfinite(plain), torch.isfinite(compiled))
    plain, compiled, image = (torch.nan_to_num(t.float(), 0.0, 0.0, 0.0) for t in (plain, compiled, image))
    light = functional.pad(torch.maximum(plain.abs(), image), (8,) * 4, mode="replicate")
    nearby = functional.max_pool2d(light, 17, 1).amax(1, keepdim=True)
    difference = float(((plain - compiled).abs() / (nearby + 1e-6)).max())
    assert difference <= 1e-5


def random_map(kind: str, shape: tuple[int, int, int], radius: float) -> Tensor:
    """Signed coc ``[B, 1, H, W]``. Random numbers: on the very edge of a decision rounding would decide."""
    items, height, width = shape
    if kind == "planes":
        regions = torch.randint(0, 3, (items, 1, height // 16 + 1, width // 16 + 1))
        return functional.interpolate(((torch.rand(3) * 2 - 1) * radius)[regions], size=(height, width))
    if kind == "noise":
        return (torch.rand(items, 1, height, width) * 2 - 1) * radius
    if kind == "quarters":  # on the very edge of many decisions
        regions = torch.randint(-4, 5, (items, 1, height // 8 + 1, width // 8 + 1)) * 0.25
        regions = (regions * radius * 4).round() / 4
        return regions.repeat_interleave(8, -1).repeat_interleave(8, -2)[..., :height, :width].contiguous()
    if kind == "slope":
        return torch.linspace(-radius, radius, height)[:, None].expand(items, 1, height, width).clone()
    coarse = torch.rand(items, 1, 3, 4) * 2 - 1
    if kind == "focus":
        coc = functional.interpolate(coarse * 0.45, size=(height, width))
        coc[..., height // 2 :, :] = radius
        return coc
    return functional.interpolate(coarse * radius, size=(height, width), mode="bicubic")


def random_scene(seed: int, height: int | None = None, width: int | None = None) -> Scene:
    torch.manual_seed(seed)
    draw = random.Random(seed)
    shape = (draw.choice([1, 1, 2]), height or draw.randint(1, 150), width or draw.randint(1, 170))
    items, rows, columns = shape
    image = torch.rand(items, draw.choice([1, 3, 3, 4, 5]), rows, columns)
    tolerance = draw.choice([0.0, 1 / 255, 1 / 255, 4 / 255, 8 / 255])
    radius = draw.choice([0.7, 2.0, 5.0, 9.0, 20.0, 40.0] if tolerance else [0.7, 2.0, 5.0, 9.0])  # these take long
    coc = random_map(draw.choice(["smooth", "planes", "noise", "slope", "focus"]), shape, radius)
    if draw.random() < 0.4:
        lamps = torch.rand(items, 1, rows, columns) < 0.004
        image = torch.where(lamps, image * draw.choice([50.0, 1000.0]), image)
    options: dict[str, Any] = {
        "table": draw.choice(TABLES if image.shape[1] == 3 else TABLES[:3]),
        "tolerance": tolerance,
        "occlusion": draw.random() < 0.7,
    }
    if not options["occlusion"]:
        options["normalize"] = draw.random() < 0.7
    if draw.random() < 0.25:
        options["check"] = False
        coc = torch.where(torch.rand(items, 1, rows, columns) < 0.03, torch.nan, coc)
        if draw.random() < 0.5:
            image[torch.rand(image.shape) < 0.01] = torch.inf
    if options["occlusion"] and draw.random() < 0.25:
        options["background"] = torch.rand(image.shape)
        options["background_coc_px"] = torch.nan_to_num(coc) + radius * torch.rand(1)
    return Scene(image, coc, options)


@pytest.mark.parametrize("seed", range(60))
def test_engines_agree_on_random_scenes(seed: int, by_both: Any) -> None:
    scene = random_scene(seed)
    in_focus = bool((torch.nan_to_num(scene.coc_px).abs() <= 1.0).all())
    assert_same_picture(by_both(scene.blurred, served=not in_focus), scene.image)


@pytest.mark.parametrize("seed", [100, 101])
@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 7), (9, 1), (2, 3), (16, 16), (17, 33), (64, 5)])
def test_engines_agree_on_small_frames(height: int, width: int, seed: int, by_both: Any) -> None:
    scene = random_scene(seed, height, width)
    scene.coc_px += 0.1  # a plane in focus is nobody's work
    assert_same_picture(by_both(scene.blurred), scene.image)


@pytest.mark.parametrize("table", TABLES, ids=str)
@pytest.mark.parametrize("occlusion", [True, False])
def test_engines_agree_on_highlights(occlusion: bool, table: BlurTable, by_both: Any) -> None:
    image, coc = torch.rand(1, 3, 90, 110), random_map("smooth", (1, 90, 110), 15.0)
    image[..., 20:85:9, 15:100:13] *= 1000.0
    assert_same_picture(by_both(Scene(image, coc, {"table": table, "occlusion": occlusion}).blurred), image)


@pytest.mark.parametrize("table", [*SHAPED[::2], *CATS_EYES], ids=str)
@pytest.mark.parametrize("occlusion", [True, False])
def test_engines_agree_on_lopsided_kernels_with_highlights(occlusion: bool, table: BlurTable, by_both: Any) -> None:
    for kind, radius in (("smooth", 13.0), ("planes", 5.0)):
        image, coc = torch.rand(1, 3, 70, 90), random_map(kind, (1, 70, 90), radius)
        image[..., 20:65:9, 15:80:13] *= 1000.0
        assert_same_picture(by_both(Scene(image, coc, {"table": table, "occlusion": occlusion}).blurred), image)


@pytest.mark.parametrize("occlusion", [True, False])
def test_engines_agree_on_spots_across_the_field(occlusion: bool, by_both: Any) -> None:
    coc, radius = torch.tensor([-0.9, -0.3, 0.2, 0.7]), torch.tensor([0.0, 1.5, 3.5])
    dice = torch.Generator().manual_seed(3)
    light = torch.rand(3, 4, 3, 16, 8, generator=dice)
    box = (torch.rand(4, 3, 3, generator=dice) + 0.5) * coc.abs()[:, None, None]
    lens: dict[str, Any] = {"unit": "mm", "sensor_width_mm": 6.0, "field": Field(coc, radius, box, light)}
    table = BlurTable("disc", coc, {"radius": coc.abs().expand(3, -1)}, **lens)
    for kind, reach in (("smooth", 12.0), ("planes", 5.0)):
        image, coc_px = torch.rand(1, 3, 70, 90), random_map(kind, (1, 70, 90), reach)
        image[..., 20:65:9, 15:80:13] *= 1000.0
        assert_same_picture(by_both(Scene(image, coc_px, {"table": table, "occlusion": occlusion}).blurred), image)


@pytest.mark.parametrize("table", SHAPED, ids=str)
def test_engines_and_fold_agree_on_lopsided_kernels(table: BlurTable, by_both: Any) -> None:
    image, coc = torch.rand(1, 3, 40, 50), random_map("planes", (1, 40, 50), 6.0)
    for occlusion in (True, False):
        options: dict[str, Any] = {"table": table, "occlusion": occlusion, "tolerance": 0}
        plain, compiled = by_both(Scene(image, coc, options).blurred)
        folded = blur_by_coc(image, coc, method="fold", **options)
        assert_same_picture((plain, compiled), image)
        assert_same_picture((folded, compiled), image)


@pytest.mark.parametrize("occlusion", [True, False])
@pytest.mark.parametrize(("near_px", "far_px"), [(-9.0, 11.0), (-24.0, 30.0)])
def test_engines_agree_where_coarse_layers_are_few(
    near_px: float, far_px: float, occlusion: bool, by_both: Any
) -> None:
    torch.manual_seed(3)
    image, coc = torch.rand(1, 3, 270, 390), random_map("smooth", (1, 270, 390), 2.5)
    coc[..., 20:60, 30:75] = near_px + torch.rand(40, 45)
    coc[..., 200:, 310:] = far_px + torch.rand(70, 80)
    assert_same_picture(by_both(Scene(image, coc, {"occlusion": occlusion}).blurred), image)


@pytest.mark.parametrize("check", [True, False])
@pytest.mark.parametrize("lamps", [1.0, 50.0])
def test_engines_agree_before_a_known_background(lamps: float, check: bool, by_both: Any) -> None:
    image, coc = torch.rand(2, 3, 70, 90), random_map("planes", (2, 70, 90), 9.0)
    image[..., ::23, ::31] *= lamps
    behind, behind_coc = torch.rand(2, 3, 70, 90), coc + 7.0 * torch.rand(2, 1, 70, 90)
    if not check:
        behind[0, 1, 10:20, 30:50] = torch.nan
        behind_coc[1, :, 40:50, 30:50] = torch.inf
    options = {"background": behind, "background_coc_px": behind_coc, "check": check}
    assert_same_picture(by_both(Scene(image, coc, options).blurred), image)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("way", ["accumulated", "background"])
def test_engines_agree_on_the_very_edge_of_decisions(way: str, seed: int, by_both: Any) -> None:
    torch.manual_seed(seed)
    shape = (1, 30 + 11 * seed, 90 - 7 * seed)
    image, coc = torch.rand(1, 3, *shape[1:]), random_map("quarters", shape, (2.0, 5.0, 9.0)[seed % 3])
    image = torch.where(torch.rand(1, 1, *shape[1:]) < 0.004 * (way == "accumulated"), 100.0 * image, image)
    options: dict[str, Any] = {"table": TABLES[seed % 3], "occlusion": way == "background"}
    if way == "background":
        options |= {"background": torch.rand(image.shape), "background_coc_px": coc + (0.0, 0.5, 2.0)[seed // 2]}
    assert_same_picture(by_both(Scene(image, coc, options).blurred), image)


@pytest.mark.parametrize("seed", range(8))
def test_engines_agree_on_stacks(seed: int, by_both: Any) -> None:
    torch.manual_seed(seed)
    items, count, channels = 1 + seed % 2, 1 + seed % 5, 1 + seed % 4
    size = (40 + 7 * seed, 61 + 5 * seed)
    cover = torch.rand(items, count, 1, *size)
    cover = torch.where(torch.rand(cover.shape) < 0.3, torch.where(cover < 0.5, 0.0, 1.0), cover)
    rgba = torch.cat([torch.rand(items, count, channels, *size) * cover, cover], 2)
    depth = 0.5 + 5.0 * torch.rand(items, count, 1, *(size if seed % 2 else (1, 1)))
    dof = DepthOfField(
        Camera(focus_m=1.7, f_number=1.4, sensor_width_mm=8.0),
        check=seed != 3,
    )
    if seed == 3:
        rgba[0, 0, 0, 3, 5], depth[0, 0, :, 20:25] = torch.nan, torch.nan
    assert_same_picture(by_both(lambda: dof.layers(rgba, depth)), torch.zeros_like(rgba[:, 0]))


def test_engines_agree_under_attention(by_both: Any) -> None:
    scene = Scene(torch.rand(1, 3, 120, 150), random_map("smooth", (1, 120, 150), 4.0), {"attention": (40, 50, 20)})
    assert_same_picture(by_both(scene.blurred), scene.image)


@pytest.mark.parametrize("reach_px", [2.3, 31.0])
def test_engines_agree_with_the_plan_of_another_scene(reach_px: float, by_both: Any) -> None:
    plan = Plan.of_scene(random_map("smooth", (1, 50, 50), reach_px), 1 / 255)
    scene = Scene(torch.rand(3, 3, 60, 75), random_map("planes", (3, 60, 75), 9.0), {"plan": plan})
    scene.image[..., ::17, ::19] *= 300.0
    assert_same_picture(by_both(scene.blurred), scene.image)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_the_rounded_picture(dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "native")
    image, coc = torch.rand(1, 3, 50, 60).to(dtype), random_map("smooth", (1, 50, 60), 6.0)
    assert torch.equal(blur_by_coc(image, coc), blur_by_coc(image.float(), coc).to(dtype))


def test_a_batch_is_its_items(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "native")
    image, coc = torch.rand(3, 3, 40, 50), random_map("smooth", (3, 40, 50), 6.0)
    single = [blur_by_coc(image[i : i + 1], coc[i : i + 1]) for i in range(3)]
    assert torch.equal(blur_by_coc(image, coc), torch.cat(single))


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The kind of each item that the compiled engine renders."""
    kinds: list[str] = []

    def render(surfaces: Any, kind: Any, native_render: Any = native.render, **options: Any) -> Tensor:
        kinds.append(kind)
        return native_render(surfaces, kind, **options)

    monkeypatch.setattr(native, "render", render)
    monkeypatch.setenv("TORCHDOF_ENGINE", "native")
    return kinds


def test_the_compiled_engine_serves_inference(counted: list[str]) -> None:
    image, coc = torch.rand(2, 3, 30, 40), random_map("smooth", (2, 30, 40), 3.0)
    wanted = blur_by_coc(image, coc)
    assert counted == ["image", "image"]
    assert wanted.data_ptr() != image.data_ptr() and not wanted.requires_grad
    image.requires_grad_()
    with torch.no_grad():
        assert torch.equal(blur_by_coc(image, coc), wanted)
    with torch.inference_mode():
        assert torch.equal(blur_by_coc(image, coc), wanted)
    image = image.detach()
    turned = blur_by_coc(image.mT, coc.mT)
    assert torch.equal(turned, blur_by_coc(image.mT.contiguous(), coc.mT.contiguous()))
    assert len(counted) == 10


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # by PyTorch, for tangents
def test_the_plain_engine_serves_all_else(counted: list[str]) -> None:
    image, coc = torch.rand(1, 3, 30, 40), random_map("smooth", (1, 30, 40), 3.0)
    assert blur_by_coc(image.clone().requires_grad_(), coc).requires_grad
    assert blur_by_coc(image, coc.clone().requires_grad_()).requires_grad
    with forward_ad.dual_level():
        out = blur_by_coc(forward_ad.make_dual(image, torch.ones_like(image)), coc, occlusion=False)
        assert forward_ad.unpack_dual(out).tangent is not None
    assert blur_by_coc(image.double(), coc).dtype == torch.float64
    blur_by_coc(image, coc.double())
    blur_by_coc(image, coc, method="fold")
    blur_by_coc(
        image[..., :2, :].repeat(1, 1, 1, 18), torch.full((1, 1, 2, 720), 400.0)
    )  # a Fourier transform's kernel
    assert torch.equal(blur_by_coc(image, 0.0 * coc), image)
    assert counted == []


@pytest.mark.parametrize(("wanted", "served"), [("native", 1), ("auto", 1), ("torch", 0)])
def test_the_environment_chooses_the_engine(
    wanted: str, served: int, counted: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", wanted)
    blur_by_coc(torch.rand(1, 3, 30, 40), random_map("smooth", (1, 30, 40), 3.0))
    assert len(counted) == served


def test_nothing_is_rendered_by_an_engine_of_no_meaning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "nonsense")
    with pytest.raises(ValueError, match="must be auto, native or torch, got 'nonsense'"):
        blur_by_coc(torch.rand(1, 3, 3, 4), random_map("noise", (1, 3, 4), 3.0))


@pytest.fixture
def _own_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def scenes() -> list[Scene]:
    """With and without occlusion, highlights, masked pixels."""
    image, coc = torch.rand(1, 3, 140, 170), random_map("smooth", (1, 140, 170), 14.0)
    image[..., ::31, ::29] *= 1000.0
    masked = torch.where(torch.rand(coc.shape) < 0.02, torch.nan, coc)
    return [
        Scene(image, coc, {}),
        Scene(image, coc, {"occlusion": False}),
        Scene(image, masked, {"check": False}),
        Scene(image, coc, {"background": image.flip(3), "background_coc_px": coc + 3.3}),
    ]


@pytest.mark.usefixtures("_own_threads")
def test_any_number_of_threads_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "native")
    for scene in scenes():
        pictures = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            pictures.append(scene.blurred())
        assert torch.equal(pictures[0], pictures[1]) and torch.equal(pictures[0], pictures[2])


def test_all_instructions_give_the_same_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "native")
    best = native.describe()
    for scene in scenes():
        wanted = scene.blurred()
        try:
            assert native.use_instructions("baseline") and native.describe() == "native (baseline)"
            assert_same_picture((wanted, scene.blurred()), scene.image)
        finally:
            native.use_instructions("avx2")
    assert native.describe() == best


def test_threads_of_python_may_render_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "native")
    given = [*scenes(), *scenes()]
    wanted = [scene.blurred() for scene in given]
    with ThreadPoolExecutor(4) as pool:
        for picture, alone in zip(pool.map(Scene.blurred, given), wanted, strict=True):
            assert torch.equal(picture, alone)


def answer_of(script: str) -> str:
    """What a fresh process prints."""
    run = subprocess.run([sys.executable, "-P", "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert run.returncode == 0, run.stderr
    return run.stdout.strip()


FORKED = """
import os, signal, torch
os.environ["TORCHDOF_ENGINE"] = "native"
from torchdof import blur_by_coc
from torchdof.render.plan import Plan
signal.alarm(60)
image, coc_px = torch.rand(1, 3, 60, 80), torch.linspace(-9.0, 9.0, 80).expand(1, 1, 60, 80)
torch.set_num_threads(1)  # PyTorch's own threads do not outlive a fork
plan = Plan.of_scene(coc_px, 1 / 255)
wanted = blur_by_coc(image, coc_px, plan=plan)
torch.set_num_threads(2)
same = torch.equal(blur_by_coc(image, coc_px, plan=plan), wanted)
child = os.fork()
signal.alarm(30)
same &= torch.equal(blur_by_coc(image, coc_px, plan=plan), wanted)
if child == 0:
    os._exit(0 if same else 3)
print(same, os.waitpid(child, 0)[1])
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no fork")
def test_a_forked_child_renders_after_its_parent_has() -> None:
    assert answer_of(FORKED) == "True 0"


INTERRUPTED = """
import os, signal, sys, threading, time, torch
signal.signal(signal.SIGINT, signal.default_int_handler)  # what a shell starts in the background is told to ignore it
os.environ["TORCHDOF_ENGINE"] = "native"
import torchdof
from torchdof.render.plan import Plan
torch.set_num_threads(1)
image, coc_px = torch.rand(1, 3, 3000, 4000), torch.linspace(-40.0, 40.0, 4000).expand(1, 1, 3000, 4000).contiguous()
image[..., ::50, ::50] *= 1000.0
plan = Plan.of_scene(coc_px, 0.1 / 255)
torchdof.blur_by_coc(image[..., :40], coc_px[..., :40], plan=plan, tolerance=0.1 / 255)  # its kernels are kept
sent = []
def interrupt():
    sent.append(time.monotonic())
    os.kill(os.getpid(), signal.SIGINT)
threading.Timer(1.0, interrupt).start()
try:
    torchdof.blur_by_coc(image, coc_px, plan=plan, tolerance=0.1 / 255)
    print("not interrupted")
except KeyboardInterrupt:
    late = time.monotonic() - sent[0]
    small = torchdof.blur_by_coc(image[..., :40, :40], coc_px[..., :40, :40])  # the engine goes on to serve
    print("in time" if late < 1.0 and bool(small.isfinite().all()) else f"after {late} s")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="a process of Windows cannot send itself Ctrl-C")
def test_ctrl_c_ends_a_long_rendering() -> None:
    assert answer_of(INTERRUPTED) == "in time"


INTERRUPTED_TWICE = """
import ctypes, os, signal, threading, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from torchdof import native
cancelled, ended = ctypes.c_int32(0), []
def engine():
    while not cancelled.value:
        time.sleep(0.01)
    time.sleep(0.5)
    ended.append(True)
for seconds in (0.2, 0.4):
    threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGINT)).start()
try:
    native._interruptible(engine, cancelled, 1 << 30)
except KeyboardInterrupt:
    print("after the engine" if ended else "while the engine runs")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="a process of Windows cannot send itself Ctrl-C")
def test_ctrl_c_is_raised_once_the_engine_has_stopped() -> None:
    """What the engine reads and writes is freed when its caller returns."""
    assert answer_of(INTERRUPTED_TWICE) == "after the engine"


@pytest.mark.parametrize("half", [0, 1, 2, 3, 7, 8, 10])
@pytest.mark.parametrize(("height", "width"), [(1, 1), (5, 6), (16, 16), (19, 37)])
def test_convolution_scatters_an_asymmetric_kernel(height: int, width: int, half: int) -> None:
    light, kernel = torch.rand(height, width), torch.rand(2 * half + 1, 2 * half + 1)
    wanted = torch.zeros(height + 2 * half, width + 2 * half, dtype=torch.float64)
    for row in range(height):
        for column in range(width):
            wanted[row : row + 2 * half + 1, column : column + 2 * half + 1] += light[row, column] * kernel
    wanted = wanted[half : half + height, half : half + width].float()
    scattered = native.convolve(light, kernel)
    torch.testing.assert_close(scattered, wanted, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(scattered, fold(light[None, None], kernel[None])[0, 0], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("half", [20, 64])
def test_convolution_scatters_the_widest_kernels(half: int) -> None:
    light, kernel = torch.rand(70, 90), torch.rand(2 * half + 1, 2 * half + 1)
    scattered = native.convolve(light, kernel)
    torch.testing.assert_close(scattered, fold(light[None, None], kernel[None])[0, 0], rtol=1e-5, atol=1e-6)
