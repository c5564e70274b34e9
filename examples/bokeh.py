"""Night lights through six lenses: the shape of a point of light out of focus.

Usage: python examples/bokeh.py --out bokeh.png

The scene is a street at night: lamps and windows up to 60 m away, a post in focus at 2 m, fairy lights in front of it.
The lenses: ideal, seven blades, a traced double Gauss, anamorphic, cat's eyes, and a heart-shaped opening.
"""

import argparse
import math
from pathlib import Path

import torch
from torch import Tensor

from torchdof import BlurTable, Camera, DepthOfField
from torchdof.io.sheet import write_sheet
from torchdof.optics.aperture import Aperture

FOCUS_M, FAR_M = 2.0, 60.0
LAMPS, WINDOWS, FAIRY_LIGHTS = 18, 26, 6
COLOURS = torch.tensor([[1.0, 0.75, 0.4], [1.0, 0.55, 0.2], [0.7, 0.85, 1.0], [1.0, 0.2, 0.15], [0.4, 1.0, 0.5]])


def main() -> None:
    """Draw the sheet."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("bokeh.png"), help="picture to write")
    parser.add_argument("--height", type=int, default=480, help="height of each picture in pixels")
    arguments = parser.parse_args()
    image, depth = street(arguments.height, arguments.height * 3 // 4)
    camera = Camera(focal_length_mm=50.0, f_number=1.2, focus_m=FOCUS_M, sensor_width_mm=12.0)
    panels = {}
    for name, table in lenses().items():
        with torch.no_grad():
            panels[name] = DepthOfField(camera, table, depth_edges="as given")(image, depth).clamp(0.0, 1.0)
    write_sheet(arguments.out, panels)
    print(f"{arguments.out}: {', '.join(panels)}")


def lenses() -> dict[str, BlurTable]:
    """Caption -> blur table of each lens."""
    traced = BlurTable.load("double_gauss_50mm_f2")
    y, x = torch.meshgrid(torch.linspace(1.35, -1.15, 64), torch.linspace(-1.25, 1.25, 64), indexing="ij")
    heart = ((x**2 + y**2 - 1.0) ** 3 - x**2 * y**3 <= 0.0).float()
    return {
        "perfect": BlurTable.disc(),
        "seven blades": BlurTable.polygon(7, rotation_deg=12.0, curvature=0.2),
        "double Gauss": traced.replace(aperture=Aperture(blades=9, curvature=0.6)),
        "anamorphic": BlurTable.polygon(9, curvature=1.0, squeeze=2.0, rim=0.7),
        "cat's eyes": BlurTable.disc().replace(aperture=Aperture(vignetting=0.45)),
        "heart": BlurTable.from_aperture(heart),
    }


def street(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Light ``[1, 3, height, width]`` and depth in metres ``[1, 1, height, width]`` of a street at night."""
    generator = torch.Generator().manual_seed(7)
    row = (torch.arange(height) + 0.5)[:, None].expand(height, width) / height
    column = (torch.arange(width) + 0.5)[None, :].expand(height, width) / width
    ground = row > 0.6
    depth = torch.where(ground, 0.6 / (row - 0.6).clamp_min(0.6 / FAR_M), FAR_M)
    light = torch.stack([0.02 + 0.03 * row, 0.02 + 0.03 * row, 0.045 + 0.02 * row])
    light = torch.where(ground, light * (0.8 + 0.4 * torch.rand(height, width, generator=generator)), light)

    def draw(mask: Tensor, colour: Tensor, metres: float) -> None:
        is_visible = mask & (metres < depth)
        light[:, is_visible] = colour[:, None]
        depth[is_visible] = metres

    def dots(count: int, rows: tuple[float, float], metres: tuple[float, float], radius: float, power: float) -> None:
        for _ in range(count):
            y, x, fraction, colour_index = torch.rand(4, generator=generator).tolist()
            centre = rows[0] + y * (rows[1] - rows[0]), x
            distance = torch.hypot((row - centre[0]) * height, (column - centre[1]) * width)
            colour = COLOURS[int(colour_index * len(COLOURS))]
            depth_m = math.exp(math.log(metres[0]) + fraction * math.log(metres[1] / metres[0]))
            draw(distance < radius, power * colour, depth_m)

    dots(WINDOWS, (0.05, 0.55), (30.0, FAR_M - 1.0), 1.2, 25.0)
    dots(LAMPS, (0.1, 0.6), (6.0, 40.0), 1.5, 60.0)
    post = (column - 0.42).abs() < 0.035
    draw(post, torch.tensor([0.22, 0.16, 0.12]), FOCUS_M)
    light[:, post] *= 0.6 + 0.8 * torch.rand(int(post.sum()), generator=generator)
    dots(FAIRY_LIGHTS, (0.1, 0.9), (0.9, 1.2), 1.5, 80.0)
    return light[None], depth[None, None].contiguous()


if __name__ == "__main__":
    main()
