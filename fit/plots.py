"""The paper's figures for any fit and table, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchdof.optics.blur_table import BlurTable
from torchdof.optics.psf import LENGTHS

from .photo.profile_fit import evaluate
from .problems import FitError
from .result import Array, BlurFit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


DATA, MODEL = "#7a7a7a", "#c2410c"


def picture_of_fit(fit: BlurFit, unit: str = "px", title: str = "") -> Figure:
    """Samples with the fitted curve (the paper's Fig. 2); lengths are labelled with `unit`.

    For a forward fit, the samples are the blurred dot's pixels and the curve is their model, together with the kernel's
    own profile; for a profile fit, the samples are blur strengths.

    Raises:
        FitError: the fit has no samples.
    """
    if not fit.samples.shape[1]:
        raise FitError("this fit carries no samples to draw")
    figure, axes = new_figure(5.4, 3.6)
    forward = fit.model == "forward"
    axes.plot(*fit.samples, ".", color=DATA, markersize=2.5 if forward else 4, label="pixels" if forward else "samples")
    if forward:
        r, level = model_line(fit)
        axes.plot(r, level, color=MODEL, label="forward model", zorder=3)
        if fit.aperture is None:  # kernels that are not round have no profile
            line = np.linspace(0, fit.samples[0].max(), 400)
            shape = evaluate(fit.family, line, fit.kernel_params())
            scaled = shape / shape.max() * level.max()
            axes.plot(line, scaled, "--", color="#1d4ed8", label="kernel f(r), scaled", zorder=2)
    else:
        axes.plot(*fit.curve, color=MODEL, label=f"fitted {fit.family}", zorder=3)
    axes.set(xlabel=f"r [{unit}]", ylabel="level above background" if forward else "blur strength", ylim=(0, None))
    values = ", ".join(f"{k} = {v:.4g} ± {fit.stderr[k]:.1g}" for k, v in fit.params.items() if not np.ndim(v))
    axes.set_title(title or f"{fit.family}: {values}", fontsize=9)
    axes.legend(frameon=False, fontsize=8)
    return figure


def model_line(fit: BlurFit) -> tuple[Array, Array]:
    """Radii, and the mean level of a forward fit's model at these radii, in steps of half a unit."""
    bins = np.floor(fit.curve[0] * 2 + 0.5).astype(int)
    count = np.bincount(bins)
    r, level = (np.bincount(bins, row)[count > 0] / count[count > 0] for row in fit.curve)
    return r, level


def picture_of_texture(table: BlurTable, coc_px: float, width: int, title: str = "") -> Figure:
    """The blur texture at a signed circle of confusion, for an image `width` px wide (the paper's Fig. 3)."""
    texture = table.blur_texture(coc_px, width).detach().numpy()
    figure, axes = new_figure(4.2, 3.6)
    half = texture.shape[-1] / 2
    colours = np.moveaxis(texture, 0, -1) / texture.max() if texture.shape[0] == 3 else texture[0]
    shown = axes.imshow(colours, cmap="gray", vmin=0, extent=(-half, half, half, -half))
    if texture.shape[0] != 3:
        figure.colorbar(shown, ax=axes, label="blur strength")
    axes.set(xlabel="px", ylabel="px")
    axes.set_title(title or f"blur texture, coc {coc_px:+.1f} px", fontsize=9)
    return figure


def picture_of_quad(sharp: Array, blurred: Array, title: str = "") -> Figure:
    """A quad in focus and out of focus `[H, W]`, linear light, and their middle rows (the paper's Fig. 4)."""
    figure, (left, right, below) = new_figure(9.6, 3.4, 3)
    white = float(sharp.max())
    show(left, sharp, "in focus", white=white)
    show(right, blurred, "out of focus", white=white)
    row = sharp.shape[0] // 2
    below.plot(sharp[row], color=DATA, label="in focus")
    below.plot(blurred[row], color=MODEL, label="out of focus")
    below.set(xlabel="px", ylabel="linear light, middle row")
    below.legend(frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=10)
    return figure


def picture_of_table(table: BlurTable, title: str = "") -> Figure:
    """A table over depth: every parameter at its nodes, and the table's interpolation between them."""
    names = list(table.node_params)
    figure, axes = new_figure(3.2 * len(names), 3.2, len(names))
    reach = float(table.coc.abs().max())
    width = 1 if table.sensor_width_mm is None else int(table.sensor_width_mm) or 1
    scale = 1.0 if table.unit != "mm" else width / float(table.sensor_width_mm or 1.0)
    line = torch.linspace(-reach, reach, 401, dtype=torch.float64)
    between = table.params(line * scale, width)
    unit = {"mm": "mm", "fraction": "of the width", "relative": "relative"}[table.unit]
    for ax, name in zip(np.atleast_1d(axes), names, strict=True):
        nodes = table.node_params[name]
        if name == "values":
            picture = between[name][0].T.numpy()
            ax.imshow(
                picture / np.maximum(picture.max(axis=0), 1e-12), aspect="auto", origin="lower", cmap="magma",
                extent=(-reach, reach, 0, 1),
            )  # fmt: skip
            ax.set(ylabel="r / radius", title="profile, each over its peak")
        else:
            per = scale if name in LENGTHS else 1.0
            for channel in range(nodes.shape[0]):
                colour = MODEL if nodes.shape[0] == 1 else ("#dc2626", "#16a34a", "#2563eb")[channel % 3]
                ax.plot(line, between[name][channel] / per, color=colour, linewidth=1)
                ax.plot(table.coc, nodes[channel], "o", color=colour, markersize=3)
            ax.set(ylabel=name + (f" [{unit}]" if name in LENGTHS else ""))
        ax.set(xlabel=f"signed coc [{unit}]")
    figure.suptitle(title or f"{table.name or 'table'} ({table.family})", fontsize=10)
    return figure


def show(
    axes: Axes, picture: Array, title: str, *, white: float | None = None, box: Sequence[tuple[float, float]] = ()
) -> None:
    """Draws a picture `[H, W]` in linear light, encoded for display, and a line through the corners of a box."""
    white = max(float(picture.max()) if white is None else white, 1e-12)
    axes.imshow(np.clip(picture / white, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
    if box:
        axes.plot(*zip(*box, strict=True), color=MODEL, linewidth=1)
    axes.set_title(title, fontsize=8)
    axes.set_axis_off()


def new_figure(width: float, height: float, columns: int = 1, rows: int = 1) -> tuple[Figure, Any]:
    """A figure with a size in inches, and its axes in columns and rows."""
    # not pyplot, which would choose a display and keep every figure in memory
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns)
