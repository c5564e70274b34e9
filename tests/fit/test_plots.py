"""The paper's figures."""

import numpy as np
import pytest
import torch

from torchdof import BlurTable
from torchdof.fit import fit_pair, fit_profile
from torchdof.fit.plots import picture_of_fit, picture_of_quad, picture_of_table, picture_of_texture
from torchdof.fit.problems import FitError
from torchdof.fit.result import BlurFit


def drawn(figure, tmp_path):
    figure.savefig(tmp_path / "a.png")
    pixels = np.asarray(figure.canvas.buffer_rgba())
    return float(pixels[..., :3].std())


def test_figure_2_shows_samples_and_curve(tmp_path):
    r = np.linspace(0, 6e-3, 60)
    figure = picture_of_fit(fit_profile(r, 0.58 * np.exp(-((r - 4e-4) ** 2) / 1.1e-5)), unit="m")
    lines = figure.axes[0].get_lines()
    assert len(lines) == 2 and len(lines[0].get_xdata()) == 60
    assert figure.axes[0].get_xlabel() == "r [m]" and "sigma" in figure.axes[0].get_title()
    assert drawn(figure, tmp_path) > 5


def test_a_forward_fit_shows_its_pixels_its_model_and_its_kernel(simulator, tmp_path):
    figure = picture_of_fit(fit_pair(*simulator.Simulator().pair("gaussian", {"sigma": 3.0}), "gaussian"))
    assert [line.get_label() for line in figure.axes[0].get_lines()] == [
        "pixels",
        "forward model",
        "kernel f(r), scaled",
    ]
    assert drawn(figure, tmp_path) > 5


def test_figure_3_is_the_blur_texture(tmp_path):
    table = BlurTable.load("sato_j15")
    figure = picture_of_texture(table, 12.0, 512)
    np.testing.assert_allclose(figure.axes[0].images[0].get_array(), table.blur_texture(12.0, 512)[0])
    assert drawn(figure, tmp_path) > 5


def test_figure_4_shows_both_quads_and_their_middle_row(tmp_path):
    sharp = np.zeros((40, 60))
    sharp[10:30, 20:40] = 1
    figure = picture_of_quad(sharp, 0.5 * sharp)
    np.testing.assert_array_equal(figure.axes[2].get_lines()[1].get_ydata(), 0.5 * sharp[20])
    assert drawn(figure, tmp_path) > 5


@pytest.mark.parametrize(
    "table",
    [
        BlurTable.load("sato_j15"),
        BlurTable("gaussian", [-0.1, 0.2], {"sigma": [0.05, 0.1]}, unit="mm", sensor_width_mm=36.0),
        BlurTable("radial", [-0.1, 0.2], {"values": [[1.0, 0.5], [1.0, 0.8]], "radius": [0.1, 0.2]}, unit="fraction"),
        BlurTable("gaussian", [0.2], {"sigma": torch.tensor([[0.05], [0.1], [0.07]])}),
    ],
)
def test_a_table_shows_every_parameter(table, tmp_path):
    figure = picture_of_table(table)
    assert len(figure.axes) == len(table.node_params)
    assert drawn(figure, tmp_path) > 5


def test_a_table_s_lines_pass_through_its_nodes():
    table = BlurTable("gaussian", [-0.1, 0.2], {"sigma": [0.05, 0.1]}, unit="mm", sensor_width_mm=36.0)
    line = picture_of_table(table).axes[0].get_lines()[0]
    assert np.interp(0.2, line.get_xdata(), line.get_ydata()) == pytest.approx(0.1)
    assert np.interp(-0.1, line.get_xdata(), line.get_ydata()) == pytest.approx(0.05)


def test_a_fit_without_samples_is_refused():
    bare = BlurFit("gaussian", {"sigma": 1.0}, {"sigma": 0.1}, 0.0, 0.0, np.eye(1), ("sigma",), 0.0, 9, "profile")
    with pytest.raises(FitError, match="no samples"):
        picture_of_fit(bare)
