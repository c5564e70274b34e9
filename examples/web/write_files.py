"""Writes the files that the web page needs: the exported file, its camera as JSON, and a sample.

Usage: python examples/web/write_files.py --out examples/web/dist [--model dof.onnx]

Writes an exported file for each shape of the lens's opening, ``dof.json`` with their names and the camera, and in
``sample/`` a photograph and its depth in millimetres, 16 bits. A shape that cannot be written is left out of the page.
"""

import argparse
import json
import shutil
import sys
from pathlib import Path

try:
    import torchdof
    from torchdof.depth import read_depth, repair_edges
    from torchdof.export import describe, to_onnx
    from torchdof.io.images import Picture, read_image, write_image
except ModuleNotFoundError as error:
    raise SystemExit(
        f"the page needs {error.name}, which {sys.executable} does not have; run make install in the folder of the "
        "repository, or pip install '.[export]', or name another Python: PYTHON=/path/to/python npm run build"
    ) from None

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


def write_shapes(out: Path) -> list[str]:
    """Writes and verifies an exported file for each shape; returns the names of those that were written."""
    camera = torchdof.Camera.from_fov(FOV_X_DEG, 0.01, 2.0)  # aperture and focus are inputs of the file
    print(f"writing and checking {len(SHAPES)} exported files; each takes about four minutes", flush=True)
    written = []
    for file, (name, table) in SHAPES.items():
        dof = torchdof.DepthOfField(camera, table, tolerance=TOLERANCE, max_coc_px=MAX_COC_PX, check=False)
        try:
            report = to_onnx(dof, out / file, inputs="depth+matte")
            print(f"{name}: {report}", flush=True)
        except (ValueError, RuntimeError, MemoryError) as error:
            print(f"warning: the page is without the shape {name!r}: {error}", file=sys.stderr, flush=True)
        else:
            written.append(file)
    if not written:
        raise SystemExit("error: no exported file could be written, so that there is no page")
    return written


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, required=True, help="folder of the page")
    parser.add_argument("--model", type=Path, help="an exported file to use instead of writing one for each shape")
    arguments = parser.parse_args()

    if arguments.model is None:
        written = write_shapes(arguments.out)
    else:
        shutil.copyfile(arguments.model, arguments.out / "dof.onnx")
        written = ["dof.onnx"]
    metadata = describe(arguments.out / written[0])
    page_settings = {
        "focal_length_mm": metadata["camera"]["focal_length_mm"],
        "sensor_width_mm": metadata["camera"]["sensor_width_mm"],
        "max_coc_px": metadata["options"]["max_coc_px"],
        "tile_px": TILE_PX,
        "takes_matte": "matte" in metadata["inputs"],
        "shapes": [{"file": file, "name": SHAPES[file][0]} for file in written],
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
