"""Blur that is not round: shapes of the simulator are recognized and stored in tables."""

import numpy as np
import pytest
import torch
from scipy.ndimage import center_of_mass, shift

from torchdof import BlurTable
from torchdof.fit import Capture, Captures, FitError, fit_captures, fit_pair, highlight_psnr, natural_psnr
from torchdof.optics.aperture import Aperture
from torchdof.optics.psf import pixel_kernels


def kernel_of(fit):
    family = fit.family if fit.aperture is None else "disc"
    return pixel_kernels(family, fit.kernel_params(), None, fit.aperture).numpy()


def centred(kernel):
    """A kernel with its centre of mass in the centre; its place is the fit's `shift`, not part of the shape."""
    y, x = center_of_mass(kernel)
    moved = np.maximum(shift(kernel, (kernel.shape[0] // 2 - y, kernel.shape[0] // 2 - x), order=3), 0.0)
    return moved / moved.sum()


def size_of(kernel):
    rows, columns = np.indices(kernel.shape)
    y, x = center_of_mass(kernel)
    return np.sqrt(2 * float((kernel * ((rows - y) ** 2 + (columns - x) ** 2)).sum()))


def captured(simulator, kind, radius):
    """A pair of pictures and their true kernel."""
    kernel = simulator.shape(kind, radius)
    return simulator.Simulator(size=65, dot_radius=8.0).pair(kernel, {}), kernel


NEEDED = [("hexagon", "polygon", 60, 22), ("cat's eye", "image", 48, 15), ("coma", "image", 47, 16)]


@pytest.mark.parametrize(
    ("kind", "family", "natural", "look"), [*NEEDED, pytest.param("mirror", "ring", 48, 13, marks=pytest.mark.sweep)]
)
def test_auto_chooses_the_family_that_a_shape_needs(simulator, kind, family, natural, look):
    pair, kernel = captured(simulator, kind, 7.5)
    fit = fit_pair(*pair)
    assert fit.family == family and (fit.aperture is None) == (family == "ring")
    assert abs(fit.radius / size_of(kernel) - 1) < 0.02
    found, true = centred(kernel_of(fit)), centred(kernel)
    assert natural_psnr(found, true) > natural and highlight_psnr(found, true) > look
    assert fit.residual_over_noise < 1.2 and ("round" in fit.why) == (family != "ring")
    if family == "polygon":
        assert fit.aperture.blades == 6 and fit.params["curvature"] < 0.3 and fit.stderr["rotation_deg"] < 3
        # the simulator's corner is 11 degrees clockwise from the right, the aperture's counter-clockwise from the top
        assert abs((fit.params["rotation_deg"] + 90 + 11 + 30) % 60 - 30) < 3


def test_a_disc_is_not_fitted_as_a_polygon_or_an_image(simulator):
    for seed in range(2):
        pair = simulator.Simulator(size=61, dot_radius=8.0, bayer=seed == 1).pair("disc", {"radius": 7.0}, seed)
        assert fit_pair(*pair).family == "disc"


def test_of_a_known_aperture_only_the_size_is_fitted(simulator):
    pair, kernel = captured(simulator, "hexagon", 5.0)
    fit = fit_pair(*pair, "image", aperture=Aperture(6, 19.0))
    assert list(fit.params) == ["radius"] and fit.params["radius"] == pytest.approx(5.0, rel=0.01)
    assert fit.radius == pytest.approx(size_of(kernel), rel=0.01)
    with pytest.raises(FitError, match="goes with family='image'"):
        fit_pair(*pair, "disc", aperture=Aperture(6))


def test_a_table_rotates_the_aperture_by_180_degrees_in_front_of_the_focus(simulator, tmp_path):
    pairs, kernels = [], []
    for distance, radius in ((0.8, 5.5), (1.4, 5.5)):
        kernel = simulator.shape("coma", radius)
        kernels.append(kernel if distance > 1 else kernel[::-1, ::-1])
        camera = simulator.Simulator(size=61, dot_radius=6.0, magnification=1 / distance)
        pairs.append(Capture(*camera.pair(kernels[-1], {}, int(100 * distance)), distance))
    result = fit_captures(Captures(tuple(pairs), focus_m=1.0, width_px=1000))
    assert result.table.aperture.mask is not None and "image, for" in result.why
    result.table.save(tmp_path / "coma.json")
    assert (tmp_path / "coma.json").stat().st_size < 1e5
    table = BlurTable.load(tmp_path / "coma.json")
    shown = table.kernels(torch.tensor(result.coc_px, dtype=torch.float64), 1000)[:, 0].numpy()
    for kernel, true, other in zip(shown, kernels, kernels[::-1], strict=True):
        look = highlight_psnr(centred(kernel), centred(true))
        assert look > 15 and look > highlight_psnr(centred(kernel), centred(other)) + 4
