"""Eq. (1) and the other families on samples over radius."""

import numpy as np
import pytest

from torchdof.fit import fit_profile
from torchdof.fit.photo.profile_fit import evaluate
from torchdof.fit.problems import FitError, FlatProfileError, FlatProfileWarning, NonFiniteError

N, R_C, SIGMA = 5.8116e-1, 4.2853e-4, np.sqrt(5.5114e-6)  # Table 1 of the paper, metres


def eq_1(r, n=N, r_c=R_C, sigma=SIGMA):
    return n * np.exp(-((r - r_c) ** 2) / (2 * sigma**2))


@pytest.mark.parametrize("r_max_mm", [2, 3, 4, 5, 6, 7, 8])
@pytest.mark.parametrize("count", [21, 200])
def test_table_1_comes_back_to_a_millionth_from_radii_in_metres(r_max_mm, count):
    r = np.linspace(0, r_max_mm * 1e-3, count)
    fit = fit_profile(r, eq_1(r))
    assert fit.params["N"] == pytest.approx(N, rel=1e-6)
    assert fit.params["r_c"] == pytest.approx(R_C, rel=1e-6)
    assert fit.params["sigma"] == pytest.approx(SIGMA, rel=1e-6)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_lengths_come_back_in_the_unit_they_were_given_in(unit):
    r = np.linspace(0, 10, 60) * unit
    fit = fit_profile(r, eq_1(r, 2.0, 3.0 * unit, 2.0 * unit))
    assert fit.params["r_c"] == pytest.approx(3 * unit, rel=1e-8)
    assert fit.params["sigma"] == pytest.approx(2 * unit, rel=1e-8)


@pytest.mark.parametrize(
    ("family", "true"),
    [
        ("gaussian", {"N": 0.7, "sigma": 3.0}),
        ("ring", {"N": 0.7, "sigma": 2.0, "r_c": 4.0}),
        ("softm", {"N": 0.7, "radius": 6.0, "sigma": 0.8, "b": 0.5, "m": 3.0}),
    ],
)
def test_every_smooth_family_comes_back_from_its_own_samples(family, true):
    r = np.linspace(0, 12, 150)
    fit = fit_profile(r, evaluate(family, r, true), family)
    for name, value in true.items():
        assert fit.params[name] == pytest.approx(value, rel=1e-5), name
    assert fit.residual < 1e-7


def test_disc_is_found_to_half_a_sample():
    r = np.linspace(0, 10, 101)
    fit = fit_profile(r, np.where(r <= 6.02, 0.8, 0.0), "disc")
    assert abs(fit.params["radius"] - 6.02) <= 0.05
    assert abs(fit.params["radius"] - 6.02) < 2 * fit.stderr["radius"]
    assert fit.params["N"] == pytest.approx(0.8)


def test_radial_follows_a_profile_that_no_other_family_has():
    r = np.linspace(0, 10, 300)
    twin = np.exp(-((r - 2) ** 2)) + 0.6 * np.exp(-((r - 7) ** 2))
    fit = fit_profile(r, twin, "radial", knots=40)
    assert fit.residual < 0.01
    assert np.all(fit.params["values"] >= 0)
    with pytest.warns(FlatProfileWarning, match="too different from the family"):
        assert fit_profile(r, twin, "ring").residual > 0.3


def test_standard_errors_hold_in_repeated_samples():
    r = np.linspace(0, 6e-3, 100)
    rng = np.random.default_rng(3)
    fits = [fit_profile(r, eq_1(r, r_c=1e-3) + 0.01 * rng.normal(size=r.size)) for _ in range(60)]
    for name, true in (("N", N), ("r_c", 1e-3), ("sigma", SIGMA)):
        pull = np.array([(f.params[name] - true) / f.stderr[name] for f in fits])
        assert 0.75 < pull.std() < 1.3, name
        assert abs(pull.mean()) < 0.45, name


def test_standard_errors_grow_with_errors_that_a_spoke_has_in_common():
    rng = np.random.default_rng(0)
    r = np.tile(np.linspace(0, 6e-3, 20), 36)
    spoke = np.repeat(np.arange(36), 20)
    strength = eq_1(r) + 0.02 * rng.normal(size=36)[spoke]
    alone, together = fit_profile(r, strength), fit_profile(r, strength, groups=spoke)
    assert together.stderr["N"] > 2 * alone.stderr["N"]


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_flat_profile_is_refused(noise):
    r = np.linspace(0, 5, 60)
    strength = 0.5 + noise * np.random.default_rng(0).normal(size=r.size)
    with pytest.raises(FlatProfileError, match="flat") as caught:
        fit_profile(r, strength)
    assert caught.value.number is not None


def test_pure_noise_is_refused():
    with pytest.raises(FlatProfileError):
        fit_profile(np.linspace(0, 5, 60), np.random.default_rng(1).normal(size=60))


def test_nearly_flat_profile_warns_that_r_c_is_not_fixed():
    r = np.linspace(0, 5e-4, 60)
    strength = eq_1(r, r_c=0.0) + 0.006 * np.random.default_rng(0).normal(size=r.size)
    with pytest.warns(FlatProfileWarning, match="to fix sigma"):
        fit_profile(r, strength)


@pytest.mark.parametrize(
    ("r", "strength", "error", "match"),
    [
        ([0.0, 1, 2], [1.0, 0.5, 0.1], FitError, "at least 5 different radii, got 3"),
        (np.linspace(0, 1, 9), np.ones(8), FitError, r"both be \[n\], got \[9\] and \[8\]"),
        (np.ones((3, 3)), np.ones((3, 3)), FitError, r"both be \[n\]"),
        (-np.linspace(0, 1, 9), np.linspace(1, 0, 9), FitError, "r must be >= 0, got -1"),
        (np.linspace(0, 1, 9), [np.nan] * 9, NonFiniteError, "9 of 9 samples are NaN"),
        (np.linspace(0, 1, 9), -np.linspace(1, 2, 9), FitError, "positive somewhere"),
        (np.ones(9), np.linspace(1, 2, 9), FitError, "different radii, got 1"),
        ("far", np.ones(9), FitError, "must be numbers"),
    ],
)
def test_wrong_samples_are_refused_by_name(r, strength, error, match):
    with pytest.raises(error, match=match):
        fit_profile(r, strength)


def test_unknown_family_is_refused():
    with pytest.raises(FitError, match="family must be one of gaussian, ring"):
        fit_profile(np.linspace(0, 1, 9), np.linspace(1, 0, 9), "airy")
