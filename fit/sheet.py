"""One sheet that shows a calibration from photographs: what was found, data, model, and a picture made with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch

from torchdof.optics.blur_table import BlurTable

from .photo.photographs import Photograph, Photographs
from .photo.table import TableFit
from .plots import DATA, MODEL, new_figure
from .result import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["sheet_of_photographs"]


def sheet_of_photographs(
    photographs: Photographs, result: TableFit, render: Callable[[torch.Tensor, torch.Tensor, BlurTable], torch.Tensor]
) -> Figure:
    """Draw the sheet.

    A row a distance: the target that was found, the window around its dot, its pixels over the distance from the centre
    with the model's line, the residual, and the kernel. Below, lights from near to far rendered with the table.

    Args:
        photographs: from `read_photographs`.
        result: from `fit_captures` of their captures.
        render: `render(image, coc_px, table)`, all as `torchdof.blur_by_coc` takes them.
    """
    captures = photographs.captures
    rows = len(captures)
    figure, axes = new_figure(12.5, 2.1 * rows + 2.6, 5, rows + 1)
    by_distance = {p.distance_m: p for p in photographs.pictures}
    for i, (pair, fit, coc) in enumerate(zip(captures, result.fits, result.coc_px, strict=True)):
        found, window, profile, residual, kernel = axes[i]
        picture = by_distance[pair.distance_m]
        _show(found, *_thumbnail(picture), f"{picture.file}, {pair.distance_m:.3f} m")
        _show(window, pair.blurred, [], "")
        profile.plot(*fit.samples, ".", color=DATA, markersize=1.5)
        bins = np.floor(fit.curve[0] * 2 + 0.5).astype(int)  # half a pixel wide
        count = np.bincount(bins)
        r, level = (np.bincount(bins, row)[count > 0] / count[count > 0] for row in fit.curve)
        profile.plot(r, level, color=MODEL)
        profile.set_title(f"{fit.family}, radius {fit.radius:.2f} ± {fit.radius_stderr:.2f} px", fontsize=8)
        residual.plot(fit.samples[0], fit.samples[1] - fit.curve[1], ".", color=DATA, markersize=1.5)
        residual.axhline(0, color=MODEL, linewidth=1)
        residual.set_title(f"residual {fit.residual_over_noise:.2f} x noise", fontsize=8)
        shape = result.table.kernels(torch.tensor([coc], dtype=torch.float64), captures.width_px)[0, 0]
        _show(kernel, shape.detach().numpy(), [], f"kernel at coc {coc:+.2f} px")
    for unused in axes[rows, 1:]:
        unused.remove()
    lights = _lights(render, result.table, captures.width_px, min(0.0, *result.coc_px), max(0.0, *result.coc_px))
    wide = figure.add_subplot(axes[rows, 0].get_gridspec()[rows, :])
    axes[rows, 0].remove()
    _show(
        wide,
        lights,
        [],
        "lights and edges from one end of the measured distances through the focus to the other, with this table",
    )
    return figure


def _show(axes: Axes, picture: Array, box: list[tuple[float, float]], title: str) -> None:
    top = max(float(picture.max()), 1e-12)
    axes.imshow(np.clip(picture / top, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
    if box:
        axes.plot(*zip(*box, strict=True), color=MODEL, linewidth=1)
    axes.set_title(title, fontsize=8)
    axes.set_axis_off()


def _thumbnail(picture: Photograph) -> tuple[Array, list[tuple[float, float]]]:
    """The photograph made small, and the corners of the square that was found in it."""
    step = max(1, picture.light.shape[1] // 300)
    rows, columns = (n // step for n in picture.light.shape)
    small = picture.light[: rows * step, : columns * step].reshape(rows, step, columns, step).mean((1, 3))
    target, half = picture.target, picture.target.side_px / 2
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]
    return small, [((target.x + i * half) / step, (target.y + j * half) / step) for i, j in corners]


def _lights(
    render: Callable[[torch.Tensor, torch.Tensor, BlurTable], torch.Tensor],
    table: BlurTable,
    width_px: int,
    low: float,
    high: float,
) -> Array:
    """A row of small lights over stripes, the circle of confusion going from one measured end to the other."""
    width, height = 720, 90
    scene = 0.15 + 0.1 * (np.arange(width) // 12 % 2) * np.ones((height, 1))
    scene[height // 2 - 1 : height // 2 + 1, 18::36] = 25.0
    coc = torch.linspace(low, high, width, dtype=torch.float32).expand(1, 1, height, width)
    # a table in mm of the sensor: seen through a part of the frame as wide as this picture
    scaled = coc * (width / width_px) if table.unit == "relative" else coc
    picture = torch.from_numpy(scene).float()[None, None]
    shown = render(picture, scaled, _through(table, width / width_px))
    return np.clip(shown[0, 0].numpy().astype(np.float64), 0, 1)


def _through(table: BlurTable, share: float) -> BlurTable:
    """The same lens seen through a share of the frame's width."""
    if table.unit != "mm" or table.sensor_width_mm is None:
        return table
    return table.replace(sensor_width_mm=table.sensor_width_mm * share)
