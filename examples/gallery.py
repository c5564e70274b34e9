"""Draws the pictures of the documentation from the data in this repository.

Usage: python examples/gallery.py --out docs/pictures

``GALLERY`` names each file and the function that draws it; ``--only NAME`` draws one of them.
"""

import argparse
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor

import torchdof
from torchdof.depth import inspect_depth
from torchdof.depth.inspect import coc_colours, panels, tint_focus
from torchdof.io.images import Picture, read_image, write_image
from torchdof.io.sheet import write_sheet
from torchdof.reference.degraded import degrade
from torchdof.reference.scenes import Scene, read_scenes

ROOT = Path(__file__).parents[1]
MOTORCYCLE, PORTRAIT = ROOT / "examples/data/motorcycle", ROOT / "examples/data/portrait"
SCENES = ROOT / "tests/data/scenes"
DEMO = runpy.run_path(str(ROOT / "examples/demo.py"))
TABLES = ("sato_j15", "double_gauss_50mm_f2", "wide_22mm_f4")


def motorcycle(focus_m: float = 2.3, aperture_radius_m: float = 0.04) -> tuple[Tensor, Tensor, torchdof.Camera]:
    """The photograph, ``[1, 3, 500, 741]`` in linear light, its depth in metres, and a lens."""
    picture, depth, camera = DEMO["motorcycle"](MOTORCYCLE, focus_m, aperture_radius_m)
    return picture.pixels, depth, camera


def focused(focus_m: float, aperture_radius_m: float = 0.04) -> Tensor:
    """The photograph through the lens."""
    shot = motorcycle(focus_m, aperture_radius_m)
    return torchdof.depth_of_field(*shot, depth_edges="repair")  # stereo edges may be a pixel off


def photograph(path: Path, pixels: Tensor) -> None:
    """Writes one picture."""
    write_image(path, Picture(pixels, sample="8", transfer="srgb"))


def half(pixels: Tensor) -> Tensor:
    """At half the resolution."""
    return functional.avg_pool2d(pixels, 2)


def cut_out(path: Path, scene: Scene, pictures: dict[str, Tensor]) -> None:
    """Writes pictures of a scene without its margin, at twice the resolution, each pixel a square."""
    m = scene.margin_px
    inner = {caption: pixels[..., m:-m, m:-m] for caption, pixels in pictures.items()}
    write_sheet(path, {name: functional.interpolate(pixels, scale_factor=2.0) for name, pixels in inner.items()})


def portrait(stops: float = 0.0) -> Tensor:
    """The demo's portrait; lamps behind the face get up to ``stops`` more light before they are blurred."""
    picture, depth, camera = DEMO["portrait"](PORTRAIT, stops)
    return torchdof.depth_of_field(picture.pixels, depth, camera)


def draw_portrait_lights(path: Path) -> None:
    """A part of the portrait: sharp, with lamps as bright as the file holds them, and with brighter ones."""
    part = (..., slice(150, 390), slice(500, 760))
    sharp = read_image(PORTRAIT / "portrait.jpg").pixels
    pictures = {"photograph": sharp, "lamps as stored": portrait(), "lamps 4 stops brighter": portrait(4.0)}
    write_sheet(path, {caption: pixels[part] for caption, pixels in pictures.items()})


def draw_blur_radius(path: Path) -> None:
    """Photograph, signed circle of confusion, result."""
    image, depth, camera = motorcycle(3.1)
    coc_px = camera.coc_px(depth, image.shape[-1])
    radii = f"radius {float(coc_px.min()):+.1f} to {float(coc_px.max()):+.1f} px"
    pictures = {"sharp": image, radii: coc_colours(coc_px), "focus at 3.1 m": focused(3.1)}
    write_sheet(path, {caption: half(pixels) for caption, pixels in pictures.items()})


def draw_apertures(path: Path) -> None:
    """The same focus at three openings."""
    part = (..., slice(120, 400), slice(340, 720))
    write_sheet(path, {f"opening {2000 * r:g} mm": focused(2.3, r)[part] for r in (0.01, 0.02, 0.04)})


def draw_show_focus(path: Path) -> None:
    """The picture of ``torchdof render --show-focus``."""
    image, depth, camera = motorcycle(2.8, 0.02)
    photograph(path, tint_focus(image, camera.coc_px(depth, image.shape[-1])))


def draw_inspect(path: Path) -> None:
    """The picture of ``torchdof inspect``."""
    image, depth, camera = motorcycle(2.8, 0.02)
    report = inspect_depth(image, depth, camera)
    write_sheet(path, {caption.partition(":")[0]: half(panel) for caption, panel in panels(image, report).items()})


def draw_lenses(path: Path) -> None:
    """Small lights through five lenses."""
    tables = {"disc": torchdof.BlurTable.disc(), "gaussian": torchdof.BlurTable.gaussian()}
    tables |= {name: torchdof.BlurTable.load(name) for name in TABLES}
    draw_lights(path, tables)


def draw_shapes(path: Path) -> None:
    """Small lights through openings that are not round."""
    polygon = torchdof.BlurTable.polygon
    tables = {"5 blades": polygon(5), "7, rounded": polygon(7, curvature=0.4), "9, turned": polygon(9, rotation_deg=20)}
    draw_lights(path, tables | {"anamorphic": polygon(8, squeeze=2.0), "bright rim": polygon(6, rim=2.0)})


def draw_bokeh(path: Path) -> None:
    """A street at night through six lenses, as ``examples/bokeh.py`` draws it."""
    subprocess.run([sys.executable, ROOT / "examples/bokeh.py", "--out", path, "--height", "320"], check=True)


def draw_field(path: Path) -> None:
    """The left half of a street at night, with the kernels of the middle of the frame, and with those of the field."""
    from torchdof.fit import trace_table
    from torchdof.fit.lens import Lens
    from torchdof.fit.lens.lens import RGB_UM

    street = runpy.run_path(str(ROOT / "examples/bokeh.py"))["street"]
    lens = Lens.read("double_gauss_50mm").with_f_number(2.0)
    camera = torchdof.Camera(lens.paraxial().focal_length, f_number=2.0, focus_m=2.0, sensor_width_mm=36.0)
    field_mm = (0.0, 2.7, 5.4, 8.1, 10.9, 13.7, 16.5, 19.8, 21.6)
    rays: dict[str, Any] = {"field_nodes": 8, "field_rays": 30_000}
    table = trace_table(lens, 2.0, 2.0, nodes=9, wavelengths_um=RGB_UM, field=field_mm, **rays)
    image, depth = street(640, 960)
    pictures = {}
    for name, spots in {"as in the middle of the frame": None, "traced across the field": table.field}.items():
        picture = torchdof.DepthOfField(camera, table.replace(field=spots), depth_edges="as given")(image, depth)
        pictures[name] = picture[..., 40:400, :480].clamp(0.0, 1.0)
    write_sheet(path, pictures)


def draw_lights(path: Path, tables: dict[str, torchdof.BlurTable]) -> None:
    """Small lights, from 14 px in front of the focus to 14 px behind it."""
    height, width, cocs = 150, 220, (-14.0, -7.0, 0.0, 7.0, 14.0)
    image, coc_px = torch.full((1, 3, height, width), 0.01), torch.zeros(1, 1, height, width)
    for column, coc in enumerate(cocs):
        left = 44 * column
        coc_px[..., left : left + 44] = coc
        for row, colour in ((40, (1.0, 0.75, 0.4)), (110, (0.5, 0.7, 1.0))):
            image[0, :, row, left + 22] = 0.8 * 3.1416 * max(abs(coc), 0.6) ** 2 * torch.tensor(colour)
    write_sheet(path, {name: torchdof.blur_by_coc(image, coc_px, table=table) for name, table in tables.items()})


def draw_layers(path: Path) -> None:
    """Surfaces behind the focus, in focus and in front of it, each blurred alone, on grey."""
    image, depth, camera = motorcycle(2.5)
    coc_px, dof = camera.coc_px(depth, image.shape[-1]), torchdof.DepthOfField(camera)
    parts = {"behind the focus": coc_px > 2, "in focus": coc_px.abs() <= 2, "in front of it": coc_px < -2}
    pictures = {}
    for name, part in parts.items():
        rgba = torch.cat([image * part, part.to(image)], dim=1)
        light, cover = dof.layers(rgba[:, None], depth[:, None]).split([3, 1], dim=1)
        pictures[name] = half(light + (1 - cover) * 0.4)
    write_sheet(path, pictures)


def draw_truth(path: Path) -> None:
    """A ray-traced cut-out: sharp, torchdof, and the path-traced picture through the lens."""
    (scene,) = read_scenes(SCENES / {"truth_lamps": "highlights", "truth_bars": "planes"}[path.stem])
    rendered = torchdof.depth_of_field(scene.image, scene.depth, scene.camera)
    cut_out(path, scene, {"sharp": scene.image, "torchdof": rendered, "path-traced": scene.truth})


def draw_edges(path: Path) -> None:
    """A ray-traced cut-out with depth of a quarter of the resolution, as given and repaired, and with exact depth."""
    (scene,) = read_scenes(SCENES / "planes")
    soft = degrade(scene.depth, "quarter-res")
    pictures = {
        "soft depth, as given": torchdof.depth_of_field(scene.image, soft, scene.camera, depth_edges="as given"),
        "soft depth, repaired": torchdof.depth_of_field(scene.image, soft, scene.camera, depth_edges="auto"),
        "exact depth": torchdof.depth_of_field(scene.image, scene.depth, scene.camera),
        "path-traced": scene.truth,
    }
    cut_out(path, scene, pictures)


def draw_fit(path: Path) -> None:
    """A dot in focus, the same dot out of focus, and the plot of ``torchdof fit --plots`` for both."""
    simulator = runpy.run_path(str(ROOT / "tests/fit/simulator.py"))
    camera = torchdof.Camera(focal_length_mm=50.0, f_number=2.8, focus_m=1.0)
    radius = float(camera.coc_px(torch.full((1, 1, 1, 1), 0.7), 640).abs())
    dot = simulator["Simulator"](level=0.7, snr_db=46, dot_radius=9.0, black=0.02)
    with tempfile.TemporaryDirectory() as name:
        lens = Path(name) / "lens"
        simulator["write_captures"](lens, dot, 1.0, [0.7], lambda _: ("disc", {"radius": radius}), 640)
        arguments = [str(lens), "-o", str(lens / "lens.json"), "--plots", str(lens / "plots")]
        subprocess.run([sys.executable, "-m", "torchdof", "fit", *arguments], check=True, stdout=subprocess.DEVNULL)
        pictures = {}
        for caption, file in {"in focus, 1 m": "1000mm.png", "out of focus, 0.7 m": "0700mm.png"}.items():
            part = read_image(lens / file).pixels[..., 90:150, 275:365]
            pictures[caption] = functional.interpolate(part, size=(300, 450), mode="nearest")
        (plot,) = (lens / "plots").glob("*700mm.png")
        pictures["fitted"] = functional.interpolate(read_image(plot).pixels[:, :3], (300, 450), mode="area")
    write_sheet(path, pictures)


def draw_thin_lens(path: Path) -> None:
    """Blur radius over distance at three f-numbers."""
    from matplotlib.figure import Figure

    depth = torch.linspace(0.5, 12.0, 400)
    figure = Figure(figsize=(8, 3.4), layout="constrained")
    axes = figure.subplots()
    for f_number in (1.8, 2.8, 5.6):
        camera = torchdof.Camera(focal_length_mm=50.0, f_number=f_number, focus_m=2.0)
        axes.plot(depth, camera.coc_px(depth[None, None, None], width=1920).flatten(), label=f"f/{f_number}")
    axes.axhline(0, color="0.7", linewidth=0.8)
    axes.set(xlabel="distance, m", ylabel="signed radius, px", ylim=(-30, 30), title="50 mm, focus 2 m, 1920 px wide")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)


GALLERY: dict[str, Callable[[Path], None]] = {
    "before.jpg": lambda path: photograph(path, motorcycle()[0]),
    "after.jpg": lambda path: photograph(path, focused(2.3)),  # on the front wheel
    "far.jpg": lambda path: photograph(path, focused(4.6)),  # on the shelf behind
    "portrait.jpg": lambda path: photograph(path, portrait(4.0)),
    "portrait_lights.jpg": draw_portrait_lights,
    "blur_radius.jpg": draw_blur_radius,
    "apertures.jpg": draw_apertures,
    "show_focus.jpg": draw_show_focus,
    "inspect.jpg": draw_inspect,
    "lenses.jpg": draw_lenses,
    "shapes.jpg": draw_shapes,
    "bokeh.jpg": draw_bokeh,
    "field.jpg": draw_field,
    "layers.jpg": draw_layers,
    "edges.jpg": draw_edges,
    "fit.jpg": draw_fit,
    "truth_lamps.jpg": draw_truth,
    "truth_bars.jpg": draw_truth,
    "thin_lens.png": draw_thin_lens,
}


def main() -> None:
    """Draw all pictures, or one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures")
    parser.add_argument("--only", choices=GALLERY, help="draw one of them")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, draw in GALLERY.items():
        if arguments.only in (None, name):
            draw(arguments.out / name)
            print(arguments.out / name)


if __name__ == "__main__":
    main()
