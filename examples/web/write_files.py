"""Writes the files that the web page needs: the exported file, its camera as JSON, and a sample.

Usage: python examples/web/write_files.py --out examples/web/dist [--model dof.onnx]

Writes an exported file for each shape of the lens's opening, ``dof.json`` with their names and the camera, and in
``sample/`` a photograph and its depth in millimetres, 16 bits.
"""

import argparse
import json
import shutil
from pathlib import Path

import torchdof
from torchdof.depth import read_depth, repair_edges
from torchdof.export import describe, to_onnx
from torchdof.io.images import Picture, read_image, write_image

FOV_X_DEG = 40.0  # horizontal field of view of a 50 mm lens on full frame
MAX_COC_PX = 64.0
TILE_PX = 1024  # side of the tiles in which the full size is rendered; a larger one needs more memory
SHAPES = {
    "dof.onnx": ("Round", torchdof.BlurTable.disc()),
    "blades.onnx": ("Six blades", torchdof.BlurTable.polygon(6, 15.0)),
    "soft.onnx": ("Soft, a Gaussian", torchdof.BlurTable.gaussian()),
}
TOLERANCE = 4 / 255  # that of "preview", because a browser is slow
DATA = Path(__file__).parents[1] / "data" / "motorcycle"


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, required=True, help="folder of the page")
    parser.add_argument("--model", type=Path, help="an exported file to use instead of writing one for each shape")
    arguments = parser.parse_args()

    if arguments.model is None:
        camera = torchdof.Camera.from_fov(FOV_X_DEG, 0.01, 2.0)  # aperture and focus are inputs of the file
        print(f"writing and checking {len(SHAPES)} exported files; each takes a minute or two", flush=True)
        for file, (name, table) in SHAPES.items():
            dof = torchdof.DepthOfField(
                camera, table, tolerance=TOLERANCE, max_coc_px=MAX_COC_PX, depth_edges="as given", check=False
            )
            print(f"{name}: {to_onnx(dof, arguments.out / file)}", flush=True)
    else:
        shutil.copyfile(arguments.model, arguments.out / "dof.onnx")
    metadata = describe(arguments.out / "dof.onnx")
    shapes = [{"file": file, "name": name} for file, (name, _) in SHAPES.items() if (arguments.out / file).exists()]
    page_settings = {
        "focal_length_mm": metadata["camera"]["focal_length_mm"],
        "sensor_width_mm": metadata["camera"]["sensor_width_mm"],
        "max_coc_px": metadata["options"]["max_coc_px"],
        "tile_px": TILE_PX,
        "shapes": shapes,
    }
    (arguments.out / "dof.json").write_text(json.dumps(page_settings))

    sample = arguments.out / "sample"
    sample.mkdir(exist_ok=True)
    shutil.copyfile(DATA / "motorcycle_left.png", sample / "motorcycle.png")
    depth_options = json.loads((DATA / "camera.json").read_text())["depth"]
    depth_m = read_depth(DATA / "motorcycle_disp.npz", **depth_options)
    depth_m = repair_edges(read_image(DATA / "motorcycle_left.png").pixels, depth_m)
    write_image(sample / "motorcycle_depth.png", Picture(depth_m / 65.535, ("Y",)), "linear", "16")  # millimetres


if __name__ == "__main__":
    main()
