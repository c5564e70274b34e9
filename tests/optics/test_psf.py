import functools
import math
from typing import Any

import pytest
import torch
import torch.nn.functional as functional
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from tests import loops
from tests.kernels import kernel_of
from tests.refused import refuses
from torchdof.optics import psf

LENGTH_PX = st.one_of(st.just(0.0), st.floats(1e-9, 1e-2), st.floats(0.01, 12.0))
RADIAL_VALUES = st.lists(st.floats(0.0, 9.0), min_size=2, max_size=6).filter(lambda v: max(v) > 1e-3).map(torch.tensor)
PARAMETERS: dict[str, dict[str, Any]] = {
    "gaussian": {"sigma": LENGTH_PX},
    "ring": {"sigma": LENGTH_PX, "r_c": LENGTH_PX},
    "disc": {"radius": LENGTH_PX},
    "softm": {"radius": LENGTH_PX, "sigma": LENGTH_PX, "b": st.floats(-1.0, 4.0), "m": st.floats(0.5, 8.0)},
    "radial": {"values": RADIAL_VALUES, "radius": LENGTH_PX},
}
EXAMPLES: list[tuple[str, dict[str, Any]]] = [
    ("gaussian", {"sigma": 0.2}),
    ("gaussian", {"sigma": 3.3}),
    ("ring", {"sigma": 0.3, "r_c": 0.5}),
    ("ring", {"sigma": 1.0, "r_c": 0.0}),
    ("ring", {"sigma": 0.5, "r_c": 8.0}),
    ("ring", {"sigma": 3.0, "r_c": 20.0}),
    ("softm", {"radius": 1.0, "sigma": 0.2, "b": 1.0, "m": 2.0}),
    ("softm", {"radius": 3.0, "sigma": 0.5, "b": -1.0, "m": 4.0}),
    ("softm", {"radius": 8.0, "sigma": 0.1, "b": 2.0, "m": 8.0}),
    ("radial", {"values": torch.tensor([1.0, 0.2, 0.5, 2.0, 0.0]), "radius": 1.0}),
    ("radial", {"values": torch.tensor([1.0, 0.2, 0.5, 2.0, 0.0]), "radius": 12.0}),
]


def distance(first: Tensor, second: Tensor) -> float:
    """Sum of the absolute differences of two kernels, which may differ in size."""
    size = max(first.shape[-1], second.shape[-1])
    first, second = (functional.pad(k, ((size - k.shape[-1]) // 2,) * 4) for k in (first, second))
    return float((first - second).abs().sum())


def second_moment(kernel: Tensor) -> float:
    axis = torch.arange(kernel.shape[-1], dtype=torch.float64) - kernel.shape[-1] // 2
    return float((kernel * (axis[:, None] ** 2 + axis[None, :] ** 2)).sum())


def mass_by_radius(family: str, params: dict[str, Any], cells: int = 400_000) -> tuple[Tensor, Tensor]:
    """Radii, and the light in the thin ring at each radius, by the midpoint rule."""
    reach = 1.5 * psf.support(family, params) + 1e-9
    r = (torch.arange(cells, dtype=torch.float64) + 0.5) / cells * reach
    return r, psf.profile(family, r, params) * r


@pytest.mark.parametrize("family", PARAMETERS)
@given(data=st.data())
def test_every_kernel_is_non_negative_sums_to_one_and_is_symmetric(family: str, data: st.DataObject) -> None:
    kernel = psf.pixel_kernels(family, {name: data.draw(value, name) for name, value in PARAMETERS[family].items()})
    assert kernel.dtype == torch.float64 and kernel.shape[-1] % 2 == 1
    assert torch.isfinite(kernel).all() and (kernel >= 0).all()
    assert_close(float(kernel.sum()), 1.0, rtol=0.0, atol=1e-12)
    for same in (kernel.flip(0), kernel.flip(1), kernel.mT):
        assert_close(kernel, same, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("family", "params"), [*EXAMPLES, *(("disc", {"radius": r}) for r in (0.2, 0.5, 0.7, 1.0, 2.2, 5.5, 9.99, 20.3))]
)
def test_kernel_is_the_finely_sampled_psf_weighted_by_the_interpolator(family: str, params: dict[str, Any]) -> None:
    kernel = psf.pixel_kernels(family, params)
    reach = psf.support(family, params)
    assert kernel.shape[-1] // 2 == math.ceil(reach)
    profile = functools.partial(psf.profile, family, params=params)
    moved = distance(kernel, loops.interpolated(lambda r: profile(r.flatten()).view_as(r), reach, kernel.shape[-1]))
    assert moved < (3e-3 if reach < 8 else 1.5e-2)  # a large PSF has larger cells
    r, mass = mass_by_radius(family, params)
    assert float(mass[r > reach].sum() / mass.sum()) < 1e-5


@pytest.mark.parametrize(
    ("family", "params"),
    [
        ("gaussian", {"sigma": 3.3}),
        ("ring", {"sigma": 1.0, "r_c": 0.0}),
        ("ring", {"sigma": 3.0, "r_c": 20.0}),
        ("softm", {"radius": 8.0, "sigma": 1.5, "b": 2.0, "m": 4.0}),
        ("radial", {"values": torch.tensor([1.0, 0.8, 0.5, 0.1, 0.0]), "radius": 12.0}),
    ],
)
def test_second_moment_is_that_of_the_profile_without_the_pixel(family: str, params: dict[str, Any]) -> None:
    r, mass = mass_by_radius(family, params)
    expected = float((mass * r**2).sum() / mass.sum())
    kernel = psf.pixel_kernels(family, params, size=2 * psf.half_width(1.2 * psf.support(family, params) + 2) + 1)
    assert second_moment(kernel) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("radius", [300.0, 500.0])
def test_kernels_of_hundreds_of_pixels_have_the_right_level_and_moment(radius: float) -> None:
    kernel = kernel_of("disc", radius)
    inside = kernel[kernel.shape[-1] // 2, kernel.shape[-1] // 2]
    assert float(inside) == pytest.approx(1 / (math.pi * radius**2), rel=1e-5)
    assert second_moment(kernel) == pytest.approx(radius**2 / 2, abs=0.12)  # a box would add 1/6


@pytest.mark.parametrize(
    ("family", "params"),
    [
        ("gaussian", [[0.05, 0.5, 1.5]]),
        ("disc", [[0.6, 1.3, 2.0, 2.9]]),
        ("ring", [[0.5, 1.5], [0.1, 2.0]]),
        ("softm", [[1.3, 2.4], [0.4, 0.1], [0.4, -0.5], [2.0, 3.0]]),
        ("radial", [[[1.0, 0.5, 2.0], [0.1, 0.2, 0.3]], [1.7, 2.9]]),
    ],
)
def test_kernels_are_differentiable_in_their_parameters(family: str, params: list[Any]) -> None:
    leaves = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in params]
    names = psf.FAMILIES[family]
    assert torch.autograd.gradcheck(
        lambda *values: psf.pixel_kernels(family, dict(zip(names, values, strict=True)), 7), leaves, fast_mode=True
    )


OTHERS: dict[str, Any] = {"b": 0.5, "m": 2.0, "values": torch.ones(3)}  # parameters that are no lengths


@pytest.mark.parametrize("family", psf.FAMILIES)
@pytest.mark.parametrize("length", [0.0, 1e-12, 1e-3, 0.5, 1.5])
def test_gradients_are_finite_where_kernels_are_not_smooth(family: str, length: float) -> None:
    made = {name: torch.tensor(length, dtype=torch.float64, requires_grad=True) for name in psf.FAMILIES[family]}
    lengths = [made[name] for name in made if name not in OTHERS]
    kernel = psf.pixel_kernels(family, {name: OTHERS.get(name, value) for name, value in made.items()}, 5)
    assert all(torch.isfinite(grad) for grad in torch.autograd.grad(kernel.square().sum(), lengths))


@pytest.mark.parametrize(
    ("one", "other", "apart"),
    [
        (kernel_of("softm", 3.3, 0.0, size=9), kernel_of("disc", 3.3, size=9), 5e-4),
        (kernel_of("softm", 3.3, 0.4, b=0.0, m=2.0), kernel_of("softm", 3.3, 0.4, b=0.0, m=7.0), 1e-300),
        (kernel_of("ring", 1.7, 0.0), kernel_of("gaussian", 1.7), 1e-3),
        (kernel_of("radial", torch.ones(5), 3.3), kernel_of("disc", 3.3), 5e-4),
    ],
    ids=["without a soft rim", "without a tilt", "without a hole", "flat"],
)
def test_families_contain_simpler_ones_as_special_cases(one: Tensor, other: Tensor, apart: float) -> None:
    assert distance(one, other) < apart
    assert kernel_of("softm", 3.3, 0.4, size=9)[4, 8] > kernel_of("disc", 3.3, size=9)[4, 8]


@pytest.mark.parametrize("family", psf.FAMILIES)
def test_kernel_of_size_zero_is_one_pixel(family: str) -> None:
    params = {name: OTHERS.get(name, 0.0) for name in psf.FAMILIES[family]}
    kernel = psf.pixel_kernels(family, params)
    assert kernel.tolist() == [[1.0]]
    assert_close(psf.pixel_kernels(family, params, size=5), functional.pad(kernel, (2,) * 4), rtol=0.0, atol=1e-12)


def test_a_batch_of_parameters_equals_each_alone() -> None:
    sigma, r_c = torch.tensor([[0.5], [1.0]]), torch.tensor([[0.0, 2.0, 3.0]])
    together = kernel_of("ring", sigma, r_c, size=15)
    assert together.shape == (2, 3, 15, 15)
    alone = [kernel_of("ring", float(s), float(r), size=15) for s in sigma for r in r_c[0]]
    assert_close(together.flatten(0, 1), torch.stack(alone))


kernels: Any = functools.partial(functools.partial, psf.pixel_kernels)  # makes a call that `refuses` runs
test_bad_parameters_are_refused_by_name = refuses(
    (kernels("box", {"radius": 1.0}), "family must be one of gaussian, ring, disc, softm, radial, got 'box'"),
    (kernels("disc", {"radius": -0.1}), "radius of disc must be finite and >= 0"),
    (kernels("gaussian", {"sigma": math.nan}), "sigma must be finite numbers"),
    (kernels("softm", {"radius": 1.0, "sigma": 0.0, "b": -1.5, "m": 2.0}), "b of softm must be finite and >= -1"),
    (kernels("radial", {"values": torch.tensor([1.0]), "radius": 1.0}), "values must be .* with P >= 2"),
    (kernels("radial", {"values": torch.tensor([1.0, -1.0]), "radius": 1.0}), "values of radial must be finite and >="),
)


def test_sizes_are_odd_and_a_smaller_size_keeps_the_sum() -> None:
    whole, cut = kernel_of("gaussian", 2.0, size=21), kernel_of("gaussian", 2.0, size=5)
    assert_close(cut, whole[8:13, 8:13] / whole[8:13, 8:13].sum())
    for size in (0, -1, 4):
        with pytest.raises(ValueError, match=f"size must be a positive odd number of pixels, got {size}"):
            kernel_of("disc", 2.0, size=size)
