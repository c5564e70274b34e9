"""A defocus data set from a folder of photographs and their depth maps.

    python examples/defocus_dataset.py --images photos --depths depth --out data --workers 2 --copies 4

A depth map has the name of its image, with any suffix. After an interruption, the same command continues where it
stopped. Needs Ray: pip install '.[ray]'.
"""

import argparse
from pathlib import Path

from torchdof import BlurTable, Camera
from torchdof.augmentation import RandomDepthOfField
from torchdof.distributed import make_dataset, pairs_in

__all__ = ["main"]


def main() -> None:
    """Make the data set."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--images", type=Path, required=True, help="folder of all-in-focus images")
    parser.add_argument("--depths", type=Path, help="folder of their depth maps; default: the images' own Z channels")
    parser.add_argument("--mattes", type=Path, help="folder of subjects' masks, which decide where hair ends")
    parser.add_argument("--out", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--depth-kind", default="z", help="z, disparity, inverse, or relative, as estimators give it")
    parser.add_argument("--near-m", type=float, help="distance of the nearest value of relative depth")
    parser.add_argument("--far-m", type=float, help="distance of the farthest value of relative depth")
    parser.add_argument("--depth-scale", type=float, help="factor of the depth values, such as 0.001 for millimetres")
    parser.add_argument("--depth-offset", type=float, default=0.0, help="added to the depth values before scaling")
    parser.add_argument("--fill-depth", help="nearest or far: how to fill pixels without depth")
    parser.add_argument("--focus-m", type=float, nargs=2, default=(0.5, 5.0), metavar=("NEAR", "FAR"))
    parser.add_argument("--f-number", type=float, nargs=2, default=(1.4, 8.0), metavar=("FROM", "TO"))
    parser.add_argument("--focal-length-mm", type=float, default=50.0)
    parser.add_argument("--sensor-width-mm", type=float, default=36.0)
    parser.add_argument(
        "--table", action="append", help="a lens, such as sato_j15; of several, one is chosen at random"
    )
    parser.add_argument("--tolerance", default="final", help="draft, preview or final")
    parser.add_argument("--format", choices=("webdataset", "parquet"), default="webdataset")
    parser.add_argument("--per-shard", type=int, default=64, help="samples in a shard")
    parser.add_argument("--copies", type=int, default=1, help="number of blurred versions of each image")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    blur = RandomDepthOfField(
        tuple(arguments.focus_m),
        tuple(arguments.f_number),
        Camera(focal_length_mm=arguments.focal_length_mm, sensor_width_mm=arguments.sensor_width_mm),
        [BlurTable.load(name) for name in arguments.table] if arguments.table else None,
        p=1.0,
        tolerance=arguments.tolerance,
    )
    numbers = {"scale": arguments.depth_scale, "offset": arguments.depth_offset}
    if arguments.depth_kind == "relative":
        numbers = {"near_m": arguments.near_m, "far_m": arguments.far_m}
    depth = {"kind": arguments.depth_kind, "fill": arguments.fill_depth, **numbers}
    options = {name: getattr(arguments, name) for name in ("workers", "per_shard", "copies", "format", "seed")}
    pairs = pairs_in(arguments.images, arguments.depths, arguments.mattes)
    make_dataset(pairs, arguments.out, blur, depth=depth, **options)


if __name__ == "__main__":
    main()
