"""Calibrates a simulated phone, from the printed target to a rendered picture.

Run ``python tests/fit/phone.py --out out/phone``. A phone photographs the target (Bayer pattern, 1 % noise, an
S-curve, JPEG 90, a turned page), ``torchdof fit`` makes a table of the photographs alone, and ``torchdof render``
renders a scene with it. The result is the PSNR of that picture against the picture of the true lens.
"""

import argparse
import importlib
from pathlib import Path

import numpy as np
import torch
from click.testing import CliRunner

from torchdof import BlurTable, Camera, blur_by_coc
from torchdof.cli.main import app
from torchdof.io.images import Picture, read_image, write_image
from torchdof.reference.metrics import psnr

FOCUS_M = 0.20
DISTANCES_M = (0.24, 0.27, 0.30, 0.35, 0.40, 0.50, 0.65, 0.80)


def run(*words):
    """Run a command of torchdof, and print its output."""
    result = CliRunner().invoke(app, [str(w) for w in words])
    if result.exit_code:
        raise SystemExit(result.output)
    print("torchdof", *words, result.output, flush=True)


def scene(width):
    """A desk from 0.2 m to 0.8 m with stripes and lights `[1, 3, H, W]`, and its depth in metres `[1, 1, H, W]`."""
    height = width * 3 // 4
    stripes = 0.2 + 0.3 * ((torch.arange(width) // (width // 40)) % 2)
    image = stripes.expand(height, width).clone()
    image[height // 2 :] = 0.05
    image[height * 3 // 4 :: height // 12, width // 20 :: width // 10] = 60.0
    tint = torch.tensor([1.0, 0.8, 0.6])[:, None, None]
    return (image * tint)[None], torch.linspace(0.2, 0.8, width).expand(1, 1, height, width).clone()


def measure(folder, simulator, distances=DISTANCES_M, width=1000, tone=0.5, family="auto"):
    """Calibrates and renders in `folder`; PSNR in dB against the true lens, of the picture and of the sharp scene."""
    folder.mkdir(parents=True, exist_ok=True)
    run("fit", "--target", folder / "target.pdf")
    simulator.write_photographs(folder / "photographs", FOCUS_M, list(distances), width=width, tone=tone)
    run("fit", folder / "photographs", "-o", folder / "phone.json", "--family", family)
    image, depth = scene(width)
    write_image(folder / "scene.exr", Picture(image), sample="float")
    np.save(folder / "depth.npy", depth[0, 0].numpy())
    lens = {"focal_length_mm": 5.4, "f_number": 1.8, "focus_m": FOCUS_M, "sensor_width_mm": 36 * 5.4 / 26}
    options = [f"--{name.replace('_', '-')}={value:g}" for name, value in lens.items()]
    out, table = folder / "rendered.exr", folder / "phone.json"
    run("render", folder / "scene.exr", folder / "depth.npy", "-o", out, "--table", table, *options)
    true = blur_by_coc(image, Camera(**lens).coc_px(depth, width=width), table=BlurTable.disc())
    rendered = read_image(out).pixels
    shown = [torch.clamp(p, 0, 1) ** (1 / 2.2) for p in (rendered, image, true)]
    return float(psnr(shown[0], shown[2])), float(psnr(shown[1], shown[2]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for target, photographs, table and picture")
    found, untouched = measure(parser.parse_args().out, importlib.import_module("simulator"))
    print(f"PSNR against the true lens: rendered {found:.1f} dB, sharp scene {untouched:.1f} dB")
