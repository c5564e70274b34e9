"""Scale, shift, focus and f-number from a picture that is out of focus, by gradient descent through the renderer.

Usage: python examples/solve_scale.py --scene tests/data/scenes/room --out out

Given are the sharp image, its relative disparity in 8 bits (as an estimator gives it, without scale and shift), and one
picture taken through a lens. The four numbers start from a guess and are optimised together until the rendering matches
the picture.

One picture does not determine all four. The radius of the circle of confusion is ``K (1/focus - shift - scale *
disparity)``, with K from aperture and focal length. This is a straight line over disparity, which has two parameters.
The other two numbers must be known for a result in metres, for example f-number and focus from EXIF (``--known f_number
focus_m``). Otherwise the solution renders the same picture, but its metres are wrong by an unknown scale and shift.
"""

import argparse
from collections.abc import Collection
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

import torchdof
from torchdof.io.sheet import write_sheet
from torchdof.reference.metrics import display, psnr
from torchdof.reference.scenes import Scene, read_scenes

# Downsampling factor, steps, learning rate. Coarse stages come first: far from the solution, detail misleads.
STAGES = ((4, 60, 0.08), (2, 40, 0.04), (1, 25, 0.02))
Numbers = dict[str, float]  # "scale", "shift", "focus_m", "f_number"; 1 / depth = scale * disparity + shift


def solve(
    image: Tensor, blurred: Tensor, disparity: Tensor, camera: torchdof.Camera, guess: Numbers, known: Collection[str]
) -> Numbers:
    """Optimises the numbers of a guess until the rendering matches the picture.

    Args:
        image: ``[1, 3, H, W]``, all in focus, linear light.
        blurred: ``[1, 3, H, W]``, the picture.
        disparity: ``[1, 1, H, W]``, from 0 to 1, larger is nearer.
        camera: Focal length and sensor of the picture.
        guess: Starting values.
        known: Names of the numbers that are kept fixed.
    """
    logs = {name: torch.tensor(value).log() for name, value in guess.items()}
    free_logs = [logs[name].requires_grad_() for name in logs if name not in known]
    dof = torchdof.DepthOfField(camera, tolerance=2 / 255, check=False)
    for factor, steps, rate in STAGES:
        print(f"solving at 1/{factor} of the size", flush=True)
        image_level, target, map_ = (F.avg_pool2d(x, factor) for x in (image, blurred, disparity))
        target, margin = display(target), max(2, 24 // factor)  # light from outside the frame reaches its border
        optimizer = torch.optim.Adam(free_logs, lr=rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        for _ in range(steps):
            scale, shift, focus_m, f_number = (log.exp() for log in logs.values())
            picture = dof(image_level, 1 / (scale * map_ + shift), focus_m=focus_m, f_number=f_number)
            error = (display(picture) - target)[..., margin:-margin, margin:-margin].square().mean()
            optimizer.zero_grad()
            error.backward()
            optimizer.step()
            schedule.step()
    return {name: float(log.detach().exp()) for name, log in logs.items()}


def as_estimated(depth: Tensor) -> tuple[Tensor, float, float]:
    """Disparity as an estimator gives it, 0 to 1 in 8 bits, and its true scale and shift."""
    low, high = (1 / depth).aminmax()
    return (255 * (1 / depth - low) / (high - low)).round() / 255, float(high - low), float(low)


def run(scene: Scene, known: Collection[str], out: Path) -> None:
    """Solves one scene, prints guess, solution and truth, and writes pictures."""
    disparity, scale, shift = as_estimated(scene.depth)
    lens = {name: float(getattr(scene.camera, name)) for name in ("focus_m", "f_number")}
    true = {"scale": scale, "shift": shift, **lens}
    factors = zip(true, (0.6, 1.3, 0.8, 1.5), strict=True)
    guess = {name: true[name] * (1.0 if name in known else factor) for name, factor in factors}
    solution = solve(scene.image, scene.truth, disparity, scene.camera, guess, known)
    print(f"{scene.name}: {'nothing' if not known else ', '.join(known)} known")
    print("            scale   shift   focus m   f-number   mean error of the blur radius, px   of depth, %   PSNR, dB")
    pictures = {"all in focus": scene.image, "the picture": scene.truth}
    for name, numbers in (("guess", guess), ("found", solution), ("true", true)):
        camera = scene.camera.replace(**{name: numbers[name] for name in lens})
        depth = 1 / (numbers["scale"] * disparity + numbers["shift"]).clamp(min=1e-6)  # metres
        radius_error = (camera.coc_px(depth, depth.shape[-1]) - scene.coc_px).abs().mean()
        with torch.no_grad():
            picture = torchdof.depth_of_field(scene.image, depth, camera)
        psnr_db = psnr(display(picture), display(scene.truth), scene.inner)
        print(
            f"  {name:6s} {numbers['scale']:9.4f} {numbers['shift']:7.4f} {numbers['focus_m']:9.3f} "
            f"{numbers['f_number']:10.3f} "
            f"{float(radius_error):35.3f} {float(100 * (depth / scene.depth - 1).abs().mean()):13.2f} {psnr_db:10.2f}"
        )
        pictures[f"rendered: {name}"] = picture
    name = scene.name.replace("/", "_")
    write_sheet(out / f"{name}_scale.png", pictures)


def main() -> None:
    """Solve every setting of a scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "--scene", type=Path, required=True, help="folder with sharp.exr, depth.exr, truth_K.exr, meta.json"
    )
    parser.add_argument("--known", nargs="*", default=[], choices=("scale", "shift", "focus_m", "f_number"))
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # faster for pictures this small
    arguments.out.mkdir(parents=True, exist_ok=True)
    for scene in read_scenes(arguments.scene):
        run(scene, arguments.known, arguments.out)


if __name__ == "__main__":
    main()
