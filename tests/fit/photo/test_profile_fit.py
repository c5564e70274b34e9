"""Fits of eq. (1) and other smooth profiles to samples over the radius; the paper's ratio along spokes."""

import numpy as np
import pytest

from torchdof.fit import FitError, FitWarning, blur_strength, fit_pair, fit_profile
from torchdof.fit.photo.profile_fit import evaluate

N, R_C, SIGMA = 5.8116e-1, 4.2853e-4, np.sqrt(5.5114e-6)  # Table 1 of the paper, metres


def eq_1(r, n=N, r_c=R_C, sigma=SIGMA):
    return n * np.exp(-((r - r_c) ** 2) / (2 * sigma**2))


@pytest.mark.parametrize("r_max_mm", [2, 3, 4, 5, 6, 7, 8])
@pytest.mark.parametrize("count", [21, 200])
def test_table_1_is_recovered_within_1e_6_from_radii_in_metres(r_max_mm, count):
    r = np.linspace(0, r_max_mm * 1e-3, count)
    assert fit_profile(r, eq_1(r)).params == pytest.approx({"N": N, "r_c": R_C, "sigma": SIGMA}, rel=1e-6)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(
    ("family", "true"),
    [
        ("gaussian", {"N": 0.7, "sigma": 3.0}),
        ("ring", {"N": 0.7, "r_c": 4.0, "sigma": 2.0}),
        ("softm", {"N": 0.7, "radius": 6.0, "sigma": 0.8, "b": 0.5, "m": 3.0}),
    ],
)
def test_every_family_is_recovered_from_its_own_samples_in_any_unit(family, true, unit):
    r = np.linspace(0, 12, 150) * unit
    true = {n: v * unit if n in ("sigma", "r_c", "radius") else v for n, v in true.items()}
    fit = fit_profile(r, evaluate(family, r, true), family)
    assert fit.params == pytest.approx(true, rel=1e-5) and fit.residual < 1e-7


def test_standard_errors_hold_in_repeated_samples():
    r = np.linspace(0, 6e-3, 100)
    rng = np.random.default_rng(3)
    fits = [fit_profile(r, eq_1(r, r_c=1e-3) + 0.01 * rng.normal(size=r.size)) for _ in range(30)]
    for name, true in (("N", N), ("r_c", 1e-3), ("sigma", SIGMA)):
        pull = np.array([(f.params[name] - true) / f.stderr[name] for f in fits])
        assert 0.75 < pull.std() < 1.3 and abs(pull.mean()) < 0.45, name


def test_standard_errors_include_errors_common_to_a_spoke():
    r, spoke = np.tile(np.linspace(0, 6e-3, 20), 36), np.repeat(np.arange(36), 20)
    strength = eq_1(r) + 0.02 * np.random.default_rng(0).normal(size=36)[spoke]
    assert fit_profile(r, strength, groups=spoke).stderr["N"] > 2 * fit_profile(r, strength).stderr["N"]


R, RNG = np.linspace(0, 5, 60), np.random.default_rng(0)
NINE = np.linspace(0, 1, 9)


WRONG = [  # arguments of the wrong kind: test_arguments.py
    (R, np.full(60, 0.5), "flat profile", "the profile is flat"),
    (R, 0.5 + 0.02 * RNG.normal(size=60), "flat profile", "the profile is flat"),
    (R, np.random.default_rng(1).normal(size=60), "flat profile", "the profile is flat"),
    ([0.0, 1, 2], [1.0, 0.5, 0.1], "argument", "at least 5 different radii, got 3"),
    (-NINE, 1 - NINE, "argument", "r must be >= 0, got -1"),
    (NINE, [np.nan] * 9, "not finite", "9 of 9 values of strength are NaN"),
    (NINE, -1 - NINE, "argument", "positive somewhere"),
    (np.ones(9), 1 + NINE, "argument", "different radii, got 1"),
]
FAMILIES = "family must be one of gaussian, ring, softm"


@pytest.mark.parametrize(
    ("r", "strength", "kind", "match", "family"),
    [
        *((*row, "ring") for row in WRONG),
        *((NINE, 1 - NINE, "argument", FAMILIES, family) for family in ("airy", "disc", "radial")),
    ],
)
def test_wrong_arguments_are_refused_by_name(r, strength, kind, match, family):
    with pytest.raises(FitError, match=match) as caught:
        fit_profile(r, strength, family)
    assert caught.value.kind == kind


def test_an_undetermined_parameter_gives_a_warning():
    r = np.linspace(0, 5e-4, 60)
    with pytest.warns(FitWarning, match="to fix sigma"):
        fit_profile(r, eq_1(r, r_c=0.0) + 0.006 * np.random.default_rng(0).normal(size=60))
    r = np.linspace(0, 10, 300)
    with pytest.warns(FitWarning, match="too different from the family") as caught:
        assert fit_profile(r, np.exp(-((r - 2) ** 2)) + 0.6 * np.exp(-((r - 7) ** 2))).residual > 0.3
    assert {w.message.kind for w in caught} == {"flat profile"}


def test_blur_strength_is_the_ratio_of_the_pictures_along_36_spokes(simulator):
    sharp, _ = simulator.Simulator(snr_db=None).pair("gaussian", {"sigma": 1.0})
    rows, columns = np.indices(sharp.shape) - 50.0
    r, strength, spoke = blur_strength(sharp, 0.05 + sharp * (1 + 0.02 * columns - 0.01 * rows))
    assert len(np.unique(spoke)) == 36 and sorted(np.unique(r)) == list(range(12))
    theta = np.deg2rad(10 * spoke)
    expected = 1 + r * (0.02 * np.cos(theta) - 0.01 * np.sin(theta))  # bilinear interpolation is exact for a plane
    np.testing.assert_allclose(strength[r < 10], expected[r < 10], atol=1e-9)


@pytest.mark.parametrize(("sigma", "least"), [(4.0, 8.0), (8.0, 9.6)])
def test_the_ratio_model_measures_dot_and_kernel_together(simulator, sigma, least):
    # the paper's procedure gives widths of about 9 to 14 px whatever the kernel's width; it is not corrected
    fit = fit_pair(*simulator.Simulator(snr_db=None).pair("gaussian", {"sigma": sigma}), "gaussian", model="ratio")
    assert fit.model == "ratio" and fit.params["sigma"] > least
