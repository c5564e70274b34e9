"""Tables from captures at several distances, and the kernels between their nodes."""

import numpy as np
import pytest
import torch

from tests.kernels import kernel_of
from torchdof import BlurTable, Camera
from torchdof.fit import Capture, Captures, FitWarning, fit_captures, fit_table, natural_psnr

WIDTH = 1200
CAMERA = Camera(focal_length_mm=50.0, f_number=3.5, focus_m=1.0, sensor_width_mm=36.0)
KNOWN = {"focal_length_mm": 50.0, "f_number": 3.5, "sensor_width_mm": 36.0}
DISTANCES = [0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.5, 2.0, 4.0]


def cocs(distances):
    depth = torch.tensor(distances, dtype=torch.float64)[None, None, None]
    return CAMERA.coc_px(depth, width=WIDTH).flatten().tolist()


def lens(coc):
    """Parameters of the simulated lens's blur at a signed CoC in px: edge softness and rim brightness depend on it."""
    a = abs(coc)
    return {"radius": 1.05 * a, "sigma": 0.3 + 0.04 * a, "b": 0.4 + 0.01 * coc, "m": 3.0 + 0.02 * coc}


def captured(simulator, distances, snr_db=40.0, seed=0, known=True, family="softm", params=lens, exposure=1.0):
    pairs = []
    for i, (distance, coc) in enumerate(zip(distances, cocs(distances), strict=True)):
        m = 1.0 / distance
        size = 2 * int(1.3 * (12.0 * max(m, 1.0) + 1.4 * abs(coc)) + 14) + 1
        pictures = simulator.Simulator(size=size, magnification=m, snr_db=snr_db).pair(family, params(coc), seed + i)
        pairs.append(Capture(*pictures, distance, files=("sharp.png", f"{distance}.png"), exposure=exposure))
    return Captures(tuple(pairs), focus_m=1.0, width_px=WIDTH, name="simulated", **(KNOWN if known else {}))


def psnr_between_nodes(table, places):
    kernels = table.kernels(torch.tensor(places, dtype=torch.float64), WIDTH)[:, 0]
    true = [kernel_of("softm", *lens(coc).values()) for coc in places]
    return np.array([natural_psnr(found, kernel) for found, kernel in zip(kernels, true, strict=True)])


@pytest.fixture(scope="module")
def nine(simulator):
    return fit_captures(captured(simulator, DISTANCES, seed=50), "softm")


def test_nodes_are_at_the_camera_s_signed_cocs_and_survive_saving(nine, tmp_path):
    nine.table.save(tmp_path / "a.json")
    table = BlurTable.load(tmp_path / "a.json")
    np.testing.assert_allclose(table.coc.numpy(), np.array(cocs(DISTANCES)) * 36.0 / WIDTH, rtol=1e-9)
    assert table.unit == "mm" and nine.scale == "camera" and len(table.residual) == 9
    assert table.provenance["coc_from"] == "camera" and table.provenance["distances_m"] == DISTANCES
    torch.testing.assert_close(table.node_params["radius"], nine.table.node_params["radius"])


def test_kernels_between_the_nodes_equal_the_lens_s(nine):
    reached = psnr_between_nodes(nine.table, [c for c in np.linspace(-8, 9, 50) if abs(c) > 1.2])
    assert reached.min() > 55 and np.median(reached) > 62


@pytest.mark.parametrize(
    ("family", "distances", "snr_db", "places", "least"),
    [
        ("softm", [0.7, 1.5], None, cocs([0.7, 1.5]), 80),  # exact at the nodes without noise
        ("radial", [0.7, 0.8], 50, [-5.0, -4.0], 50),  # a free profile fits any round lens
    ],
)
def test_a_sufficient_family_recovers_the_lens(simulator, family, distances, snr_db, places, least):
    table = fit_table(captured(simulator, distances, snr_db=snr_db), family)
    assert table.family == family and psnr_between_nodes(table, places).min() > least


def test_the_scale_is_measured_if_the_camera_is_unknown(simulator):
    unknown = captured(simulator, [0.7, 1.5], known=False, family="disc", params=lambda coc: {"radius": abs(coc)})
    result = fit_captures(unknown, "disc")
    assert result.scale == "measured" and result.table.unit == "fraction"
    np.testing.assert_allclose(result.coc_px, cocs([0.7, 1.5]), rtol=5e-3)
    np.testing.assert_allclose(result.table.node_params["radius"][0], result.table.coc.abs(), rtol=1e-2)


def test_one_distance_makes_a_table_with_a_warning(simulator):
    with pytest.warns(FitWarning, match="one distance was measured") as caught:
        table = fit_table(captured(simulator, [0.7]), "softm")
    warning = caught[0].message
    assert (warning.kind, warning.file) == ("single distance", "0.7.png") and len(table.coc) == 1
    kernels = table.kernels(torch.tensor([-2.0, 2.0]), WIDTH)
    torch.testing.assert_close(kernels[0], kernels[1])


def test_auto_chooses_one_family_reports_progress_and_warns_of_a_wrong_exposure(simulator):
    steps, captures = [], captured(simulator, [0.7, 1.5], exposure=0.5)
    with pytest.warns(FitWarning, match=r"(1.9|2.0). times as bright as the exposures say") as caught:
        result = fit_captures(captures, accuracy_db=60, progress=lambda *step: steps.append(step[:2]))
    assert result.table.family == "softm" and "60 dB" in result.why
    assert steps == [(i, 4) for i in (1, 2, 3, 4)]
    assert {w.message.kind for w in caught} == {"exposure"}


def test_trial_fits_of_other_families_do_not_warn(simulator):
    pair = simulator.Simulator(size=71, misfocus=1.4).pair("disc", {"radius": 6.0})
    captures = Captures((Capture(*pair, 2.0),), focus_m=1.0, width_px=WIDTH)
    _, found = simulator.result_and_warnings(lambda: fit_captures(captures))
    assert [w.kind for w in found].count("not in focus") == 1


@pytest.mark.filterwarnings("ignore:.*one distance was measured:torchdof.fit.problems.FitWarning")
def test_standard_errors_include_the_uncertainty_of_the_pictures(simulator):
    camera = simulator.Simulator(size=61, dot_radius=8.0, magnification=0.5)
    sharp, blurred = camera.pair("disc", {"radius": 5.0}, 1)
    guess = camera.pair("disc", {"radius": 5.2}, 1)
    plain, uncertain = (
        fit_captures(Captures((Capture(sharp, blurred, 2.0, uncertain=others),), 1.0, WIDTH), "disc")
        for others in ((), (guess,))
    )
    (fit,) = uncertain.fits
    assert fit.radius == plain.fits[0].radius and fit.radius_stderr == pytest.approx(0.2, rel=0.1)
    assert fit.stderr["radius"] == pytest.approx(np.sqrt(fit.covariance[0, 0]), rel=1e-6)
