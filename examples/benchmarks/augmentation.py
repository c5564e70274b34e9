"""Random crops of a photograph, blurred: images a second and core, beside other libraries' blurs.

    python examples/benchmarks/augmentation.py --data examples/data/motorcycle

Crops of 256 x 256 in batches of 16, focus 2.2 to 5 m, f/1.4 to f/8. One thread; seconds of the processor, in turns, so
that whatever else the machine does meets all alike. Kornia's box blur has one size for the whole image and
albumentations' Defocus one disc: neither knows depth, so they are a measure of cost, not of the same picture.
"""

import argparse
import functools
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from kornia.augmentation import RandomBoxBlur
from torch import Tensor

from torchdof import Camera, DepthOfField
from torchdof.augmentation import RandomDepthOfField
from torchdof.bench.report import machine
from torchdof.bench.timer import in_turns, median_and_spread, processor_seconds
from torchdof.depth.reading import read_depth
from torchdof.io.images import read_image
from torchdof.io.transfer import decode, encode
from torchdof.validation import whole

__all__ = ["crops", "main", "works"]

_SIDE_PX = 256
_WAYS = {
    "final": {"tolerance": "final"},
    "preview": {"tolerance": "preview"},
    "draft, no occlusion": {"tolerance": "draft", "occlusion": False},
}


def crops(data: Path, count: int) -> tuple[Tensor, Tensor, Camera]:
    """Crops of the photograph, encoded for display ``[B, 3, 256, 256]``, their depth in metres, and their camera."""
    known = json.loads((data / "camera.json").read_text())
    image = encode(read_image(data / "motorcycle_left.png").pixels, "srgb", has_alpha=False, straight=False)
    depth = read_depth(data / "motorcycle_disp.npz", **known["depth"])
    fov_x_deg = math.degrees(2 * math.atan(_SIDE_PX / 2 / known["focal_length_px"]))
    generator = torch.Generator().manual_seed(0)
    corners = [
        [int(torch.randint(size - _SIDE_PX + 1, (1,), generator=generator)) for size in image.shape[-2:]]
        for _ in range(count)
    ]
    windows = [(..., slice(y, y + _SIDE_PX), slice(x, x + _SIDE_PX)) for y, x in corners]
    camera = Camera.from_fov(fov_x_deg, aperture_radius_m=0.04, focus_m=3.0)
    return torch.cat([image[w] for w in windows]), torch.cat([depth[w] for w in windows]), camera


def works(image: Tensor, depth: Tensor, camera: Camera) -> dict[str, Callable[[], object]]:
    """What is compared, by name; torchdof's pictures are checked first.

    Raises:
        RuntimeError: If a picture is not the rendering of its parameters.
    """
    compared: dict[str, Callable[[], object]] = {}
    for name, options in _WAYS.items():
        aug = RandomDepthOfField((2.2, 5.0), (1.4, 8.0), camera=camera, p=1.0, **options)  # type: ignore[arg-type]
        out = aug(image, depth)
        lens = {name: aug._params[name] for name in ("focus_m", "f_number")}
        right = DepthOfField(camera, **options)(decode(image, "srgb", False, False), depth, **lens)  # type: ignore[arg-type]
        if not torch.allclose(out, encode(right, "srgb", False, False), atol=1e-6):
            raise RuntimeError(f"{name}: the picture is not the rendering of its parameters")
        compared[f"torchdof RandomDepthOfField, {name}"] = functools.partial(aug, image, depth)
    box = RandomBoxBlur((11, 11), p=1.0)
    compared["kornia RandomBoxBlur, 11 x 11"] = lambda: box(image)
    try:
        import albumentations
        import cv2
    except ModuleNotFoundError:
        print("albumentations is not installed: pip install albumentations")
    else:
        cv2.setNumThreads(1)
        defocus = albumentations.Defocus(radius=(1, 8), p=1.0)
        arrays = [np.ascontiguousarray(a) for a in (255 * image).byte().permute(0, 2, 3, 1).numpy()]
        compared[f"albumentations {albumentations.__version__} Defocus, radius 1 to 8, bytes"] = lambda: [
            defocus(image=array) for array in arrays
        ]
        floats = [np.ascontiguousarray(a) for a in image.permute(0, 2, 3, 1).numpy()]
        compared[f"albumentations {albumentations.__version__} Defocus, radius 1 to 8, floats"] = lambda: [
            defocus(image=array) for array in floats
        ]
    return compared


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, required=True, help="the folder of the motorcycle")
    parser.add_argument("--batch", type=int, default=16, help="crops in a batch")
    parser.add_argument("--repeat", type=int, default=15, help="turns")
    arguments = parser.parse_args()
    for name in ("batch", "repeat"):
        whole(f"--{name}", getattr(arguments, name), 1, 100_000)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    compared = works(*crops(arguments.data, arguments.batch))
    seconds = in_turns(compared, arguments.repeat, processor_seconds)
    print(machine())
    print("| blur | images/s/core | interquartile range |\n| --- | --- | --- |")
    for name, taken in seconds.items():
        rate, spread = median_and_spread([arguments.batch / s for s in taken])
        print(f"| {name} | {rate:.0f} | {spread:.0f} |")


if __name__ == "__main__":
    main()
