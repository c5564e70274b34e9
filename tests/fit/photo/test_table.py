"""From captures at several distances to a table, and from the table to the picture."""

import warnings

import numpy as np
import pytest
import torch

from torchdof import BlurTable, Camera, DepthOfField
from torchdof.fit import Capture, Captures, fit_captures, fit_table, natural_psnr
from torchdof.fit import problems as p
from torchdof.fit.photo.scale import signed_coc
from torchdof.optics import psf

WIDTH = 1200
CAMERA = Camera(focal_length_mm=50.0, f_number=3.5, focus_m=1.0, sensor_width_mm=36.0)
KNOWN = {"focal_length_mm": 50.0, "f_number": 3.5, "sensor_width_mm": 36.0}
DISTANCES = [0.6, 0.7, 0.8, 0.9, 1.1, 1.25, 1.5, 2.0, 4.0]


def lens(coc):
    """What the simulated lens does at a signed coc in px: the blur's edge softens and its rim brightens with it."""
    a = abs(coc)
    return {"radius": 1.05 * a, "sigma": 0.3 + 0.04 * a, "b": 0.4 + 0.01 * coc, "m": 3.0 + 0.02 * coc}


def captured(simulator, distances, snr_db=40.0, seed=0, known=True, family="softm", params=lens, dot_radius=12.0):
    pairs = []
    for i, distance in enumerate(distances):
        coc, m = signed_coc(CAMERA, distance, WIDTH), 1.0 / distance
        size = 2 * int(1.3 * (dot_radius * max(m, 1.0) + 1.4 * abs(coc)) + 14) + 1
        camera = simulator.Simulator(size=size, dot_radius=dot_radius, magnification=m, snr_db=snr_db)
        sharp, blurred = camera.pair(family, params(coc), seed + i)
        pairs.append(Capture(sharp, blurred, distance, files=("sharp.png", f"{distance}.png"), exposure=1.0))
    return Captures(tuple(pairs), focus_m=1.0, width_px=WIDTH, name="simulated", **(KNOWN if known else {}))


def psnr_between_nodes(table, cocs):
    reached = []
    for coc in cocs:
        found = table.kernels(torch.tensor([coc], dtype=torch.float64), WIDTH)[0, 0]
        true = psf.softm(**{k: torch.tensor(v, dtype=torch.float64) for k, v in lens(coc).items()})
        reached.append(natural_psnr(found, true))
    return np.array(reached)


@pytest.fixture(scope="module")
def nine(simulator):
    return fit_captures(captured(simulator, DISTANCES), "softm")


def test_the_table_is_keyed_by_the_camera_s_signed_coc(nine):
    expected = [signed_coc(CAMERA, d, WIDTH) * 36.0 / WIDTH for d in DISTANCES]
    np.testing.assert_allclose(nine.table.coc.numpy(), expected, rtol=1e-9)
    assert nine.table.unit == "mm" and nine.scale == "camera"
    assert nine.table.residual is not None and len(nine.table.residual) == 9


def test_kernels_between_the_nodes_are_the_lens_s(nine):
    cocs = [c for c in np.linspace(-8, 9, 50) if abs(c) > 1.2]
    reached = psnr_between_nodes(nine.table, cocs)
    assert reached.min() > 55 and np.median(reached) > 62


def test_neighbours_that_inform_each_other_keep_to_one_branch(simulator):
    distances = [0.7, 0.8, 0.9]
    cocs = np.linspace(-5, -1.5, 20)
    rough, smooth = (
        psnr_between_nodes(fit_table(captured(simulator, distances, seed=51), "softm", smooth=s), cocs)
        for s in (False, True)
    )
    assert smooth.min() > 50 and smooth.min() > rough.min() + 5


def test_noise_free_captures_are_exact_at_the_nodes(simulator):
    captures = captured(simulator, [0.7, 1.5], snr_db=None)
    table = fit_table(captures, "softm")
    assert psnr_between_nodes(table, [signed_coc(CAMERA, d, WIDTH) for d in (0.7, 1.5)]).min() > 80


def test_a_free_profile_needs_no_family(simulator):
    table = fit_table(captured(simulator, [0.7, 0.8, 1.25, 1.5], snr_db=50), "radial")
    assert table.family == "radial"
    assert psnr_between_nodes(table, [-5.0, -4.0, 3.0, 4.0]).min() > 50


def test_the_scale_is_measured_where_the_camera_is_not_known(simulator):
    def disc(coc):
        return {"radius": abs(coc)}

    result = fit_captures(captured(simulator, [0.7, 1.5], known=False, family="disc", params=disc), "disc")
    assert result.scale == "measured" and result.table.unit == "fraction"
    np.testing.assert_allclose(result.coc_px, [signed_coc(CAMERA, d, WIDTH) for d in (0.7, 1.5)], rtol=5e-3)
    np.testing.assert_allclose(result.table.node_params["radius"][0], result.table.coc.abs(), rtol=1e-2)


def test_one_distance_makes_a_table_and_says_so(simulator):
    captures = captured(simulator, [0.7])
    with pytest.warns(p.SingleDistanceWarning, match="one distance was measured") as caught:
        table = fit_table(captures, "softm")
    assert caught[0].message.number == 0.7 and caught[0].message.file == "0.7.png"
    assert len(table.coc) == 1
    kernels = table.kernels(torch.tensor([-2.0, 2.0]), WIDTH)
    torch.testing.assert_close(kernels[0], kernels[1])


def test_auto_takes_one_family_for_all_and_tells_its_progress(simulator):
    steps = []
    result = fit_captures(
        captured(simulator, [0.7, 1.5]), accuracy_db=60, progress=lambda done, total, what: steps.append((done, total))
    )
    assert result.table.family == "softm" and "60 dB" in result.why
    assert steps == [(i, 4) for i in (1, 2, 3, 4)]
    assert result.table.provenance["distances_m"] == [0.7, 1.5] and result.table.provenance["focus_m"] == 1.0


def test_fits_that_only_tell_the_family_say_nothing(simulator):
    pair = simulator.Simulator(size=71, misfocus=1.4).pair("disc", {"radius": 6.0})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        fit_captures(Captures((Capture(*pair, 2.0),), focus_m=1.0, width_px=WIDTH))
    assert [type(w.message) for w in caught].count(p.NotInFocusWarning) == 1


def test_a_gain_against_the_exposures_warns(simulator):
    captures = captured(simulator, [0.7, 1.5])
    wrong = Captures(
        tuple(Capture(c.sharp, c.blurred, c.distance_m, c.files, None, 0.5) for c in captures), 1.0, WIDTH, **KNOWN
    )
    with pytest.warns(p.ExposureWarning, match="times as bright as the exposures say") as caught:
        fit_table(wrong, "softm")
    assert caught[0].message.number == pytest.approx(2.0, rel=0.02)


def test_anything_but_captures_is_refused():
    with pytest.raises(p.FitError, match="captures must be a Captures"):
        fit_table([(1, 2, 3)])


def test_the_table_survives_its_file(nine, tmp_path):
    nine.table.save(tmp_path / "a.json")
    loaded = BlurTable.load(tmp_path / "a.json")
    torch.testing.assert_close(loaded.node_params["radius"], nine.table.node_params["radius"])
    assert loaded.provenance["coc_from"] == "camera"


def test_a_scene_rendered_with_the_fitted_table_is_the_lens_s_picture(nine):
    """Fit, table, render: at least 45 dB against the same scene rendered with the true point spread functions."""
    nodes = np.linspace(-9, 10, 77)
    nodes = nodes[np.abs(nodes) > 0.2]
    true = BlurTable(
        "softm",
        nodes / WIDTH,
        {
            k: [v / WIDTH if k in ("radius", "sigma") else v for v in (lens(c)[k] for c in nodes)]
            for k in ("radius", "sigma", "b", "m")
        },
        unit="fraction",
    )
    rng = torch.Generator().manual_seed(0)
    width, height = 200, 120
    # the same camera seen through a crop: the coc keeps its pixels
    camera = CAMERA.replace(sensor_width_mm=36.0 * width / WIDTH)
    scaled = [
        BlurTable(
            t.family,
            (t.coc * (WIDTH / width if t.unit == "fraction" else 1.0)).tolist(),
            {
                k: (v[0] * (WIDTH / width if t.unit == "fraction" and k in ("radius", "sigma") else 1.0)).tolist()
                for k, v in t.node_params.items()
            },
            unit=t.unit,
            sensor_width_mm=None if t.unit == "fraction" else 36.0 * width / WIDTH,
        )
        for t in (nine.table, true)
    ]
    image = torch.rand(1, 3, height // 4, width // 4, generator=rng)
    image = torch.nn.functional.interpolate(image, scale_factor=4, mode="nearest")
    x = torch.linspace(0, 1, width).expand(1, 1, height, width)
    depth = 1 / (1 / 0.65 + (1 / 3.0 - 1 / 0.65) * x)
    pictures = [DepthOfField(camera, t, tolerance=1e-3)(image, depth) for t in scaled]
    error = float(((pictures[0] - pictures[1]) ** 2).mean())
    assert -10 * np.log10(error) > 45
    untouched = float(((image - pictures[1]) ** 2).mean())
    assert -10 * np.log10(untouched) < 30


@pytest.mark.filterwarnings("ignore::torchdof.fit.problems.SingleDistanceWarning")
def test_standard_errors_count_what_was_guessed_about_the_pictures(simulator):
    camera = simulator.Simulator(size=61, dot_radius=8.0, magnification=0.5)
    sharp, blurred = camera.pair("disc", {"radius": 5.0}, 1)
    guess = camera.pair("disc", {"radius": 5.2}, 1)
    plain, wary = (
        fit_captures(Captures((Capture(sharp, blurred, 2.0, uncertain=others),), 1.0, WIDTH), "disc", smooth=False)
        for others in ((), (guess,))
    )
    assert wary.fits[0].radius == plain.fits[0].radius and wary.fits[0].radius_stderr == pytest.approx(0.2, rel=0.1)
    assert wary.fits[0].stderr["radius"] == pytest.approx(np.sqrt(wary.fits[0].covariance[0, 0]), rel=1e-6)
