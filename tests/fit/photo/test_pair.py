"""The forward model on simulated captures: recovered parameters, standard errors, warnings and errors."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.stats import norm
from threadpoolctl import threadpool_info, threadpool_limits

from tests.fit.simulator import Simulator
from torchdof.fit import FitError, FitWarning, fit_pair, natural_psnr
from torchdof.fit.photo.diagnostics import asymmetry_of, check_fit, describe
from torchdof.fit.photo.pair import prepared_pair
from torchdof.optics.psf import pixel_kernels

STARS = Path(__file__).parents[2] / "data" / "defocused_stars"
GAUSSIAN, DISC, RING = {"sigma": 4.0}, {"radius": 6.0}, {"sigma": 4.0, "r_c": 1.5}
HELD = {"fit_magnification": False}
SOFTM = {"radius": 8.0, "sigma": 1.0, "b": 1.0, "m": 4.0}


def off(fit, name, true):
    return abs(fit.params[name] / true - 1)


# camera, family, its parameters, options of the fit, number of captures, largest relative error of one and of the mean
RECOVERED = [
    *(({}, "gaussian", {"sigma": s}, {}, 1, most, most) for s, most in [(0.5, 0.03), (1.0, 0.01), (2.0, 0.01)]),
    *(({"snr_db": 30, "size": 101}, "gaussian", {"sigma": s}, {}, 1, 0.02, 0.02) for s in (2.0, 8.0)),
    *(({"snr_db": 46, **harm}, "gaussian", {"sigma": 4.0}, {}, 2, 0.02, 0.005)
      for harm in ({"shift": (1.3, -1.6)}, {"full_well": 20_000.0})),
    *(({"snr_db": 46, **harm}, "gaussian", {"sigma": 2.0}, {}, 2, 0.02, 0.005)
      for harm in ({"exposure": 0.6, "offset": 0.05}, {"magnification": 1.05}, {"edge_sigma": 0.7})),
    ({"snr_db": 53.5}, "ring", RING, {}, 1, 0.05, 0.05),
    # the softness of demosaicing does not scale with the dot; scaling it would give an error of 0.13
    ({"size": 61, "dot_radius": 9.0, "bayer": True}, "disc", {"radius": 2.0}, {"magnification": 0.4}, 1, 0.03, 0.03),
    ({"size": 61, "dot_radius": 4.5, "bayer": True}, "disc", {"radius": 2.0}, {"magnification": 2.0}, 1, 0.03, 0.03),
]  # fmt: skip


@pytest.mark.parametrize(("camera", "family", "params", "options", "captures", "each", "mean"), RECOVERED)
def test_the_fit_recovers_the_blur(simulator, camera, family, params, options, captures, each, mean):
    camera = simulator.Simulator(**{"size": 75, "magnification": options.get("magnification", 1.0), **camera})
    fits = [fit_pair(*camera.pair(family, params, seed), family, **options) for seed in range(captures)]
    for name, true in params.items():
        found = np.array([fit.params[name] for fit in fits]) / true - 1
        assert np.abs(found).max() < each and abs(found.mean()) < mean, (name, found)
    for fit in fits:
        assert (fit.gain, *fit.shift) == pytest.approx((camera.exposure, *camera.shift), rel=0.02, abs=0.1)
        assert fit.background == pytest.approx(camera.offset, abs=3e-3)
        assert fit.magnification == pytest.approx(camera.magnification, rel=0.01)
        assert f"{name} = " in fit.summary() and "x the noise" in fit.summary()


@pytest.mark.filterwarnings("ignore::torchdof.fit.problems.FitWarning")  # without noise every misfit is significant
@pytest.mark.parametrize(("sigma", "most"), [(0.8, 0.025), (1.3, 0.01), (2.6, 0.003)])
def test_the_blur_is_that_of_the_light_without_the_width_of_a_pixel(sigma, most):
    fine = 8  # samples a pixel, each way
    axis = (np.arange(51 * fine) + 0.5) / fine - 25.5
    light = np.clip((6.0 - np.hypot(axis[:, None], axis)) * fine + 0.5, 0.0, 1.0)
    pictures = (light, gaussian_filter(light, sigma * fine))
    sharp, blurred = (picture.reshape(51, fine, 51, fine).mean((1, 3)) for picture in pictures)
    assert off(fit_pair(sharp, blurred, "gaussian"), "sigma", sigma) < most  # with the pixel's width: 6.7, 2.5, 0.6 %
    # the radius is that of the light too, and not that of the non-negative kernel: 1.07
    pair = Simulator(size=41, dot_radius=8.0, snr_db=60).pair("disc", {"radius": 0.9})
    assert off(fit_pair(*pair, "disc", **HELD), "radius", 0.9) < 0.01
    line = np.diff(norm.cdf(np.arange(-20.5, 21.0), scale=sigma))  # a star's light on each pixel
    assert off(fit_pair(None, line[:, None] * line, "gaussian"), "sigma", sigma) < 0.01


@pytest.mark.parametrize(
    ("camera", "family", "true", "options", "draws", "spread"),
    [
        pytest.param(
            {"size": 45},
            "gaussian",
            {"sigma": 3.0},
            {"fit_magnification": True},
            12,
            (0.75, 1.3),
            marks=pytest.mark.sweep,
        ),
        # the noise of the dot's picture passes through the kernel: 1.3 to 2 times too small without it
        ({"size": 41}, "gaussian", {"sigma": 0.8}, {"source": "image", **HELD}, 24, (0.75, 1.3)),
        pytest.param({"size": 55}, "ring", RING, HELD, 8, (0.5, 1.5), marks=pytest.mark.sweep),
        # demosaiced: 2.0 to 2.3 times too small where pixels count as independent
        ({"size": 61, "bayer": True}, "disc", {"radius": 5.0}, HELD, 10, (0.7, 1.4)),
        pytest.param(
            {"size": 61, "snr_db": 10.0}, "gaussian", {"sigma": 2.0}, {}, 6, (0.5, 1.5), marks=pytest.mark.sweep
        ),
        ({"size": 21, "dot_radius": 3.0}, "gaussian", {"sigma": 1.0}, {}, 6, (0.5, 1.5)),
        ({"size": 61, "clip": 0.9, "snr_db": 30.0}, "gaussian", {"sigma": 2.0}, {}, 6, (0.5, 1.5)),
    ],
)
@pytest.mark.filterwarnings("ignore:.*clipped:torchdof.fit.problems.FitWarning")
def test_standard_errors_hold_in_repeated_captures(simulator, camera, family, true, options, draws, spread):
    camera = simulator.Simulator(**{"dot_radius": 8.0, **camera})
    fits = [fit_pair(*camera.pair(family, true, 100 + seed), family, **options) for seed in range(draws)]
    for name, value in true.items():
        pulls = np.array([(fit.params[name] - value) / fit.stderr[name] for fit in fits])
        assert spread[0] < pulls.std() < spread[1] and abs(pulls.mean()) < 0.6 and np.abs(pulls).max() < 3.5
    assert 0.8 < np.mean([fit.residual_over_noise for fit in fits]) < 1.2


def test_auto_does_not_fit_a_disc_to_a_ring(simulator):
    # photographs differ by 45 dB only, but highlights look different
    fit = fit_pair(*simulator.Simulator(size=81).pair("ring", {"sigma": 3.0, "r_c": 4.0}))
    assert fit.family == "ring" and "against ring, the likeliest" in fit.why


def test_radial_fits_a_profile_that_no_other_family_can(simulator):
    true = {"values": np.array([1.0, 0.2, 0.1, 0.1, 0.3, 1.0, 0.9, 0.2, 0.0]), "radius": 12.0}
    fit = fit_pair(*simulator.Simulator(snr_db=60, dot_radius=4.0, size=81).pair("radial", true), accuracy_db=65)
    assert fit.family == "radial" and "against radial, the likeliest" in fit.why
    found, truth = ({k: torch.as_tensor(v).double() for k, v in params.items()} for params in (fit.params, true))
    assert natural_psnr(pixel_kernels("radial", found), pixel_kernels("radial", truth)) > 60
    assert np.all(fit.params["values"] >= 0) and np.all(fit.stderr["values"] >= 0)


@pytest.mark.parametrize(("name", "asymmetric"), [("0885", False), ("0888", False), ("0422", True)])
def test_photographed_stars_are_rings_and_an_uneven_one_gives_a_warning(simulator, name, asymmetric):
    (file,) = STARS.glob(f"*{name}*.npy")
    star = np.load(file, allow_pickle=False)
    ring, found = simulator.result_and_warnings(lambda: fit_pair(None, star, "ring", files=(None, file.name)))
    kinds = {warning.kind: warning for warning in found}
    assert "residual" in kinds and all(file.name in str(warning) for warning in found)
    if asymmetric:
        assert "not round: 2" in str(kinds["asymmetry"])
    else:
        assert ring.residual < 0.14 and ring.asymmetry < 0.15
        assert simulator.result_and_warnings(lambda: fit_pair(None, star, "gaussian"))[0].residual > 0.25


JPEG = {"level": 0.8, "size": 91, "jpeg": 90, "black": 0.02}
CUT_OFF = {"bits": 16, "snr_db": 45, "level": 0.8}
TONE = {"tone": 0.5, "level": 0.8, "black": 0.03}
CHEAP = {"family": "auto", "accuracy_db": 30}
G3, G4, D6 = ("gaussian", {"sigma": 3.0}), ("gaussian", GAUSSIAN), ("disc", DISC)
R34 = ("ring", {"sigma": 3.0, "r_c": 4.0})
# camera, kernel, seed, options of the fit, kinds of warnings (None: "not linear" or "residual"), words
WARNED = [
    *(
        ({"srgb": True, "level": 0.7, **noise}, ("gaussian", {"sigma": s}), 1, {}, None, "linear|sRGB")
        for noise, s in (({"snr_db": None}, 1.0), ({"snr_db": 40.0}, 4.0), ({"snr_db": 60.0, "full_well": 5e3}, 1.0))
    ),
    ({"clip": 0.9}, G4, 0, {}, {"saturated"}, "pixels of the .* picture are"),
    ({"clip": 0.9, "snr_db": None}, G4, 0, {"white": 0.9}, {"saturated"}, "clipped at 0.9"),
    (CUT_OFF, D6, 0, {}, {"saturated"}, "51 % of the paper lies on its lowest level, 0"),
    ({"misfocus": 1.4}, G4, 0, {}, {"not in focus"}, "1.4 px, as out of focus; the dot was fitted as"),
    (TONE, G3, 0, {}, {"not linear"}, "a tone curve"),
    ({**TONE, "bayer": True, "size": 91}, G3, 1, {}, None, "linear|tone curve"),  # behind a soft edge
    # 4 % of the radius; compression hides what the curve does to the noise. A Gaussian takes half of the curve up
    ({"tone": 0.2, **JPEG, "bayer": True}, D6, 2, HELD, {"not linear"}, "depends on the level, as with"),
    ({"tone": 0.2, **JPEG}, G3, 1, HELD, {"not linear"}, "depends on the level, as with"),
    ({"tone": 0.2, **JPEG}, R34, 101, {}, {"not linear"}, "at the expected size of the dot"),
    ({"tone": 0.2, **JPEG}, G3, 101, {}, {"not linear"}, "at the expected size of the dot"),
    ({"size": 61}, ("gaussian", {"sigma": 9.5}), 0, {}, {"window"}, "outside the window of 61x61 px"),
    ({"magnification": 1.15}, ("gaussian", {"sigma": 2.0}), 0, {}, {"magnification"}, "1.15. times the size"),
    ({"snr_db": 60}, D6, 0, {"family": "gaussian"}, None, "Family 'gaussian' may be too simple"),
    ({"snr_db": 60}, ("softm", SOFTM), 0, CHEAP, {"residual"}, "would not be seen at accuracy_db"),
]


@pytest.mark.parametrize(("camera", "kernel", "seed", "options", "kinds", "words"), WARNED)
def test_faults_of_a_capture_give_warnings(simulator, camera, kernel, seed, options, kinds, words):
    options = {"family": kernel[0], "files": ("a.png", "b.png"), **options}
    pair = simulator.Simulator(**{"size": 81, **camera}).pair(*kernel, seed)
    fit, found = simulator.result_and_warnings(lambda: fit_pair(*pair, **options))
    assert {w.kind for w in found} == kinds or (kinds is None and {"not linear", "residual"} & {w.kind for w in found})
    assert any(re.search(words, str(w)) for w in found) and {w.file for w in found} <= set(options["files"])
    if kinds in ({"saturated"}, {"not in focus"}):  # faults that do not change the fitted blur
        assert off(fit, *next(iter(kernel[1].items()))) < 0.02
        assert len({w.file for w in found}) == 1 + (kinds == {"saturated"})
    if options["family"] == "auto":
        assert fit.family == "gaussian" and "the cheapest with 30 dB" in fit.why and "softm, the likeliest" in fit.why


SMALL = {"dot_radius": 9.0, "level": 0.8}
# captures without faults, or with negligible ones: camera, kernel, seeds of the colours whose mean is fitted, white
SILENT = [
    ({"snr_db": None}, G3, [0], None),
    ({"level": 0.7, "full_well": 3000.0, "snr_db": 50}, G3, [0], None),
    ({"level": 0.7, "bits": 8, "snr_db": 60, "black": 0.02}, G3, [0], None),
    # the one of twelve seeds in which ten pixels have the highest level of the JPEG
    ({"level": 0.7, "jpeg": 90, "black": 0.02, "size": 91}, D6, [3], None),
    ({"edge_sigma": 0.9}, ("gaussian", {"sigma": 6.0}), [0], None),
    ({**JPEG, "magnification": 1.02}, R34, [101], None),  # focus breathing must not look like a tone curve
    # blacks that are not clipped
    ({**SMALL, "bits": 16, "snr_db": 46, "black": 0.01}, D6, [0], None),
    ({**SMALL, "bits": 6, "snr_db": None}, D6, [0], None),
    ({**SMALL, "bits": 8, "snr_db": 46, "black": 0.012}, D6, [0], None),
    *(  # rounding hides the background's noise: with and without the dot's; then the dot's noise only
        ({**SMALL, "bits": 8, **harm}, D6, colours, 1.0)
        for harm in ({"level": 0.75, "snr_db": 63}, {"snr_db": 60}, {"level": 0.75, "snr_db": 66, "black": 0.5 / 255})
        for colours in ([0], [0, 1, 2])
    ),
]


@pytest.mark.parametrize(("camera", "kernel", "seeds", "white"), SILENT)
def test_a_capture_without_faults_gives_no_warning(simulator, camera, kernel, seeds, white):
    pair = np.mean([simulator.Simulator(**{"size": 81, **camera}).pair(*kernel, seed) for seed in seeds], axis=0)
    fit = fit_pair(*pair, kernel[0], white=white)  # a warning is an error here
    assert fit.magnification == pytest.approx(camera.get("magnification", 1.0), abs=0.005)


@pytest.mark.parametrize(("cheap", "freest"), [(2.1, 1.7), (2.5, 1.95), (2.1, 1.0)])
def test_a_residual_of_twice_the_noise_gives_a_warning(simulator, cheap, freest):
    pair, _, _ = prepared_pair(*simulator.Simulator().pair("disc", DISC))
    solution = pair.solve("disc")
    chosen = replace(describe(solution, ""), residual=cheap * 0.0015, noise=0.0015)
    with pytest.warns(FitWarning, match=f"'disc' leaves {cheap} times the noise"):
        check_fit(solution, chosen, None, replace(chosen, family="radial", residual=freest * 0.0015))


def test_a_cat_s_eye_gives_a_warning_of_asymmetry_and_round_blur_does_not(simulator):
    # with noise only, the p-value of the statistic is uniform in 0..1
    chances = []
    for seed in range(12):
        camera = simulator.Simulator(size=45, dot_radius=6.0)
        pair, _, _ = prepared_pair(*camera.pair("disc", {"radius": 8.0}, seed))
        pair.fit_moves = ("dx", "dy")
        chances.append(asymmetry_of(pair.solve("disc"))[1])
    assert min(chances) > 1e-3 and 0.25 < np.mean(chances) < 0.75
    eye = simulator.Simulator(size=71, dot_radius=10.0).pair(simulator.shape("cat's eye", 8.0), {})
    fit, said = simulator.result_and_warnings(lambda: fit_pair(*eye, "disc"))
    (uneven,) = (w for w in said if w.kind == "asymmetry")
    assert fit.asymmetry > 0.03 and "family 'disc' cannot" in str(uneven)


NOISE, WIDE = np.random.default_rng(0).normal(size=(101, 101)), Simulator().pair("gaussian", {"sigma": 14.0})[1]
REFUSED = [  # arguments of the wrong kind: test_arguments.py
    ({"blurred": np.ones((3, 61, 61))}, "argument", r"blurred must be an array of real numbers \[H, W\] of one colour"),
    ({"blurred": np.full((101, 101), np.nan)}, "not finite", "b.png: 10201 of 10201 values of blurred are NaN"),
    ({"blurred": np.zeros((81, 81))}, "argument", "same shape"),
    ({"white": -1.0}, "saturated", "100 % of the blurred dot's pixels are clipped at -1"),
    ({"model": "ratio", "sharp": None}, "argument", "divides by the sharp picture, got sharp=None"),
    ({"model": "ratio", "family": "polygon"}, "argument", "must be one of gaussian, ring, softm, got 'polygon'"),
    ({"sharp": NOISE, "blurred": NOISE}, "no dot", "b.png: no dot found: .* times the noise"),
    ({"sharp": 0 * NOISE + 0.3, "blurred": 0 * NOISE + 0.3}, "no dot", "no dot found"),
    (lambda s, b: {"sharp": np.hstack([s, s]), "blurred": np.hstack([b, b])}, "several dots", "2 dots where one"),
    (lambda s, b: {"sharp": s[:, 45:], "blurred": b[:, 45:]}, "window", "touches the picture's edge"),
    # a metre read as centimetres
    ({"magnification": 0.008, "family": "radial"}, "distance", "0.096 px here, too small to see"),
    (lambda s, _: {"sharp": s[20:-20, 20:-20], "blurred": WIDE[20:-20, 20:-20]}, "window", "6.* % of the blur lies o"),
]


@pytest.mark.parametrize(("change", "kind", "match"), REFUSED)
def test_impossible_fits_are_refused_by_name(simulator, change, kind, match):
    sharp, blurred = simulator.Simulator().pair("gaussian", {"sigma": 2.0})
    change = change(sharp, blurred) if callable(change) else change
    given = {"sharp": sharp, "blurred": blurred, "family": "gaussian", "files": ("a.png", "b.png"), **change}
    with pytest.raises(FitError, match=match) as caught:
        fit_pair(**given)
    assert caught.value.kind == kind


def test_a_fit_runs_on_one_thread_and_restores_their_number(simulator, monkeypatch):
    during = []

    def record(*given):
        during.extend(library["num_threads"] for library in threadpool_info())
        return describe(*given)

    monkeypatch.setattr("torchdof.fit.photo.pair.describe", record)
    with threadpool_limits(limits=2):
        fit_pair(*simulator.Simulator(size=61).pair("disc", {"radius": 4.0}), "disc")
        after = [library["num_threads"] for library in threadpool_info()]
    assert len(during) >= 2 and set(during) == {1} and set(after) == {2}
