"""What each part of the method is worth: PSNR against known truth with one of them switched off at a time.

Usage: python examples/benchmarks/each_part.py [SCENES] [--made 8]

``SCENES`` is a folder of scenes with known truth, as ``torchdof bench --truth`` takes it. Beside them stand as many
scenes as ``--made`` says, of textured planes, and as many of strands about as thin as a pixel, that are made by their
number: nothing was chosen by looking at them. The plain engine renders, at a tolerance of 1/255; whole frames are
compared.
"""

import argparse
import contextlib
import math
import os
import random
import statistics
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof import depth_of_field
from torchdof.reference import metrics
from torchdof.reference.scenes import Plane, Scene, camera_of, plane_scene, posts, read_scenes, strands, waves
from torchdof.render import highlights, surfaces
from torchdof.render.matting import Matted
from torchdof.render.plan import Plan
from torchdof.render.surfaces import Surface

SIZE, SAMPLES = (128, 192), 128  # of a scene that is made


def made_scene(seed: int) -> Scene:
    """A wall, with lamps on every second one, behind one to three rows of posts; the focus is on one of them."""
    draw = random.Random(seed)
    wall = _lamps(seed, waves(seed)) if seed % 2 else waves(seed)
    planes = [Plane(draw.uniform(3.0, 6.0), wall)]
    for row in range(draw.randint(1, 3)):
        width_px = draw.uniform(2.0, 25.0)
        mean = [draw.uniform(0.1, 0.7) for _ in range(3)]
        shape = posts(width_px * draw.uniform(2.0, 4.0), width_px, draw.uniform(-0.6, 0.6), draw.uniform(0.0, 50.0))
        planes.append(Plane(draw.uniform(0.7, 2.8), waves(100 * seed + row, mean, shortest_px=4.0), shape))
    widest_px = draw.uniform(5.0, 14.0)
    focus_m = draw.choice(planes).depth_m
    furthest_off = max(abs(1 / focus_m - 1 / plane.depth_m) for plane in planes)
    camera = camera_of(400.0, SIZE[1], widest_px / (400.0 * furthest_off), focus_m)
    return plane_scene(planes, camera, SIZE, SAMPLES, f"made/{seed}")


def strand_scene(seed: int) -> Scene:
    """Wires of any direction or, on every second one, hair before lamps; the focus is on these or on the wall."""
    draw = random.Random(seed)
    lines: list[tuple[float, float, float, float]] = []
    widths_px: list[float] = []
    for _ in range(24 if seed % 2 else 9):
        angle = draw.uniform(1.2, 1.9) if seed % 2 else draw.uniform(0.0, math.pi)
        x, y = draw.uniform(0.0, SIZE[1]), draw.uniform(0.1, 0.9) * SIZE[0]
        dx, dy = 400.0 * math.cos(angle), 400.0 * math.sin(angle)
        lines.append((x - dx, y - dy, x + dx, y + dy))
        widths_px.append(draw.uniform(0.3, 0.8 if seed % 2 else 1.5))
    light = waves(seed + 100, [draw.uniform(0.02, 1.0)] * 3, contrast=0.5)
    wall = waves(seed, shortest_px=draw.uniform(5.0, 10.0))
    planes = [Plane(draw.uniform(3.0, 6.0), _lamps(seed, wall) if seed % 2 else wall)]
    planes.append(Plane(draw.uniform(0.8, 1.6), light, strands(lines, widths_px)))
    furthest_off = abs(1 / planes[0].depth_m - 1 / planes[1].depth_m)
    camera = camera_of(400.0, SIZE[1], draw.uniform(5.0, 12.0) / (400.0 * furthest_off), draw.choice(planes).depth_m)
    return plane_scene(planes, camera, SIZE, SAMPLES, f"strands/{seed}")


def _lamps(seed: int, behind: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    """A texture with round lamps on it, of up to 60 times its light."""
    draw = random.Random(seed)
    lamps = [[draw.uniform(-20.0, n + 20.0) for n in SIZE] for _ in range(40)]
    lights = [(draw.uniform(0.8, 2.5), draw.uniform(10.0, 60.0)) for _ in lamps]

    def light(x: Tensor, y: Tensor) -> Tensor:
        out = behind(x, y)
        for (row, column), (radius, strength) in zip(lamps, lights, strict=True):
            out = torch.where((y - row) ** 2 + (x - column) ** 2 < radius**2, 0.4 * strength, out)
        return out

    return light


def _whole_pixels(light: Tensor, coc_px: Tensor, *_: Any) -> Matted:
    return Matted(light, torch.zeros_like(light), coc_px, torch.zeros_like(coc_px))


def _unchanged(*arguments: Any) -> Matted:
    return arguments[-1]


def _nothing_filled(
    light: Tensor, coc_px: Tensor, other: Tensor, other_coc_px: Tensor, other_weight: Tensor, *_: Any
) -> tuple[Tensor, Tensor, Tensor, None]:
    return other, other_coc_px, other_weight, None


def _nothing_behind(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, None]:
    return *FILL_HIDDEN(*arguments)[:3], None


def _in_layers(surface: Surface, *_: Any) -> tuple[Surface, None]:
    return surface, None


def _no_highlight(light: Tensor, valid: Tensor | None = None) -> Tensor:
    return torch.full_like(light[:, :1], torch.inf)


def _all_pass(rays: Any, shown: Any, table: Any, occlusion: bool, kernels_per_px: int) -> Tensor:
    return SPLAT(rays, shown, table, False, kernels_per_px)


def _by_share(cover: Tensor) -> Tensor:
    return torch.zeros_like(cover)


def _drawn_out(light: Tensor, weight: Any, limit: Any, ends: tuple[int, int, int, int], farthest: int) -> Tensor:
    return functional.pad(light, ends, mode="replicate")


FILL_HIDDEN, SPLAT = surfaces.fill_hidden, highlights.splat
EMITTERS = [(surfaces, "attribute_emitters", _unchanged)]
MATTING = [(surfaces, "matte", _whole_pixels), *EMITTERS]
FILL = [(surfaces, "fill_hidden", _nothing_filled)]
RAYS = [(highlights, "extract", _in_layers)]
PARTS: dict[str, list[tuple[Any, str, Any]]] = {
    "everything": [],
    "no matting of mixed pixels": MATTING,
    "emitters stay on the surface of their pixel": EMITTERS,
    "farther surfaces of mixed pixels by their share alone": [(surfaces, "_GOES_ON", math.inf)],
    "nothing filled in behind blurred foregrounds": FILL,
    "one hidden surface, no light behind it": [(surfaces, "fill_hidden", _nothing_behind)],
    "highlights left in their layers": RAYS,
    "highlights left in their layers, and let into what is filled in": [(highlights, "threshold", _no_highlight)],
    "nothing stands in the way of highlights' rays": [(highlights, "splat", _all_pass)],
    "highlights of mixed pixels by their share alone": [(highlights, "going_on", _by_share)],
    "the border's pixels drawn outwards": [(surfaces, "continued", _drawn_out)],
    "no coarse layers": [(Plan, "_scale", lambda *_: 1)],
    "none of matting, filling in and rays": MATTING + FILL + RAYS,
}
"""What is exchanged for each row: an object, its attribute and what stands in for it."""


@contextlib.contextmanager
def switched_off(part: str) -> Iterator[None]:
    """Renders without a part."""
    with contextlib.ExitStack() as stack:
        for owner, name, stand_in in PARTS[part]:
            stack.enter_context(patch.object(owner, name, stand_in))
        yield


def psnr(scene: Scene) -> float:
    """PSNR in dB of a scene, display-encoded."""
    picture = depth_of_field(scene.image, scene.depth, scene.camera)
    return metrics.psnr(metrics.display(picture), metrics.display(scene.truth))


def table(scenes: Sequence[Scene]) -> None:
    """Prints means over each scene's settings and over all that were read; below, what they are more without a part."""
    read = [scene for scene in scenes if not scene.name.startswith(("made/", "strands/"))]
    groups: dict[str, list[Scene]] = {"all read": read}
    for scene in scenes:
        groups.setdefault(scene.name.split("/")[0], []).append(scene)
    groups = {name: group for name, group in groups.items() if group}
    print("| | " + " | ".join(groups) + " |\n" + "| --- " * (len(groups) + 1) + "|")
    whole: list[float] = []
    for part in PARTS:
        with switched_off(part):
            values = {scene.name: psnr(scene) for scene in scenes}
        means = [statistics.fmean(values[scene.name] for scene in group) for group in groups.values()]
        told = [f"{a - b:+.2f}" for a, b in zip(means, whole, strict=True)] if whole else [f"{a:.2f}" for a in means]
        whole = whole or means
        print(f"| {part} | " + " | ".join(told) + " |", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("scenes", type=Path, nargs="?", help="folder of scenes, as torchdof bench --truth takes it")
    parser.add_argument(
        "--made", type=int, default=8, help="how many scenes of each kind are made; by default %(default)s"
    )
    arguments = parser.parse_args()
    os.environ["TORCHDOF_ENGINE"] = "torch"  # the one whose functions are exchanged
    scenes = [] if arguments.scenes is None else list(read_scenes(arguments.scenes))
    scenes += [make(seed) for make in (made_scene, strand_scene) for seed in range(arguments.made)]
    if not scenes:
        parser.error("there is nothing to measure: name a folder of scenes, or make some")
    table(scenes)


if __name__ == "__main__":
    main()
