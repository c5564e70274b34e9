"""A real photograph with measured depth, focused near, in the middle and far.

Usage: python examples/demo.py --data examples/data/motorcycle --out out

Writes ``near.png``, ``middle.png`` and ``far.png``, and for each a sheet with the sharp photograph, the map of the
circle of confusion (orange in front of the focus, black in focus, blue behind it) and the result.
"""

import argparse
import dataclasses
import json
import math
import time
from pathlib import Path

import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

import torchdof
from torchdof.depth.inspect import coc_colours
from torchdof.depth.reading import read_depth
from torchdof.io.images import read_image, write_image
from torchdof.io.sheet import write_sheet

FOCUS_M = {"near": 2.3, "middle": 3.1, "far": 4.6}
APERTURE_RADIUS_M = 0.04  # larger than in most lenses, so that the blur is visible in a picture 741 pixels wide


def main() -> None:
    """Render the three pictures and their sheets."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "--data", type=Path, required=True, help="folder with motorcycle_left.png, motorcycle_disp.npz and camera.json"
    )
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)

    picture = read_image(arguments.data / "motorcycle_left.png")
    calibration = json.loads((arguments.data / "camera.json").read_text())
    depth = read_depth(arguments.data / "motorcycle_disp.npz", **calibration["depth"])
    height, width = depth.shape[-2:]
    fov_x_deg = math.degrees(2 * math.atan(width / 2 / calibration["focal_length_px"]))

    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), transient=True) as progress:
        task = progress.add_task("rendering", total=len(FOCUS_M))
        for name, focus_m in FOCUS_M.items():
            progress.update(task, description=f"focus {name}")
            camera = torchdof.Camera.from_fov(fov_x_deg, APERTURE_RADIUS_M, focus_m)
            dof = torchdof.DepthOfField(camera, depth_edges="repair")  # stereo edges may be a pixel off
            start = time.perf_counter()
            with torch.no_grad():
                blurred = dof(picture.pixels, depth)
            seconds = time.perf_counter() - start
            coc_px = camera.coc_px(depth, width)
            write_image(arguments.out / f"{name}.png", dataclasses.replace(picture, pixels=blurred))
            write_sheet(
                arguments.out / f"{name}_sheet.png",
                {
                    "sharp": picture.pixels,
                    f"circle of confusion, radius {coc_px.min():+.1f} to {coc_px.max():+.1f} px": coc_colours(coc_px),
                    f"focus at {focus_m:g} m": blurred,
                },
            )
            progress.advance(task)
            print(
                f"{name:6s} focus {focus_m:.2f} m, aperture radius {1000 * APERTURE_RADIUS_M:.0f} mm, "
                f"field of view {fov_x_deg:.1f} degrees, blur radius up to {float(coc_px.abs().max()):.1f} px, disc, "
                f"{width} x {height}: {seconds:.2f} s -> {arguments.out / name}.png, {name}_sheet.png"
            )


if __name__ == "__main__":
    main()
