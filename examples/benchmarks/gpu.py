"""What a CUDA device makes of the kernels: the same picture and gradients, time of each kernel, memory, first use.

python examples/benchmarks/gpu.py [--seconds 330]

It takes less than six minutes, prints the most important parts first, and leaves out parts for which no time is left.
Without a CUDA device it says so, runs the same code on the CPU with the kernels' C++ build, and prints how often each
kernel is launched, the bytes that it moves, and the milliseconds of a model: no measurement, but a lower bound for a
device with :data:`LAUNCH_S`, :data:`BYTES_PER_S` and :data:`FLOPS`.
"""

import argparse
import collections
import contextlib
import ctypes
import functools
import os
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[2]))

from examples.benchmarks.steps import Counted, crops
from torchdof import blur_by_coc, native
from torchdof.functional import splat
from torchdof.kernels import edges, layers, loader, matting, rays
from torchdof.render import highlights
from torchdof.render.engines import on_gpu

HAS_DEVICE = torch.cuda.is_available()
DEVICE = "cuda" if HAS_DEVICE else "cpu"
CASES = [
    ((1080, 1920, 1), 8.0),
    ((256, 256, 8), 8.0),
    *(((1080, 1920, 1), radius_px) for radius_px in (16.0, 64.0)),
    ((2160, 3840, 1), 16.0),
]
"""Height, width and number of pictures, and the largest radius of the blur."""

LAYERS_OF_THE_MODEL = {
    *("terms", "composite", "walk_back", "convolve_back", "terms_back", "stand_ins", "stand_ins_back"),
    *("upsample", "upsample_back", "pass_back", "block_rays"),
}
"""Kernels that are not launched without a device: their time grows with the blur."""

SMALL_CASES = [((96, 128, 1), 8.0), ((64, 96, 2), 4.0)]  # rendered on the CPU

LAUNCH_S, BYTES_PER_S, FLOPS = 3e-6, 2.5e12, 12e12  # of the model: an H100's, kernels without tensor cores

# The formula of the scatter that BokehMe compares with (Peng et al., CVPR 2022), as a gather: a pixel at distance d
# with radius r gives its light with the weight (1 + tanh(4 (r - d))) / 2 / (r^2 + 0.2).
SCATTER = """
struct Scatter { const float *light, *radius; float *out; int height, width, reach; };
extern "C" __global__ void scatter(const __grid_constant__ Scatter s) {
  const int y = blockIdx.y * 16 + threadIdx.y, x = blockIdx.x * 32 + threadIdx.x, area = s.height * s.width;
  if (y >= s.height || x >= s.width) return;
  float sum[3] = {}, total = 0;
  for (int v = max(y - s.reach, 0); v <= min(y + s.reach, s.height - 1); v++)
    for (int u = max(x - s.reach, 0); u <= min(x + s.reach, s.width - 1); u++) {
      const int at = v * s.width + u;
      const float r = fabsf(s.radius[at]), distance = sqrtf(float((v - y) * (v - y) + (u - x) * (u - x)));
      const float weight = (0.5f + 0.5f * tanhf(4 * (r - distance))) / (r * r + 0.2f);
      for (int c = 0; c < 3; c++) sum[c] += weight * s.light[c * area + at];
      total += weight;
    }
  for (int c = 0; c < 3; c++) s.out[c * area + y * s.width + x] = sum[c] / total;
}
"""


class Scatter(ctypes.Structure):
    """The argument of :data:`SCATTER`."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("light", "radius", "out")),
        *((name, ctypes.c_int) for name in ("height", "width", "reach")),
    ]


class Launches:
    """Counts the launches of the kernels, and what each costs: measured on a device, otherwise by the model.

    The operations of the model are not counted among those of ``counted``.
    """

    def __init__(self, counted: Counted) -> None:
        self._operations = counted
        self.count: collections.Counter[str] = collections.Counter()
        self.bytes: dict[str, float] = collections.defaultdict(float)
        self.ms: dict[str, float] = collections.defaultdict(float)

    def __enter__(self) -> "Launches":
        self._modules = {kernels: kernels.module for kernels in COSTS}
        for kernels, module in self._modules.items():
            kernels.module = functools.partial(self._with_costs, module, COSTS[kernels])
        return self

    def __exit__(self, *_: Any) -> None:
        for kernels, module in self._modules.items():
            kernels.module = module

    def _with_costs(self, module: Callable[..., loader.Launch], cost: Callable[..., Any], *variant: Any) -> Any:
        """The kernels of a variant, whose launches are counted."""
        return self._counted(module(*variant), functools.partial(cost, variant))

    def _counted(self, launch: loader.Launch, cost_of: Callable[..., tuple[float, float]]) -> loader.Launch:
        """A launch that is counted. Without a device the layers are not computed, only their tables of tiles."""

        def counted(kernel: str, grid: Any, block: Any, argument: Any) -> None:
            self.count[kernel] += 1
            if HAS_DEVICE:
                self.ms[kernel] += milliseconds(1, launch, kernel, grid, block, argument)
                return
            if kernel not in LAYERS_OF_THE_MODEL:
                launch(kernel, grid, block, argument)
            before = self._operations.operations
            moved, operations = cost_of(kernel, argument, grid[2])
            self._operations.operations = before
            self.bytes[kernel] += moved
            self.ms[kernel] += 1e3 * max(LAUNCH_S, moved / BYTES_PER_S, operations / FLOPS)

        return counted

    def show(self, name: str) -> None:
        """Prints a line for all kernels, and one for each."""
        what = "," if HAS_DEVICE else f", {sum(self.bytes.values()) / 1e6:.0f} MB, by the model"
        print(f"{name}: {sum(self.count.values())} launches{what} {sum(self.ms.values()):.2f} ms")
        for kernel, count in sorted(self.count.items(), key=lambda item: -self.ms[item[0]]):
            print(f"  {kernel:15} {count:3} launches {self.ms[kernel]:8.3f} ms")


def cost_of_matting(variant: Any, kernel: str, r: Any, items: int) -> tuple[float, float]:
    """As :func:`cost_of_layers`, for the kernels of matting, after the launch."""
    channels = variant[0]
    pixels, planes = r.height * r.width * items, 2 * channels + 2
    of_pixel = {  # values of each pixel that are read or written
        "find_edges": 2,
        "find_clean": 2 * channels + 2,
        "split": 2 * channels + 2 + planes,
        "split_back": 2 * planes + 2,
        "gather": 2 * r.planes + 2,
        "find_clean_back": 3 * channels + 1,
        "find_edges_back": 3 * channels + 2,
        "sum_rows": channels + 1,
    }
    # of each pixel at an edge, and its floating-point operations
    of_edge = {
        "find_clean": (9 * (channels + 2), 9 * (10 + 2 * channels)),
        "split": (9 * (2 * channels + 2), 9 * (60 + 50 * channels)),
        "split_back": (27 * planes, 9 * (120 + 110 * channels)),
        "gather": (9 * r.planes, 9 * r.planes),
        "find_clean_back": (9 * (2 * channels + 4), 9 * (20 + 6 * channels)),
        "find_edges_back": (18, 90),
        "sum_rows": (2 * channels, 2 * channels),
    }
    edges = (ctypes.c_float * pixels).from_address(r.edge)
    count = int((torch.frombuffer(edges, dtype=torch.float32) > 0).sum())
    values, operations = of_edge.get(kernel, (0, 0))
    return 4.0 * (of_pixel[kernel] * pixels + values * count), float(operations * count)


def cost_of_edges(variant: Any, kernel: str, r: Any, items: int) -> tuple[float, float]:
    """As :func:`cost_of_layers`, for the kernels of edges."""
    channels = variant[0]
    of_pixel = {  # values of each pixel that are read or written, and operations
        "find_slopes": (5, 40),
        "smooth_slopes": (2, 25),
        "find_ramps": (6, 5),
        "climb_ramps": (5, 2),
        "find_surfaces": (16, 49 * 12),
    }
    if kernel in of_pixel:
        values, operations = (n * r.height * r.width * items for n in of_pixel[kernel])
        return 4.0 * values, float(operations)
    if kernel == "fit":  # a few thousand samples, 20 times
        return 0.0, 0.0
    window = 2 * 121 if kernel == "judge" else 9  # samples of each pixel of the list
    return 4.0 * r.count * (channels + 10), float(r.count * window * (10 + 5 * channels))


def cost_of_rays(variant: Any, kernel: str, r: Any, items: int) -> tuple[float, float]:
    """As :func:`cost_of_layers`, for the rays of highlights."""
    bins = (ctypes.c_bool * (r.count * r.bins)).from_address(r.wanted)
    return 4.0 * r.count * r.side**2, float(sum(bins)) * r.side**2 * (20 + 24 * r.surfaces)


def cost_of_layers(variant: Any, kernel: str, r: Any, depth: int) -> tuple[float, float]:
    """Bytes that a launch of a kernel moves if a pass reads each value once, and its floating-point operations."""
    channels, surfaces = variant[:2]
    values, tile, maps = channels + 2, 16 * 32, surfaces * (channels + 2)
    items, frame = depth // max(r.layers, 1) if kernel == "convolve_back" else depth, r.scale * r.scale
    picture, canvas = r.height * r.width * (channels + 1) * depth, r.coarse_height * r.coarse_width * (channels + 1)
    lit = read = any_read = taps = 0.0
    if r.layers and r.lit:
        each = r.tile_rows * r.tile_columns
        count = r.layers * each * max(items // r.colours, 1) if kernel not in ("mark", "find_lit", "find_read") else 0
        tables = ((ctypes.c_int8 * count).from_address(table) for table in (r.lit, r.read))
        found = [torch.tensor(list(table)).view(-1, r.layers, each) for table in tables]
        by_layer = [table.sum((0, 2)) * r.colours for table in found]
        lit, read = (float(part.sum()) * tile for part in by_layer)
        any_read = float(found[1].amax(1).sum()) * r.colours * tile if count else 0.0
        sides = torch.tensor([(2 * r.half[i] + 1) ** 2 for i in range(r.layers)])
        chosen = by_layer[1] if kernel == "convolve_back" else by_layer[0]
        taps = float((chosen * sides).sum()) * tile
    pixels = r.rows * r.columns * frame * depth
    numbers, operations = {
        "mark": (surfaces * pixels, 0.0),
        "terms": (any_read * frame * maps + read * values, 100.0 * read * frame * surfaces),
        "composite": (lit * values + 2.0 * picture, 2.0 * taps * values),
        "walk_back": (lit * (2 * values + 1) + 2.0 * picture, 0.0),
        "convolve_back": ((lit + read) * values, 2.0 * taps * values),
        "terms_back": (read * (2 * values - 2) + 3.0 * maps * pixels, 0.0),
        "stand_ins": (2.0 * picture + maps * r.height * r.width * depth, 0.0),
        "stand_ins_back": (3.0 * picture + 3.0 * maps * r.height * r.width * depth, 0.0),
        "upsample": (2.0 * picture + canvas * depth, 0.0),
        "upsample_back": (2.0 * picture + canvas * depth, 0.0),
        "pass_back": (2.0 * picture + canvas * depth, 0.0),
    }.get(kernel, (0.0, 0.0))
    return 4.0 * numbers, operations


COSTS: dict[Any, Callable[..., tuple[float, float]]] = {
    layers: cost_of_layers,
    matting: cost_of_matting,
    edges: cost_of_edges,
    rays: cost_of_rays,
}
"""What a launch costs by the model, for each module of kernels."""


def milliseconds(repeat: int, call: Callable[..., Any], *arguments: Any) -> float:
    """Median milliseconds of some calls on the device."""
    taken = []
    for _ in range(repeat):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        call(*arguments)
        end.record()
        torch.cuda.synchronize()
        taken.append(start.elapsed_time(end))
    return statistics.median(taken)


@contextlib.contextmanager
def engine(name: str) -> Iterator[None]:
    """A block with ``TORCHDOF_ENGINE`` of a name."""
    before = os.environ.get("TORCHDOF_ENGINE", "auto")
    os.environ["TORCHDOF_ENGINE"] = name
    try:
        yield
    finally:
        os.environ["TORCHDOF_ENGINE"] = before


def on_cpu() -> None:
    """Takes tensors on the CPU for those of a device, whose kernels are their C++ build."""
    from tests import on_cpu

    on_gpu.DEVICE = "cpu"
    for kernels in COSTS:
        kernels.module = getattr(on_cpu, f"{kernels.__name__.rpartition('.')[2]}_module")
    native._library = lambda: (None, "switched off")  # as on a device: all else by PyTorch, items together
    highlights._PAIR_TAPS = highlights._PAIR_TAPS_GPU


def scene(size: tuple[int, int, int], radius_px: float, focus: float = 0.4) -> tuple[str, Tensor, Tensor]:
    """Name, light and coc of a part of a photograph."""
    ((name, light, near),) = crops([size])
    near = (near - near.min()) / (near.max() - near.min())
    coc_px = 2.0 * radius_px * (focus - near).contiguous()
    return f"{name}, {radius_px:g} px", light.contiguous().to(DEVICE), coc_px.to(DEVICE)


def step(light: Tensor, coc_px: Tensor) -> list[Tensor]:
    """A picture, and the gradients of its mean square by light and radius."""
    leaves = [light.clone().requires_grad_(), coc_px.clone().requires_grad_()]
    picture = blur_by_coc(*leaves)
    return [picture.detach(), *torch.autograd.grad(picture.square().mean(), leaves)]


def versions() -> None:
    """PyTorch, the device, and NVRTC."""
    print(f"PyTorch {torch.__version__}, Python {sys.version.split()[0]}, {sys.platform}, {os.cpu_count()} CPU cores")
    if HAS_DEVICE:
        major, minor = torch.cuda.get_device_capability()
        print(f"{torch.cuda.get_device_name()}, compute capability {major}.{minor}, CUDA {torch.version.cuda}")
    else:
        print("no CUDA device: the kernels run on the CPU, milliseconds are those of the model")
    with contextlib.suppress(OSError):
        print(f"NVRTC {loader.nvrtc(torch.version.cuda or '12')._name}")


def first_use() -> None:
    """Seconds until the first picture: compiled and tried, then with the kept program."""
    _, light, coc_px = scene(*SMALL_CASES[0])
    for name in ("without kernels", "kernels compiled", "the kept program"):
        for cached in (*(kernels.module for kernels in COSTS), on_gpu.why_missing):
            getattr(cached, "cache_clear", lambda: None)()
        start = time.perf_counter()
        with engine("torch" if name == "without kernels" else "gpu"):
            blur_by_coc(light, coc_px)
        if HAS_DEVICE:
            torch.cuda.synchronize()
        print(f"first picture, {name}: {time.perf_counter() - start:.2f} s")


def same_pictures() -> None:
    """The picture and gradients of the kernels beside those of the plain engine; the picture has lamps."""
    for size, radius_px in CASES if HAS_DEVICE else SMALL_CASES:
        name, light, coc_px = scene(size, radius_px)
        lit = light.clone()
        lit[..., 11::31, 7::29] += 20.0
        found = [picture(lit, coc_px), *step(light, coc_px)[1:]]
        with engine("torch"):
            expected = [picture(lit, coc_px), *step(light, coc_px)[1:]]
        local = functional.max_pool2d(expected[0].amax(1, keepdim=True), 17, 1, 8).clamp_min(1e-6)
        apart = float(((found[0] - expected[0]).abs() / local).max())
        of_light, of_coc = (float((a - b).norm() / b.norm()) for a, b in zip(found[1:], expected[1:], strict=True))
        print(f"{name}: picture {apart:.1e} of the light nearby, gradients by light {of_light:.1e}, coc {of_coc:.1e}")


def costs(ends: float) -> None:
    """Milliseconds and memory of a picture and a step, and what each kernel takes."""
    for size, radius_px in CASES:
        if time.perf_counter() > ends:
            print("no time left for further cases")
            return
        name, light, coc_px = scene(size, radius_px)
        for kind, call in (("picture", picture), ("step", step)):
            if HAS_DEVICE:
                found = [measured(selected, call, light, coc_px) for selected in ("gpu", "torch")]
                print(f"{name}, a {kind}: {found[0]}; without kernels {found[1]}", flush=True)
            with Counted() as counted, Launches(counted) as launches:
                call(light, coc_px)
            launches.show(f"{name}, kernels of a {kind}")
            with engine("torch"), Counted() as plain:
                call(light, coc_px)
            print(f"  {counted.operations} operations of PyTorch, without kernels {plain.operations}", flush=True)


def measured(selected: str, call: Callable[..., Any], light: Tensor, coc_px: Tensor) -> str:
    """Time and memory of a call by an engine, on the device."""
    with engine(selected):
        call(light, coc_px)
        torch.cuda.reset_peak_memory_stats()
        before, taken = torch.cuda.memory_allocated(), milliseconds(5, call, light, coc_px)
        most = (torch.cuda.max_memory_allocated() - before) / 2**30
    return f"{taken:.1f} ms, {most:.2f} GiB"


def picture(light: Tensor, coc_px: Tensor) -> Tensor:
    """A picture without gradients."""
    with torch.no_grad():
        return blur_by_coc(light, coc_px)


def other_formulas() -> None:
    """DeepLens's formula, which is that of splat, and BokehMe's scatter: no layers, no occlusion."""
    if not HAS_DEVICE:
        loader.compile_program(SCATTER, [], 90, "12")
        print("BokehMe's formula: NVRTC compiles it")
        return
    launch = loader.on_device(SCATTER, [], torch.cuda.current_device())
    for size, radius_px in (CASES[0], CASES[2]):
        name, light, coc_px = scene(size, radius_px)
        out, reach = torch.empty_like(light), int(coc_px.abs().max()) + 2
        argument = Scatter(*(t.data_ptr() for t in (light, coc_px, out)), *size[:2], reach)
        grid = (-(-size[1] // 32), -(-size[0] // 16), 1)
        print(f"{name}: BokehMe's formula {milliseconds(5, launch, 'scatter', grid, (32, 16, 1), argument):.1f} ms")
        print(f"{name}: DeepLens's formula (splat) {milliseconds(3, splat, light, coc_px):.1f} ms", flush=True)


def main() -> None:
    """Prints all parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=330.0, help="no part begins later")
    ends = time.perf_counter() + parser.parse_args().seconds
    warnings.simplefilter("error", RuntimeWarning)
    if not HAS_DEVICE:
        on_cpu()
    with engine("gpu"), tempfile.TemporaryDirectory() as cache:
        # an empty folder, so that kernels are compiled
        os.environ["LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME"] = cache
        for part in (versions, first_use, same_pictures, lambda: costs(ends), other_formulas):
            if time.perf_counter() > ends:
                print("no time left")
                break
            try:
                part()
            except Exception as error:  # the other parts are still worth their time
                print(f"failed: {type(error).__name__}: {error}")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
