"""One figure that documents a calibration from photographs: targets, data, model, and a rendered example."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch

from torchdof.optics.blur_table import BlurTable

from .photo.photographs import Photographs
from .photo.table import TableFit
from .plots import DATA, MODEL, model_line, new_figure, show
from .result import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def sheet_of_photographs(
    photographs: Photographs, result: TableFit, render: Callable[[torch.Tensor, torch.Tensor, BlurTable], torch.Tensor]
) -> Figure:
    """Draws the figure.

    One row for each distance: the target found, the window around its dot, the window's pixels over the distance from
    the centre with the model, the residual, and the kernel. Below, rendered with the table: lights from near to far,
    and the window of the photograph in focus, blurred as at the most blurred distance.

    Args:
        photographs: from `read_photographs`.
        result: from `fit_captures` of the photographs' captures.
        render: `render(image, coc_px, table)`, with the arguments of `torchdof.blur_by_coc`.
    """
    captures = photographs.captures
    rows = len(captures)
    figure, axes = new_figure(12.5, 2.1 * rows + 2.6, 5, rows + 1)
    by_distance = {p.distance_m: p for p in photographs.pictures}
    for i, (pair, fit, coc) in enumerate(zip(captures, result.fits, result.coc_px, strict=True)):
        found, window, profile, residual, kernel = axes[i]
        picture = by_distance[pair.distance_m]
        step = max(1, picture.light.shape[1] // 300)
        height, width = (n // step for n in picture.light.shape)
        small = picture.light[: height * step, : width * step].reshape(height, step, width, step).mean((1, 3))
        target, half = picture.target, picture.target.side_px / 2
        around = [(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]
        corners = [((target.x + i * half) / step, (target.y + j * half) / step) for i, j in around]
        show(found, small, f"{picture.file}, {pair.distance_m:.3f} m", box=corners)
        show(window, pair.blurred, "")
        profile.plot(*fit.samples, ".", color=DATA, markersize=1.5)
        profile.plot(*model_line(fit), color=MODEL)
        profile.set_title(f"{fit.family}, radius {fit.radius:.2f} ± {fit.radius_stderr:.2f} px", fontsize=8)
        residual.plot(fit.samples[0], fit.samples[1] - fit.curve[1], ".", color=DATA, markersize=1.5)
        residual.axhline(0, color=MODEL, linewidth=1)
        residual.set_title(f"residual {fit.residual_over_noise:.2f} x noise", fontsize=8)
        shape = result.table.kernels(torch.tensor([coc], dtype=torch.float64), captures.width_px)[0, 0]
        show(kernel, shape.detach().numpy(), f"kernel at coc {coc:+.2f} px")
    for unused in axes[rows]:
        unused.remove()
    grid = axes[rows, 0].get_gridspec()
    (sharp,) = (p for p in photographs.pictures if p.file == captures.notes["sharp"])
    half = int(min(sharp.target.side_px / 4, 120))
    x, y = round(sharp.target.x), round(sharp.target.y)
    window = sharp.light[max(y - half, 0) : y + half, max(x - half, 0) : x + half]
    most, blurrest = max(zip(result.coc_px, captures, strict=True), key=lambda node: abs(node[0]))
    ends = min(0.0, *result.coc_px), max(0.0, *result.coc_px)
    scene = 0.15 + 0.1 * (np.arange(720) // 12 % 2) * np.ones((90, 1))  # small lights on stripes
    scene[44:46, 18::36] = 25.0
    lights = _rendered(render, scene, result.table, captures.width_px, *ends)
    photograph = _rendered(render, window, result.table, captures.width_px, most, most)
    text = "lights and edges from one end of the measured distances through the focus to the other, with this table"
    show(figure.add_subplot(grid[rows, :3]), lights, text)
    show(figure.add_subplot(grid[rows, 3]), window, f"{sharp.file}, in focus")
    show(figure.add_subplot(grid[rows, 4]), photograph, f"with this table, as at {blurrest.distance_m:.3f} m")
    return figure


def _rendered(
    render: Callable[[torch.Tensor, torch.Tensor, BlurTable], torch.Tensor],
    scene: Array,
    table: BlurTable,
    width_px: int,
    left: float,
    right: float,
) -> Array:
    """Renders a part `[H, W]` of a frame `width_px` wide, with a circle of confusion from `left` to `right` px."""
    coc = torch.linspace(left, right, scene.shape[1], dtype=torch.float32).expand(1, 1, *scene.shape)
    if table.unit == "mm" and table.sensor_width_mm is not None:  # the part has its own share of the sensor
        table = table.replace(sensor_width_mm=table.sensor_width_mm * scene.shape[1] / width_px)
    shown = render(torch.from_numpy(scene).float()[None, None], coc, table)
    return np.clip(shown[0, 0].numpy().astype(np.float64), 0, 1)
