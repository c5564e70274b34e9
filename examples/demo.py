"""A real photograph with measured depth, focused near, in the middle and far; and a portrait before lamps.

Usage: python examples/demo.py --data examples/data/motorcycle --out out

Writes ``near.png``, ``middle.png``, ``far.png`` and ``portrait.png``, and for each a sheet with the sharp photograph,
the map of the circle of confusion (orange in front of the focus, black in focus, blue behind it) and the result.
"""

import argparse
import dataclasses
import json
import math
import time
from pathlib import Path

import torch
from torch import Tensor

import torchdof
from torchdof.depth import from_relative, read_depth
from torchdof.depth.inspect import coc_colours
from torchdof.io.highlights import expand_highlights
from torchdof.io.images import Picture, read_image, read_values, write_image
from torchdof.io.sheet import write_sheet

FOCUS_M = {"near": 2.3, "middle": 3.1, "far": 4.6}
APERTURE_RADIUS_M = 0.04  # larger than in most lenses, so that the blur is visible in a picture 741 pixels wide
Shot = tuple[Picture, Tensor, torchdof.Camera]  # a photograph, its depth, and a lens


def motorcycle(folder: Path, focus_m: float, aperture_radius_m: float = APERTURE_RADIUS_M) -> Shot:
    """A photograph with depth measured by stereo."""
    calibration = json.loads((folder / "camera.json").read_text())
    depth = read_depth(folder / "motorcycle_disp.npz", **calibration["depth"])
    fov_x_deg = math.degrees(2 * math.atan(depth.shape[-1] / 2 / calibration["focal_length_px"]))
    camera = torchdof.Camera.from_fov(fov_x_deg, aperture_radius_m, focus_m)
    return read_image(folder / "motorcycle_left.png"), depth, camera


def portrait(folder: Path, stops: float) -> Shot:
    """A made photograph with relative depth; lamps that the file stores as white get up to ``stops`` more light."""
    picture = read_image(folder / "portrait.jpg")
    depth = from_relative(read_values(folder / "depth.png"), near_m=0.744, far_m=14.0)
    camera = torchdof.Camera.from_fov(36.0, aperture_radius_m=0.0173, focus_m=1.14)
    light = expand_highlights(picture.pixels, stops) if stops else picture.pixels
    return dataclasses.replace(picture, pixels=light), depth, camera


def render(name: str, shot: Shot, out: Path) -> None:
    """Write a picture and its sheet, and print a line that describes them."""
    picture, depth, camera = shot
    height, width = depth.shape[-2:]
    dof = torchdof.DepthOfField(camera, depth_edges="repair")  # stereo edges may be a pixel off
    start = time.perf_counter()
    with torch.no_grad():
        blurred = dof(picture.pixels, depth)
    seconds = time.perf_counter() - start
    coc_px = camera.coc_px(depth, width)
    write_image(out / f"{name}.png", dataclasses.replace(picture, pixels=blurred, sample="8"))
    panels = {
        "sharp": picture.pixels,
        f"circle of confusion, radius {coc_px.min():+.1f} to {coc_px.max():+.1f} px": coc_colours(coc_px),
        f"focus at {camera.focus_m:g} m": blurred,
    }
    write_sheet(out / f"{name}_sheet.png", panels)
    print(
        f"{name:8s} focus {camera.focus_m:.2f} m, f/{camera.f_number:.2f}, blur radius up to "
        f"{float(coc_px.abs().max()):.1f} px, disc, {width} x {height}: {seconds:.2f} s -> {out / name}.png, "
        f"{name}_sheet.png"
    )


def main() -> None:
    """Render the pictures and their sheets."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "--data", type=Path, required=True, help="folder with motorcycle_left.png, motorcycle_disp.npz and camera.json"
    )
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, focus_m in FOCUS_M.items():
        render(name, motorcycle(arguments.data, focus_m), arguments.out)
    render("portrait", portrait(arguments.data.parent / "portrait", stops=4.0), arguments.out)


if __name__ == "__main__":
    main()
