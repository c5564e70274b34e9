"""The places at which torchdof is farthest from the truth, beside Ikoma's formula and the truth.

Usage: python examples/benchmarks/worst_places.py SCENES --out docs/pictures/worst_places.jpg

``SCENES`` is a folder of scenes with known truth, as ``torchdof bench --truth`` takes it. Of each case the square with
the largest squared error, display-encoded, is shown.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof import depth_of_field
from torchdof.bench.accuracy import ikoma
from torchdof.io.sheet import write_sheet
from torchdof.reference import metrics
from torchdof.reference.scenes import Scene, read_scenes

CASES = ("portrait/1", "highlights/0", "highlights/2", "planes/0", "foliage/1")


def worst_place(picture: Tensor, scene: Scene, side: int) -> tuple[int, int]:
    """Row and column at which the square with the largest squared error begins, not at the frame's border."""
    error = (metrics.display(picture) - metrics.display(scene.truth)).square().mean(1, keepdim=True) * scene.inner
    means = functional.avg_pool2d(error, side, stride=1)[0, 0]
    return divmod(int(means.argmax()), means.shape[1])


def panels(scenes: Sequence[Scene], side: int, times: int) -> dict[str, Tensor]:
    """Captions and columns of the sheet: the worst places below each other, ``[1, 3, H, W]`` in linear light."""
    columns: dict[str, list[Tensor]] = {"Ikoma's formula": [], "torchdof": [], "path-traced": []}
    for scene in scenes:
        ours = depth_of_field(scene.image, scene.depth, scene.camera)
        row, column = worst_place(ours, scene, side)
        for parts, picture in zip(columns.values(), (ikoma(scene), ours, scene.truth), strict=True):
            parts.append(picture[..., row : row + side, column : column + side])
        print(f"{scene.name}: rows {row} to {row + side}, columns {column} to {column + side}")
    return {name: functional.interpolate(torch.cat(parts, -2), scale_factor=times) for name, parts in columns.items()}


def main() -> None:
    """Draws the sheet."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cases", nargs="+", default=CASES, help="by default %(default)s")
    parser.add_argument("--side", type=int, default=96, help="pixels of a square; by default %(default)s")
    parser.add_argument("--times", type=int, default=2, help="how much they are enlarged; by default %(default)s")
    arguments = parser.parse_args()
    known = {scene.name: scene for scene in read_scenes(arguments.scenes)}
    missing = [name for name in arguments.cases if name not in known]
    if missing:
        parser.error(f"{arguments.scenes} has no {', '.join(missing)}; it has {', '.join(known)}")
    write_sheet(arguments.out, panels([known[name] for name in arguments.cases], arguments.side, arguments.times))


if __name__ == "__main__":
    main()
