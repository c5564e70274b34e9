"""Pictures of fits."""

import numpy as np
import pytest

from torchdof.fit import BlurFit, FitError, fit_pair, fit_profile
from torchdof.fit.plots import picture_of_fit


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
