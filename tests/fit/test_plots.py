"""Pictures of fits and tables."""

import numpy as np
import pytest
import torch

from torchdof import BlurTable
from torchdof.fit import BlurFit, FitError, fit_pair, fit_profile
from torchdof.fit.plots import picture_of_fit, picture_of_table


def drawn(figure, tmp_path):
    figure.savefig(tmp_path / "a.png")
    assert float(np.asarray(figure.canvas.buffer_rgba())[..., :3].std()) > 5
    return figure.axes


def test_figure_2_shows_samples_and_curve(simulator, tmp_path):
    r = np.linspace(0, 6e-3, 60)
    (axes,) = drawn(picture_of_fit(fit_profile(r, 0.58 * np.exp(-((r - 4e-4) ** 2) / 1.1e-5)), unit="m"), tmp_path)
    assert [len(line.get_xdata()) for line in axes.get_lines()] == [60, 257]
    assert axes.get_xlabel() == "r [m]" and "sigma" in axes.get_title()
    forward = fit_pair(*simulator.Simulator(size=61).pair("gaussian", {"sigma": 3.0}), "gaussian")
    (axes,) = drawn(picture_of_fit(forward), tmp_path)
    assert [line.get_label() for line in axes.get_lines()] == ["pixels", "forward model", "kernel f(r), scaled"]
    bare = BlurFit("gaussian", {"sigma": 1.0}, {"sigma": 0.1}, 0.0, 0.0, np.eye(1), ("sigma",), "profile")
    with pytest.raises(FitError, match="no samples"):
        picture_of_fit(bare)


@pytest.mark.parametrize(
    "table",
    [
        BlurTable.load("sato_j15"),
        BlurTable("gaussian", [-0.1, 0.2], {"sigma": [0.05, 0.1]}, unit="mm", sensor_width_mm=36.0),
        BlurTable("radial", [-0.1, 0.2], {"values": [[1.0, 0.5], [1.0, 0.8]], "radius": [0.1, 0.2]}, unit="fraction"),
        BlurTable("gaussian", [0.2], {"sigma": torch.tensor([[0.05], [0.1], [0.07]])}),
    ],
)
def test_the_picture_of_a_table_has_a_line_through_the_nodes_of_every_parameter(table, tmp_path):
    panels = drawn(picture_of_table(table), tmp_path)
    assert len(panels) == len(table.node_params)
    if "sigma" in table.node_params:
        line = panels[list(table.node_params).index("sigma")].get_lines()[0]
        found = np.interp(table.coc, line.get_xdata(), line.get_ydata())
        np.testing.assert_allclose(found, table.node_params["sigma"][0], rtol=1e-2)
