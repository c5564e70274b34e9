"""The figures of Sato, Dobashi and Yamamoto (J-15), from their Table 1 and from a simulated capture.

Usage: python examples/paper.py --out out

1. The shipped table ``sato_j15``: its curve, its blur texture, a blurred quad. The paper publishes Table 1, but not the
   samples to which it was fitted. So this fit uses samples of the table's own curve: it tests that the fit inverts
   eq. (1), and does not test a camera.
2. The paper's experiment, with a lens prescription instead of the camera. A white dot on black paper is in focus at
   0.20 m, and photographed there and at 0.50 m, with noise. The files are read and fitted twice, by the paper's ratio
   and by the forward model. Both fits are compared with the traced spot; the second one is made a table and rendered.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

try:
    from matplotlib.figure import Figure
except ModuleNotFoundError:
    raise SystemExit("paper.py draws with matplotlib; run: pip install '.[fit,plot]'") from None

import torchdof
from torchdof.fit import BlurFit, blur_strength, fit_captures, fit_pair, fit_profile, natural_psnr, read_captures
from torchdof.fit.lens.lens import Lens
from torchdof.fit.lens.spot import Spot, focus_sensor, point_spread
from torchdof.fit.plots import picture_of_fit
from torchdof.io.images import Picture, write_image
from torchdof.optics.psf import pixel_kernels, profile, support
from torchdof.reference.metrics import psnr

FOCUS_M, PAPER_M = 0.20, 0.50  # distances of the dot in focus and out of focus
WIDTH, HEIGHT, SENSOR_MM = 480, 360, 9.0  # the middle of a 36 mm sensor of 1920 pixels
DOT_RADIUS_MM, F_NUMBER = 1.5, 16.0
NOISE, WHITE = 0.003, 0.8


def main() -> None:
    """Draw all figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the pictures")
    parser.add_argument("--lens", default="double_gauss_50mm", help="prescription: a file or the name of a shipped one")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    draw_table_1(arguments.out)
    draw_experiment(arguments.out, Lens.read(arguments.lens).with_f_number(F_NUMBER))


def draw_table_1(out: Path) -> None:
    """Figures 2 to 4 from the numbers of Table 1."""
    table = torchdof.BlurTable.load("sato_j15")
    sigma, r_c = (float(table.node_params[k][0, 0]) for k in ("sigma", "r_c"))
    strength = 0.0 if table.strength is None else float(table.strength[0])
    r = np.linspace(0, 8e-3, 81)
    fit = fit_profile(r, strength * np.exp(-((r - r_c) ** 2) / (2 * sigma**2)))
    picture_of_fit(fit, unit="m on the paper", title="eq. (1) with Table 1").savefig(out / "sato_fig2.png")
    width, field_m = 512, 0.2  # a quad of 80 mm at 0.50 m in a field of 200 mm
    coc_px = float(table.coc[0]) / field_m * width
    draw_texture(table, coc_px, width, out / "sato_fig3.png")
    sharp = quad(width, width, 0.08 / field_m * width)
    blurred = torchdof.blur_by_coc(sharp, torch.full_like(sharp, coc_px), table=table)
    draw_quads(sharp, blurred, table, out / "sato_fig4.png")
    print("Table 1, refitted from samples of its own curve (the paper's are not published), proves the fit only:")
    params = ", ".join(f"{name} = {value:.5g}{'' if name == 'N' else ' m'}" for name, value in fit.params.items())
    print(f"  sato_j15: {params}")


def draw_experiment(out: Path, lens: Lens) -> None:
    """The paper's experiment, all the way to Fig. 4."""
    folder = out / "capture"
    spot = photograph(folder, lens)
    (captures,) = read_captures(folder)
    (pair,) = captures.pairs

    ratio = fit_pair(pair.sharp, pair.blurred, model="ratio")
    picture_of_fit(ratio, title="the paper's ratio, eq. (1)").savefig(out / "traced_fig2_ratio.png")
    print(f"the paper's ratio, which measures the dot and the kernel together:\n{ratio.summary()}")
    print(f"  from {blur_strength(pair.sharp, pair.blurred)[0].size} samples along 36 spokes")

    result = fit_captures(captures, command="examples/paper.py")
    (forward,) = result.fits
    picture_of_fit(forward).savefig(out / "traced_fig2_forward.png")
    print(f"the forward model, which measures the kernel:\n{forward.summary()}")

    compare(spot, ratio, forward)

    table = result.table
    table.save(out / "traced.json")
    (coc_px,) = result.coc_px
    draw_texture(table, coc_px, WIDTH, out / "traced_fig3.png")

    camera = torchdof.Camera(
        focal_length_mm=lens.paraxial().focal_length, f_number=F_NUMBER, focus_m=FOCUS_M, sensor_width_mm=SENSOR_MM
    )
    dof = torchdof.DepthOfField(camera, table, occlusion=False)
    sharp = quad(WIDTH, HEIGHT, 150)
    blurred = dof(sharp, torch.full_like(sharp, PAPER_M))
    draw_quads(sharp, blurred, table, out / "traced_fig4.png")
    truth = torch.from_numpy(blur(sharp[0, 0].numpy(), spot))[None, None]
    print(f"quad against the traced spot itself: {psnr(*(t[..., 60:-60, 60:-60] for t in (blurred, truth))):.1f} dB")


def compare(spot: Spot, ratio: BlurFit, forward: BlurFit) -> None:
    """Prints the errors of both fits against the traced spot: size of the blur, and PSNR of a blurred natural image."""
    true = kernel_of(spot)
    print("against the truth, the traced spot:")
    for name, fit in (("ratio", ratio), ("forward", forward)):
        shape = {k: torch.as_tensor(v, dtype=torch.float64) for k, v in fit.kernel_params().items()}
        kernel = pixel_kernels(fit.family, shape).numpy()
        percent = 100 * (rms_radius(kernel) / rms_radius(true) - 1)
        size, db = f"rms radius {rms_radius(kernel):.3f} px, {percent:+.1f} %", natural_psnr(kernel, true)
        print(f"  {name:8s} {size}; {db:.1f} dB on a natural image")


def rms_radius(kernel: np.ndarray) -> float:
    """Root mean square distance from the centre, px."""
    offset = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    return float(np.sqrt((kernel * (offset[:, None] ** 2 + offset**2)).sum() / kernel.sum()))


def photograph(folder: Path, lens: Lens) -> Spot:
    """Writes two photographs of the dot and their capture.toml; returns the traced spot at ``PAPER_M``."""
    folder.mkdir(parents=True, exist_ok=True)
    sensor = focus_sensor(lens, FOCUS_M)
    focal = lens.paraxial().focal_length
    image_mm = FOCUS_M * focal / (FOCUS_M - focal / 1000)  # image distance
    rng = np.random.default_rng(15)
    for distance in (FOCUS_M, PAPER_M):
        spot = point_spread(lens, distance, sensor, rays=200_000)
        radius_px = DOT_RADIUS_MM * image_mm / (1000 * distance) * WIDTH / SENSOR_MM
        light = WHITE * blur(disc(radius_px), spot) + 0.02
        pixels = torch.from_numpy(light + rng.normal(0, NOISE, light.shape)).float()
        write_image(folder / f"{1000 * distance:.0f}mm.png", Picture(pixels.expand(1, 3, -1, -1)), "srgb", "16")
    (folder / "capture.toml").write_text(
        f'focus_m = {FOCUS_M}\nsharp = "{1000 * FOCUS_M:.0f}mm.png"\nfocal_length_mm = {focal:.4f}\n'
        f'transfer = "srgb"\nf_number = {F_NUMBER}\nsensor_width_mm = {SENSOR_MM}\nname = "{lens.name} at 0.20 m"\n'
        f'[[shot]]\nfile = "{1000 * PAPER_M:.0f}mm.png"\ndistance_m = {PAPER_M}\n',
        encoding="utf-8",
    )
    return spot


def blur(picture: np.ndarray, spot: Spot) -> np.ndarray:
    """The picture convolved with the traced spot."""
    from scipy.signal import fftconvolve

    return np.asarray(fftconvolve(picture, kernel_of(spot), mode="same"))


def kernel_of(spot: Spot) -> np.ndarray:
    """Share of a spot's rays in each pixel of a square that contains the spot."""
    scale = WIDTH / SENSOR_MM
    half = int(np.ceil(spot.radius * scale)) + 1
    edges = np.arange(-half, half + 2) - 0.5
    kernel, _, _ = np.histogram2d(spot.y * scale, spot.x * scale, bins=(edges, edges), weights=spot.weight)
    return np.asarray(kernel / kernel.sum())


def disc(radius_px: float, samples: int = 8) -> np.ndarray:
    """The white dot in the middle of the frame."""
    y, x = ((np.arange(n * samples) + 0.5) / samples - n / 2 for n in (HEIGHT, WIDTH))
    inside = np.hypot(y[:, None], x[None, :]) <= radius_px
    return np.asarray(inside.reshape(HEIGHT, samples, WIDTH, samples).mean((1, 3)))


def quad(width: int, height: int, side: float) -> torch.Tensor:
    """A white quad in the middle of a black frame, ``[1, 1, height, width]``."""
    picture = torch.zeros(1, 1, height, width)
    top, left = round((height - side) / 2), round((width - side) / 2)
    picture[..., top : height - top, left : width - left] = 1.0
    return picture


def draw_texture(table: torchdof.BlurTable, coc_px: float, width: int, file: Path) -> None:
    """Fig. 3: the blur texture at a signed circle of confusion, for an image `width` px wide."""
    params = table.params(torch.tensor(coc_px), width)
    half = int(np.ceil(support(table.family, params)))
    offset = torch.arange(-half, half + 1, dtype=torch.float64)
    r = torch.hypot(offset[:, None], offset)
    strength = 1.0 if table.strength is None else float(table.strength[0])
    texture = strength * profile(table.family, r.flatten(), params)[0].reshape(r.shape)
    figure = Figure(figsize=(4.2, 3.6), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(texture.numpy(), cmap="gray", vmin=0)
    figure.colorbar(image, ax=axes, label="blur strength")
    axes.set_title(f"blur texture, coc {coc_px:+.1f} px", fontsize=9)
    figure.savefig(file)


def draw_quads(sharp: torch.Tensor, blurred: torch.Tensor, table: torchdof.BlurTable, file: Path) -> None:
    """Fig. 4: a quad in focus and out of focus, linear light, and their middle rows."""
    figure = Figure(figsize=(9.6, 3.4), layout="constrained")
    *pictures, below = figure.subplots(1, 3)
    for axes, light, name in zip(pictures, (sharp, blurred), ("in focus", "out of focus"), strict=True):
        picture = light[0, 0].numpy()
        axes.imshow(picture.clip(0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
        axes.set_title(name, fontsize=8)
        axes.set_axis_off()
        below.plot(picture[len(picture) // 2], label=name)
    below.set(xlabel="px", ylabel="linear light, middle row")
    below.legend(frameon=False, fontsize=8)
    figure.suptitle(f"a quad at {PAPER_M} m, focus at {FOCUS_M} m: {table.name}", fontsize=10)
    figure.savefig(file)


if __name__ == "__main__":
    main()
