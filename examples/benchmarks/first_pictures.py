"""Times of first pictures: with new cameras, in fresh processes, as commands and in sequences.

    python examples/benchmarks/first_pictures.py SCENES [--parts cameras pull] [--out results]
    python examples/benchmarks/first_pictures.py SCENES --python OTHER/.venv/bin/python

SCENES is a folder of scenes as for ``torchdof bench --truth``; other pictures are made here, and cameras are drawn from
seeded random numbers. With ``--python``, another installation is measured in alternation with this one. Each run of a
part is a process of its own, which also checks that this installation keeps its tolerance. The columns are those of
``torchdof bench``.
"""

import argparse
import functools
import itertools
import json
import math
import os
import resource
import runpy
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

import torchdof.bench
from torchdof import Camera, blur_by_coc
from torchdof.io.images import Picture, read_image, write_image
from torchdof.reference.scenes import read_scenes

ROOT = Path(__file__).parents[2]
torchdof.bench.__path__.insert(0, str(ROOT / "torchdof" / "bench"))  # one harness for either installation
from torchdof.bench.measurement import BenchScene, Seconds, error, measure, peak_of, shipped, timed  # noqa: E402

PARTS = "cameras fresh-39 fresh-60 command large pull small augmentation lamps noise demo gegl".split()
COMMANDS = ("command", "large", "demo")
ALONE = ("fresh-39", "fresh-60", "lamps", "noise")  # one picture for each process, to measure its memory
COUNT = 4  # cameras for each run
CONVOLUTION = "17 x 17 convolution"  # the default reference run of torchdof.bench.measurement
DATA = ROOT / "examples" / "data" / "motorcycle"


class Figure(NamedTuple):
    """One row of the table.

    Args:
        name: Name of the row.
        blur: Function of image and coc in pixels that renders.
        scenes: The scene with new cameras.
        goal: Goal for a column, as text.
        reference: Name of the reference run that is timed beside it.
        beside: The reference run; None is a depthwise 17 x 17 convolution.
    """

    name: str
    blur: Callable[..., Any]
    scenes: list[BenchScene]
    goal: str = ""
    reference: str = CONVOLUTION
    beside: Callable[[], Any] | None = None


def figures(part: str, folder: Path, turn: int) -> Iterator[Figure]:
    """The figures of a part in :data:`PARTS`, in order; ``turn`` seeds the cameras."""
    if part in ("cameras", "gegl"):
        gegl = runpy.run_path(str(Path(__file__).parent / "tools" / "gegl.py"))
        for _, settings in itertools.groupby(read_scenes(folder), lambda scene: scene.name.rpartition("/")[0]):
            first = next(settings)
            scene = BenchScene(first.name, first.image, first.coc_px).seen(0.0, 64.0)
            blur_by_coc(scene.image, scene.coc_px)
            if part == "cameras":
                cameras = scene.cameras(COUNT, 4 / 64, f"{turn} {scene.name}")
                yield Figure(f"{scene.name}, 4 to 64 px", blur_by_coc, cameras, "over_again at most 1.3")
            elif gegl["available"]() is None:
                frame = scene.resized(1920 / scene.image.shape[-1]).seen(0.0, 32.0)
                cameras = frame.cameras(COUNT, 8 / 32, f"{turn} {scene.name}")
                beside = functools.partial(next, (gegl["blur"](camera.image, camera.coc_px) for camera in cameras))
                yield Figure(f"{scene.name}, 1080p, 8 to 32 px", blur_by_coc, cameras, "", gegl["NAME"], beside)
    elif part in ("fresh-39", "fresh-60"):
        size = (1350, 1080) if part == "fresh-39" else (1333, 2000)
        cameras = shipped(*size).seen(0.0, float(part[-2:])).cameras(1, 1.0, f"{turn}")
        yield Figure(f"{size[1]} x {size[0]}, {part[-2:]} px, fresh process", blur_by_coc, cameras)
    elif part == "pull":
        frames = shipped(1080, 1920).seen(0.0, 69.0 - 0.1 * turn).pull(24)
        yield Figure("focus pull, 1080p, 69 px: frame 1", blur_by_coc, frames[:1])
        yield Figure("focus pull, 1080p, 69 px: frames 2 to 24", blur_by_coc, frames[1:])
    elif part == "small":
        torch.set_num_threads(1)
        photo = shipped(256, 256).seen(0.0, 8.0)
        for occlusion, goal_ms in ((True, 7), (False, 3.5)):
            blur = functools.partial(blur_by_coc, occlusion=occlusion)
            blur(photo.image, photo.coc_px)
            name = "256 x 256, 8 px, one thread" + ", without occlusion" * (not occlusion)
            cameras = photo.cameras(5 * COUNT, 2 / 8, f"{turn} {occlusion}")
            yield Figure(name, blur, cameras, f"cpu_ms at most {goal_ms}")
        maps = torch.cat([camera.coc_px for camera in photo.cameras(16 * COUNT, 2 / 8, f"{turn} batch")]).split(8)
        batches = [BenchScene("batch", photo.image.repeat(8, 1, 1, 1), coc_px) for coc_px in maps[:COUNT]]
        beside = functools.partial(next, ([blur_by_coc(photo.image, m) for m in ms.split(1)] for ms in maps[COUNT:]))
        goal = "over_beside at most 1"
        yield Figure("8 of these with a focus each", blur_by_coc, batches, goal, "8 others one by one", beside)
    elif part == "augmentation":
        from kornia.augmentation import RandomBoxBlur

        from torchdof.augmentation import RandomDepthOfField
        from torchdof.depth.reading import read_depth

        torch.set_num_threads(1)
        torch.manual_seed(turn)
        calibration = json.loads((DATA / "camera.json").read_text())
        depth = read_depth(DATA / "motorcycle_disp.npz", **calibration["depth"])
        image_and_depth = torch.cat([read_image(DATA / "motorcycle_left.png").pixels, depth], 1)
        crops = torch.cat(
            [image_and_depth[..., y : y + 256, x : x + 256] for y in range(0, 241, 80) for x in range(0, 481, 160)]
        )
        camera = Camera.from_fov(math.degrees(2 * math.atan(128 / calibration["focal_length_px"])), 0.04, 3.0)
        aug = RandomDepthOfField((2.2, 5.0), (1.4, 8.0), camera, transfer="linear", p=1.0, tolerance="preview")
        batch = BenchScene("crops", *crops.split((3, 1), 1))  # depth in metres takes the place of the coc
        aug(batch.image, batch.coc_px)
        beside = functools.partial(RandomBoxBlur((11, 11), p=1.0), batch.image)
        name, goal = "RandomDepthOfField, preview, 16 images, one thread", "16000 / cpu_ms at least 110"
        yield Figure(name, aug, [batch] * 2 * COUNT, goal, "kornia RandomBoxBlur, 11 x 11", beside)
    elif part in ("lamps", "noise"):
        scene, generator = shipped(480, 640), torch.Generator().manual_seed(turn)
        image, coc_px, name = scene.image, 120 * torch.rand(1, 1, 480, 640, generator=generator) - 60, "noise, 60 px"
        if part == "lamps":
            image = 0.02 * image
            coc_px = 250 * (torch.linspace(0, 1, 480)[:, None] + torch.linspace(0, 1, 640)).expand(1, 1, 480, 640)
            image.flatten(2)[..., torch.randperm(480 * 640, generator=generator)[:10_000]] = 300.0
            name = "ten thousand lamps, 500 px"
        ordinary = scene.seen(0.0, 60.0).cameras(1, 1.0, f"{turn}")[0]

        def render_again() -> tuple[Tensor, Seconds]:
            blur_by_coc(ordinary.image, ordinary.coc_px)
            return timed(blur_by_coc, ordinary.image, ordinary.coc_px)

        cameras, goal = [BenchScene(part, image, coc_px)], "over_beside at most 6, 1000 MiB"
        yield Figure(f"{name}, 640 x 480", blur_by_coc, cameras, goal, "ordinary, 60 px, again", render_again)
    elif part == "command":
        for radius_px in (30, 60, 111):
            cameras = shipped(1333, 2000).seen(0.0, radius_px).cameras(1, 1.0, f"{turn}")
            name, goal = f"torchdof render, 2000 x 1333, {radius_px} px", "over_beside at most 3"
            yield Figure(name, rendered, cameras, goal, "import torch", import_torch)
    elif part == "large":
        cameras = shipped(1000, 1500).resized(4.0).seen(0.0, 219.0).cameras(1, 1.0, f"{turn}")
        name, goal = "torchdof render, 6000 x 4000, 219 px, less files", "cpu_ms at most 6000, 2500 MiB"
        yield Figure(name, beyond_files, cameras, goal, "import torch", import_torch)
    elif part == "demo":
        yield Figure("make demo", demonstrated, [shipped(64, 96)], "", "import torch", import_torch)


def spent(*command: object, folder: str | None = None) -> Seconds:
    """Wall and processor time of a Python command."""
    wall, start = time.perf_counter(), os.times()
    subprocess.run([sys.executable, *map(str, command)], check=True, cwd=folder, stdout=subprocess.DEVNULL)
    end = os.times()
    cpu = end.children_user + end.children_system - start.children_user - start.children_system
    return Seconds(time.perf_counter() - wall, cpu)


def import_torch() -> tuple[None, Seconds]:
    """Time of importing torch."""
    return None, spent("-c", "import torch")


def rendered(image: Tensor, coc_px: Tensor) -> tuple[Tensor, Seconds]:
    """The picture of ``torchdof render``, and the time of the command."""
    with tempfile.TemporaryDirectory() as folder:
        write_image(f"{folder}/photo.jpg", Picture(image, transfer="srgb", sample="8"))
        write_image(f"{folder}/coc.exr", Picture(coc_px, ("Y",)), sample="float")
        command = "-m torchdof render photo.jpg coc.exr -o out.jpg --depth-kind coc"
        seconds = spent(*command.split(), folder=folder)
        return read_image(f"{folder}/out.jpg").pixels, seconds


def beyond_files(image: Tensor, coc_px: Tensor) -> tuple[Tensor, Seconds]:
    """Time of a command, minus the time of a command with everything in focus, which only reads and writes files."""
    picture, seconds = rendered(image, coc_px)
    files = rendered(image, torch.zeros_like(coc_px))[1]
    return picture, Seconds(seconds.wall - files.wall, seconds.cpu - files.cpu)


def demonstrated(image: Tensor, _: Tensor) -> tuple[Tensor, Seconds]:
    """The time of ``examples/demo.py``, from the repository of the measured installation if it has one."""
    script = Path(torchdof.__file__).parents[1] / "examples" / "demo.py"
    with tempfile.TemporaryDirectory() as out:
        return image, spent(script if script.exists() else ROOT / "examples/demo.py", "--data", DATA, "--out", out)


def turn_of(part: str, folder: Path, turn: int) -> list[dict[str, Any]]:
    """A row for each camera of each figure of a part.

    Raises:
        RuntimeError: If this installation does not keep its tolerance.
    """
    rows = []
    for figure in figures(part, folder, turn):
        for scene in figure.scenes:
            work = functools.partial(measure, figure.blur, scene, figure.beside, part not in COMMANDS)
            (_, row), peak_mb = peak_of(work) if part in ALONE else (work(), math.nan)
            if part in COMMANDS:
                peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
            columns = {"figure": figure.name, "goal": figure.goal, "beside": figure.reference}
            rows.append({**columns, **row, "peak_mb": peak_mb})
    scene = shipped(64, 96).seen(0.0, 6.0)
    picture, exact = (blur_by_coc(scene.image, scene.coc_px, tolerance=t) for t in (1 / 255, 0.0))
    if not error(picture, exact)["rms_255"] <= 1.0:
        raise RuntimeError(f"{torchdof.__file__}: does not keep its tolerance")
    return rows


def main() -> None:
    """Measure the parts and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("scenes", type=Path, help="folder of scenes, as torchdof bench --truth takes it")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--python", help="interpreter of another installation of torchdof, run in alternation")
    parser.add_argument("--repeat", type=int, default=3, help="number of runs; by default %(default)s")
    parser.add_argument("--out", type=Path, help="folder for first_pictures.csv and .md")
    parser.add_argument("--turn", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.turn is not None:
        with torch.inference_mode():
            print(json.dumps(turn_of(arguments.parts[0], arguments.scenes, arguments.turn)))
        return
    from torchdof.bench.report import publish, summary

    pythons, rows = {"here": sys.executable, "other": arguments.python or sys.executable}, []
    names = list(pythons)[: 1 + (arguments.python is not None)]
    for part, turn, name in itertools.product(arguments.parts, range(arguments.repeat), names):
        call = [pythons[name], __file__, arguments.scenes, "--parts", part, "--turn", str(turn)]
        process = subprocess.run(call, stdout=subprocess.PIPE, text=True, check=True)
        rows += [{"by": name, **row} for row in json.loads(process.stdout.splitlines()[-1])]
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
    table = summary(rows, ["figure", "by", "goal", "beside"], statistics.median)
    remark = f"{arguments.repeat} runs, each with other cameras, of " + ", ".join(f"{n}: {pythons[n]}" for n in names)
    publish("First pictures", {"First pictures": table}, [remark], arguments.out and arguments.out / "first_pictures")


if __name__ == "__main__":
    main()
