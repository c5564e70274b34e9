"""A file against the module on scenes with known truth: ``python examples/benchmarks/exported_scenes.py SCENES``.

For each scene PSNR in dB against the truth, display-encoded, of the module as it is called and of one file that holds
blurs up to 32 pixels at a tolerance of 1/255. Unless it is named the file is written first, which takes a minute.
"""

import argparse
import tempfile
from pathlib import Path

import torch

from torchdof import Camera, DepthOfField, blur_by_coc
from torchdof.export import to_onnx
from torchdof.export.verification import session
from torchdof.reference import metrics
from torchdof.reference.scenes import read_scenes

__all__ = ["main"]

MAX_COC_PX = 32.0


def main() -> None:
    """Print a line a scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("scenes", type=Path, help="folder of scenes, as torchdof bench --truth takes it")
    parser.add_argument("--model", type=Path, help="a file that takes coc_px, instead of writing one")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        model = arguments.model or Path(folder) / "dof.onnx"
        if not model.exists():
            dof = DepthOfField(Camera(), tolerance=1 / 255, max_coc_px=MAX_COC_PX, check=False)
            to_onnx(dof, model, inputs="coc_px")
        runner = session(model)
    print("| scene | module dB | file dB | difference |\n| --- | --- | --- | --- |")
    for scene in read_scenes(arguments.scenes):
        image, coc_px = scene.image[:, :3].contiguous(), scene.coc_px
        with torch.inference_mode():
            eager = blur_by_coc(image, coc_px, tolerance=1 / 255)
        (out,) = runner.run(None, {"image": image.numpy(), "coc_px": coc_px.numpy()})
        truth = metrics.display(scene.truth)
        called, exported = (metrics.psnr(metrics.display(x), truth) for x in (eager, torch.from_numpy(out)))
        print(f"| {scene.name} | {called:.2f} | {exported:.2f} | {exported - called:+.2f} |", flush=True)


if __name__ == "__main__":
    main()
