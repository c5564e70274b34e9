import functools
import math
from typing import Any

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor
from torch.testing import assert_close

from tests.refused import refuses
from torchdof import BlurTable, blur_by_coc
from torchdof.optics import psf
from torchdof.optics.aperture import Aperture

LETTER = torch.zeros(12, 10)
LETTER[1:11, 2:4] = 1.0  # the letter F, which has no symmetry
LETTER[1:3, 2:9] = 0.5
LETTER[5:7, 2:7] = 1.0
SEVEN: dict[str, Any] = {"aperture": 7}
LOPSIDED = [
    BlurTable.polygon(3, 20.0, squeeze=1.6),
    BlurTable.polygon(5, 7.0, 0.4, rim=2.0),
    BlurTable.from_aperture(LETTER, squeeze=0.8),
    BlurTable.polygon(5, vignetting=(0.3, 0.1)),
    BlurTable.load("double_gauss_50mm_f2").replace(aperture=Aperture(blades=7, rotation_deg=15.0)),
]


def area_of(blades: int, curvature: float) -> float:
    """Area of a polygon whose corners lie on the unit circle, with a segment of a circle on each side."""
    half = math.pi / blades
    area = blades * math.sin(half) * math.cos(half)
    sagitta = curvature * (1.0 - math.cos(half))
    if sagitta == 0.0:
        return area
    radius = (math.sin(half) ** 2 + sagitta**2) / (2.0 * sagitta)
    arc = 2.0 * math.asin(math.sin(half) / radius)
    return area + blades * radius**2 / 2.0 * (arc - math.sin(arc))


def point_of_light(coc_px: float, table: BlurTable, **options: Any) -> Tensor:
    """Picture ``[H, W]`` of one unit of light on black."""
    half = math.ceil(abs(coc_px)) + 4
    image = torch.zeros(1, 1, 2 * half + 1, 2 * half + 1, dtype=torch.float64)
    image[..., half, half] = 1.0
    options = {"occlusion": False, "normalize": False, "tolerance": 0, **options}
    return blur_by_coc(image, torch.full_like(image, coc_px), table=table, **options)[0, 0]


@pytest.mark.parametrize("curvature", [0.0, 0.25, 1.0])
@pytest.mark.parametrize("blades", [3, 4, 5, 6, 7, 9, 15])
def test_areas_of_polygons_are_exact(blades: int, curvature: float) -> None:
    for rotation, step in ((0.0, 0.1), (13.0, 0.37), (90.0, 1.7)):
        size = torch.tensor(step, dtype=torch.float64)
        shares = Aperture(blades, rotation, curvature).shares(13, size, 0.8 * size)
        assert ((shares >= 0) & (shares <= 1 + 1e-12)).all()
        assert_close(float(shares.sum()) * step * 0.8 * step, area_of(blades, curvature), rtol=0, atol=1e-12)


@pytest.mark.parametrize("coc_px", [-43.4, 36.0])
@pytest.mark.parametrize("table", [BlurTable.polygon(5, 11.0), BlurTable.polygon(3, 20.0, squeeze=1.6), LOPSIDED[2]])
def test_a_point_of_light_shows_the_opening_upright_or_turned_before_focus(table: BlurTable, coc_px: float) -> None:
    picture = point_of_light(coc_px, table)
    opening = table.aperture
    assert opening is not None
    pixel = torch.tensor(1.0 / abs(coc_px), dtype=torch.float64)
    mask = opening.shares(picture.shape[-1] // 2, pixel, pixel * opening.squeeze)
    mask = mask / mask.sum()
    mask = mask if coc_px > 0 else mask.flip(-2, -1)
    for axis in (0, 1):
        place = torch.arange(len(mask), dtype=torch.float64)
        assert_close((picture.sum(axis) * place).sum(), (mask.sum(axis) * place).sum(), rtol=0, atol=4e-4 * abs(coc_px))
        # kernels do not integrate over the pixel: that would add 1/24 of the second difference along each axis
        around = functional.pad(picture, (0, 0, 1, 1) if axis == 0 else (1, 1))
        picture = picture + around.diff(n=2, dim=axis) / 24
    assert_close(picture, mask, rtol=0, atol=0.2 * float(mask.max()))
    for other in (mask.flip(-2, -1), mask.flip(-1)):
        assert (picture - other).abs().max() > 0.5 * mask.max()


def test_without_rotation_a_corner_points_up_and_rotation_is_counter_clockwise() -> None:
    up = point_of_light(20.0, BlurTable.polygon(3))
    assert int((up.sum(1) > 1e-6).nonzero()[0]) == 4 and up[: len(up) // 2].sum() < up[len(up) // 2 + 1 :].sum()
    assert_close(up, up.flip(-1), rtol=0, atol=1e-12)
    left = point_of_light(20.0, BlurTable.polygon(3, rotation_deg=90.0))
    assert_close(left, up.rot90(), rtol=0, atol=1e-12)
    letter = point_of_light(20.0, BlurTable.from_aperture(LETTER, rotation_deg=90.0))
    assert_close(letter, point_of_light(20.0, BlurTable.from_aperture(LETTER.rot90())), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("family", "params"),
    [
        ("disc", {"radius": 9.0}),
        ("gaussian", {"sigma": 3.0}),
        ("ring", {"sigma": 1.0, "r_c": 6.0}),
        ("softm", {"radius": 8.0, "sigma": 0.4, "b": 1.0, "m": 2.0}),
        ("radial", {"values": torch.tensor([1.0, 0.3, 2.0]), "radius": 8.5}),
    ],
)
def test_a_squeezed_lens_is_narrower_and_as_high(family: str, params: dict[str, Any]) -> None:
    squeezed, usual = (psf.pixel_kernels(family, params, aperture=Aperture(squeeze=s)) for s in (2.0, 1.0))
    assert_close(usual, psf.pixel_kernels(family, params), rtol=0, atol=0)
    place = torch.arange(usual.shape[-1], dtype=torch.float64) - usual.shape[-1] // 2
    assert squeezed.shape == usual.shape
    high, wide = ((squeezed.sum(axis) * place**2).sum() for axis in (1, 0))
    variance = (usual.sum(0) * place**2).sum()
    assert_close(high, variance, rtol=4e-3, atol=0)
    assert_close(wide, variance / 4, rtol=2e-2, atol=0)


@pytest.mark.parametrize("table", LOPSIDED, ids=str)
def test_kernels_with_an_opening_are_non_negative_and_sum_to_one(table: BlurTable) -> None:
    for coc in (0.01, 0.3, 1.0, 4.4, 12.0, 300.0):
        kernels = table.kernels(torch.tensor([-coc, coc]), 500, window=None if coc < 300 else 41)
        assert torch.isfinite(kernels).all() and (kernels >= 0).all()
        if table.unit == "relative":
            assert_close(kernels[0], kernels[1].flip(-2, -1), rtol=0, atol=1e-15)
        if coc < 300:
            assert_close(kernels.sum((-2, -1)), torch.ones(2, 1, dtype=torch.float64), rtol=0, atol=1e-12)


def test_kernels_differentiate_in_rotation_squeeze_and_coc() -> None:
    def kernels(rotation: Tensor, squeeze: Tensor, coc: Tensor) -> Tensor:
        return BlurTable.polygon(5, rotation, 0.3, squeeze=squeeze).kernels(coc, 100, size=7)

    dice = torch.Generator().manual_seed(0)
    for coc in (2.6, -0.7):
        given = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (11.0, 1.3))
        places = (coc + 0.1 * torch.rand(1, generator=dice)).double().requires_grad_()
        assert torch.autograd.gradcheck(kernels, (*given, places), atol=1e-6, fast_mode=True)


partial: Any = functools.partial
CORNER = functional.pad(torch.ones(1, 1), (0, 4, 0, 54))  # the only open point
DARK = BlurTable.gaussian().replace(aperture=Aperture(rotation_deg=30.0, mask=CORNER))
test_an_invalid_opening_is_refused_by_name = refuses(
    (lambda: BlurTable.polygon(2), "blades must be a whole number from 3 to 64, got 2"),
    (lambda: BlurTable.polygon(5, torch.zeros(2)), "rotation_deg must be a number"),
    *((partial(Aperture, **{"blades": 5, name: 10**400}), name)
      for name in ("blades", "rotation_deg", "curvature", "squeeze", "vignetting")),
    (lambda: Aperture(curvature=0.5), "curvature is that of blades"),
    (lambda: Aperture(blades=5, mask=torch.ones(3, 3)), "blades or a mask, got 5"),
    (lambda: BlurTable.from_aperture(torch.zeros(4, 4)), "not all of them 0"),
    (lambda: BlurTable.from_aperture(torch.ones(3, 4, 4)), r"transmission \[H, W\] of an opening, got \[3, 4, 4\]"),
    (lambda: BlurTable.polygon(5, rim=-2.0), r"b of softm must be finite and >= -1, got \[-2\]"),
    (lambda: BlurTable("disc", [1.0], {"radius": [1.0]}, **SEVEN), "aperture must be of type Aperture, got 7"),
    (lambda: DARK.kernels(torch.tensor([-5.0]), 16), "passes no light"),
    (lambda: Aperture.from_dict({"leaves": 7}), "aperture must have the fields .*; 'leaves' is not one"),
    (lambda: Aperture.from_dict({"mask": [[1.0], [2.0, 3.0]]}), "mask must be numbers"),
)  # fmt: skip
