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
import dataclasses
from collections.abc import Collection
from pathlib import Path

import torch
import torch.nn.functional as F
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from torch import Tensor

import torchdof
from torchdof.io.sheet import write_sheet
from torchdof.reference.metrics import display, psnr
from torchdof.reference.scenes import Scene, read_scenes

# Downsampling factor, steps, learning rate. Coarse stages come first: far from the solution, detail misleads.
STAGES = ((4, 60, 0.08), (2, 40, 0.04), (1, 25, 0.02))


@dataclasses.dataclass(frozen=True)
class Numbers:
    """Numbers of the lens and of the depth: ``1 / depth = scale * disparity + shift``."""

    scale: float
    shift: float
    focus_m: float
    f_number: float

    def depth(self, disparity: Tensor) -> Tensor:
        """Metres, ``[1, 1, H, W]``."""
        return 1 / (self.scale * disparity + self.shift).clamp(min=1e-6)


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
    logs = {name: torch.tensor(value).log() for name, value in dataclasses.asdict(guess).items()}
    free_logs = [logs[name].requires_grad_() for name in logs if name not in known]
    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), transient=True) as progress:
        task = progress.add_task("solving", total=sum(steps for _, steps, _ in STAGES))
        for factor, steps, rate in STAGES:
            image_level, target, map_ = (F.avg_pool2d(x, factor) for x in (image, blurred, disparity))
            target, margin = display(target), max(2, 24 // factor)  # light from outside the frame reaches its border
            dof = torchdof.DepthOfField(camera, tolerance=2 / 255, check=False)
            optimizer = torch.optim.Adam(free_logs, lr=rate)
            schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
            for _ in range(steps):
                numbers = {name: log.exp() for name, log in logs.items()}
                depth = 1 / (numbers["scale"] * map_ + numbers["shift"])
                picture = dof(image_level, depth, focus_m=numbers["focus_m"], f_number=numbers["f_number"])
                error = (display(picture) - target)[..., margin:-margin, margin:-margin].square().mean()
                optimizer.zero_grad()
                error.backward()
                optimizer.step()
                schedule.step()
                progress.advance(task)
    return Numbers(**{name: float(log.detach().exp()) for name, log in logs.items()})


def as_estimated(depth: Tensor) -> tuple[Tensor, float, float]:
    """Disparity as an estimator gives it, 0 to 1 in 8 bits, and its true scale and shift."""
    low, high = (1 / depth).aminmax()
    return (255 * (1 / depth - low) / (high - low)).round() / 255, float(high - low), float(low)


def run(scene: Scene, known: Collection[str], out: Path) -> None:
    """Solves one scene, prints guess, solution and truth, and writes pictures."""
    disparity, scale, shift = as_estimated(scene.depth)
    true = Numbers(scale, shift, float(scene.camera.focus_m), float(scene.camera.f_number))
    guess = Numbers(0.6 * scale, 1.3 * shift, 0.8 * true.focus_m, 1.5 * true.f_number)
    guess = dataclasses.replace(guess, **{name: getattr(true, name) for name in known})
    solution = solve(scene.image, scene.truth, disparity, scene.camera, guess, known)
    print(f"{scene.name}: {'nothing' if not known else ', '.join(known)} known")
    print("            scale   shift   focus m   f-number   mean error of the blur radius, px   of depth, %   PSNR, dB")
    pictures = {"all in focus": scene.image, "the picture": scene.truth}
    for name, numbers in (("guess", guess), ("found", solution), ("true", true)):
        camera = scene.camera.replace(focus_m=numbers.focus_m, f_number=numbers.f_number)
        depth = numbers.depth(disparity)
        radius_error = (camera.coc_px(depth, depth.shape[-1]) - scene.coc_px).abs().mean()
        with torch.no_grad():
            picture = torchdof.depth_of_field(scene.image, depth, camera)
        psnr_db = psnr(display(picture), display(scene.truth), scene.inner)
        print(
            f"  {name:6s} {numbers.scale:9.4f} {numbers.shift:7.4f} {numbers.focus_m:9.3f} {numbers.f_number:10.3f} "
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
    parser.add_argument("--known", nargs="*", default=[], choices=[f.name for f in dataclasses.fields(Numbers)])
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # faster for pictures this small
    arguments.out.mkdir(parents=True, exist_ok=True)
    for scene in read_scenes(arguments.scene):
        run(scene, arguments.known, arguments.out)


if __name__ == "__main__":
    main()
