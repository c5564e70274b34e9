"""Figures of a fit, and a sheet that documents a calibration, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from .photo.profile_fit import evaluate
from .problems import FitError
from .result import Array, BlurFit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from .photo.photographs import Photographs
    from .photo.table import TableFit

_DATA, _MODEL = "#7a7a7a", "#c2410c"


def picture_of_fit(fit: BlurFit, unit: str = "px", title: str = "") -> Figure:
    """Samples (pixels, or blur strengths) with the fitted curve, as in the paper's Fig. 2; lengths are in `unit`."""
    if not fit.samples.shape[1]:
        raise FitError("this fit carries no samples to draw")
    figure, axes = _new_figure(5.4, 3.6)
    forward = fit.model == "forward"
    axes.plot(*fit.samples, ".", color=_DATA, markersize=3, label="pixels" if forward else "samples")
    if forward:
        r, level = _model_line(fit)
        axes.plot(r, level, color=_MODEL, label="forward model", zorder=3)
        if fit.aperture is None:  # kernels that are not round have no profile
            radii = np.linspace(0, fit.samples[0].max(), 400)
            profile = evaluate(fit.family, radii, fit.kernel_params())
            axes.plot(radii, profile / profile.max() * level.max(), "--", color="#1d4ed8", label="kernel f(r), scaled")
    else:
        axes.plot(*fit.curve, color=_MODEL, label=f"fitted {fit.family}", zorder=3)
    axes.set(xlabel=f"r [{unit}]", ylabel="level above background" if forward else "blur strength", ylim=(0, None))
    values = ", ".join(f"{k} = {v:.4g} ± {fit.stderr[k]:.1g}" for k, v in fit.params.items() if not np.ndim(v))
    axes.set_title(title or f"{fit.family}: {values}", fontsize=9)
    axes.legend(frameon=False, fontsize=8)
    return figure


def _model_line(fit: BlurFit) -> tuple[Array, Array]:
    """Radii, and the mean level of a forward fit's model at these radii, in steps of half a unit."""
    bins = np.floor(fit.curve[0] * 2 + 0.5).astype(int)
    count = np.bincount(bins)
    r, level = (np.bincount(bins, row)[count > 0] / count[count > 0] for row in fit.curve)
    return r, level


def sheet_of_photographs(photographs: Photographs, result: TableFit, blur: Callable[..., torch.Tensor]) -> Figure:
    """Draws each distance's target, dot, fit, residual and kernel; and lights, by `blur`: `torchdof.blur_by_coc`."""
    captures, table = photographs.captures, result.table
    rows, by_distance = len(captures.pairs), {p.distance_m: p for p in photographs.pictures}
    figure, axes = _new_figure(12.5, 2.1 * rows + 2.6, 5, rows + 1)
    for panels, pair, fit, coc in zip(axes, captures.pairs, result.fits, result.coc_px, strict=False):
        photograph_axes, window, profile, residual, kernel = panels
        picture = by_distance[pair.distance_m]
        target, half, step = picture.target, picture.target.side_px / 2, max(1, picture.light.shape[1] // 300)
        _show(photograph_axes, picture.light[::step, ::step], f"{picture.file}, {pair.distance_m:.3f} m")
        x, y = np.array([[-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1]]) * half + [[target.x], [target.y]]
        photograph_axes.plot(x / step, y / step, color=_MODEL, linewidth=1)
        _show(window, pair.blurred, "")
        profile.plot(*fit.samples, ".", color=_DATA, markersize=1.5)
        profile.plot(*_model_line(fit), color=_MODEL)
        profile.set_title(f"{fit.family}, radius {fit.radius:.2f} ± {fit.radius_stderr:.2f} px", fontsize=8)
        residual.plot(fit.samples[0], fit.samples[1] - fit.curve[1], ".", color=_DATA, markersize=1.5)
        residual.axhline(0, color=_MODEL, linewidth=1)
        residual.set_title(f"residual {fit.residual_over_noise:.2f} x noise", fontsize=8)
        kernels = table.kernels(torch.tensor([coc], dtype=torch.float64), captures.width_px)
        _show(kernel, kernels[0, 0].detach().numpy(), f"kernel at coc {coc:+.2f} px")
    for unused in axes[rows]:
        unused.remove()
    scene = 0.15 + 0.1 * (np.arange(720) // 12 % 2) * np.ones((90, 1))  # small lights on stripes
    scene[44:46, 18::36] = 25.0
    coc_px = torch.linspace(min(0.0, *result.coc_px), max(0.0, *result.coc_px), 720).expand(1, 1, 90, 720)
    if table.sensor_width_mm is not None:  # the scene has its own share of the sensor
        table = table.replace(sensor_width_mm=table.sensor_width_mm * scene.shape[1] / captures.width_px)
    lights = blur(torch.from_numpy(scene).float()[None, None], coc_px, table=table)[0, 0].double().numpy()
    caption = "lights and edges from one end of the measured distances through the focus to the other, with this table"
    _show(figure.add_subplot(axes[rows, 0].get_gridspec()[rows, :]), np.clip(lights, 0, 1), caption)
    return figure


def _show(axes: Axes, picture: Array, title: str) -> None:
    """Draws a picture `[H, W]` in linear light, encoded for display."""
    white = max(float(picture.max()), 1e-12)
    axes.imshow(np.clip(picture / white, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
    axes.set_title(title, fontsize=8)
    axes.set_axis_off()


def _new_figure(width: float, height: float, columns: int = 1, rows: int = 1) -> tuple[Figure, Any]:
    """A figure with a size in inches, and its axes in columns and rows."""
    # not pyplot, which would choose a display and keep every figure in memory
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns)
