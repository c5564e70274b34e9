"""Temporal filter of depth: less flicker, no smearing of moving objects, the same result for parts of a shot."""

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from torchdof import Camera, depth_of_field
from torchdof.depth import Steady, SteadyFrames
from torchdof.depth.steady import shifted
from torchdof.reference.metrics import display
from torchdof.reference.scenes import waves

HEIGHT, WIDTH, SCALE = 64, 112, 3  # pixels, and samples along each side of one
CAMERA = Camera(focal_length_mm=50.0, f_number=1.8, focus_m=3.0)
Shot = list[tuple[Tensor, Tensor]]


WALL, BARS, BALL = waves(0, (0.4, 0.35, 0.3)), waves(1, (0.2, 0.5, 0.3)), waves(2, (0.6, 0.3, 0.2))


def shot(frames: int, pan_px: float = 0.0, ball_px: float = 0.0, cut: int = 10**6, toward: float = 0.0) -> Shot:
    """Bars at 3 m in front of a slanted wall at 8 m, and a ball at 1.5 m: images and exact depths.

    In each frame wall and bars move by ``pan_px``, the ball by ``ball_px``, and wall and bars approach by the share
    ``toward`` of their distance; at the frame ``cut`` wall and bars are exchanged.
    """
    made = []
    for t in range(frames):

        def bar(x: Tensor, y: Tensor, t: int = t) -> Tensor:
            return ((x + pan_px * t + 0.2 * y) % 45 < 9) ^ (t >= cut)

        def ball(x: Tensor, y: Tensor, t: int = t) -> Tensor:
            return (x - 30 - ball_px * t) ** 2 + (y - 30) ** 2 < 14**2

        y, x = torch.meshgrid(*((torch.arange(n * SCALE) + 0.5) / SCALE for n in (HEIGHT, WIDTH)), indexing="ij")
        light = torch.where(bar(x, y), BARS(x + pan_px * t, y), WALL(x + pan_px * t, y))
        light = torch.where(ball(x, y), BALL(x - ball_px * t, y), light)
        y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in (HEIGHT, WIDTH)), indexing="ij")
        depth = torch.where(bar(x, y), 3.0, 8.0 + 0.01 * x) * (1 - toward) ** t
        depth = torch.where(ball(x, y), 1.5, depth)
        made.append((F.avg_pool2d(light[None].float(), SCALE), depth[None, None]))
    return made


def as_estimated(depth: Tensor, frame: int, noise: float = 0.01, blocks: bool = False) -> Tensor:
    """Depth with noise, and edges displaced by up to a pixel: the whole frame at once, or each block of 8 x 8."""
    generator = torch.Generator().manual_seed(1000 + frame)
    size = (HEIGHT // 8, WIDTH // 8) if blocks else (1, 1)
    jitter = torch.randint(-1, 2, (1, 2, *size), generator=generator).float()
    depth = shifted(depth, F.interpolate(jitter, size=(HEIGHT, WIDTH), mode="nearest"))
    return depth * (1 + noise * torch.randn(depth.shape, generator=generator))


def steadied(frames: Shot) -> list[Tensor]:
    steady = Steady()
    return [steady(image, depth) for image, depth in frames]


def rms(values: Tensor) -> float:
    return float(values.double().square().mean().sqrt())


def flicker(pictures: list[Tensor], exact: list[Tensor]) -> float:
    """RMS of the difference of neighbouring frames, minus that of exact depth (in squares)."""
    of_pictures, of_exact = (rms(torch.cat(each).diff(dim=0)) ** 2 for each in (pictures, exact))
    return max(of_pictures - of_exact, 0.0) ** 0.5


def error(depths: list[Tensor], exact: list[Tensor]) -> float:
    """RMS error of inverse depth."""
    return rms(torch.cat([1 / z for z in depths]) - torch.cat([1 / z for z in exact]))


def rendered(frames: Shot, depths: list[Tensor]) -> list[Tensor]:
    images = [image for image, _ in frames]
    return [display(depth_of_field(*pair, CAMERA, tolerance=4 / 255)) for pair in zip(images, depths, strict=True)]


@pytest.mark.parametrize("blocks", [False, True], ids=["the whole frame jitters", "each block jitters"])
def test_flicker_of_24_frames_falls_below_a_third(blocks: bool) -> None:
    exact = shot(24)
    given = [(image, as_estimated(depth, t, blocks=blocks)) for t, (image, depth) in enumerate(exact)]
    truth = rendered(exact, [depth for _, depth in exact])
    before = flicker(rendered(given, [depth for _, depth in given]), truth)
    after = flicker(rendered(given, steadied(given)), truth)
    print(f"flicker {before:.5f} -> {after:.5f}: {after / before:.3f} remains")
    assert after < before / 3


MOTIONS = [{"ball_px": 2.4}, {"pan_px": 2.4}, {"pan_px": 0.3, "ball_px": -5.0}, {"cut": 6}, {"toward": 0.01}]


@pytest.mark.parametrize("motion", MOTIONS, ids=str)
def test_moving_objects_do_not_smear(motion: dict[str, Any]) -> None:
    exact = shot(12, **motion)
    depths = [depth for _, depth in exact]
    given = [(image, as_estimated(depth, t)) for t, (image, depth) in enumerate(exact)]
    of_exact = error(steadied(exact), depths)
    before, after = error([z for _, z in given], depths), error(steadied(given), depths)
    print(f"error of inverse depth: {before:.4f} -> {after:.4f}; of exact depth {of_exact:.4f}")
    assert after < 1.03 * before
    assert of_exact < 0.25 * before


def test_noise_falls_while_the_camera_pans() -> None:
    exact = shot(8, pan_px=2.4)
    given = [(i, z * (1 + 0.01 * torch.randn_like(z))) for i, z in exact]
    depths = [z for _, z in exact]
    assert error(steadied(given), depths) < 0.75 * error([z for _, z in given], depths)


def test_exact_depth_of_a_still_shot_is_unchanged() -> None:
    frames = shot(4)
    for (_, depth), steady in zip(frames, steadied(frames), strict=True):
        torch.testing.assert_close(steady, depth)


def test_an_area_of_new_depth_is_used_even_if_the_image_does_not_change() -> None:
    image, depth = torch.full((1, 3, HEIGHT, WIDTH), 0.2), torch.full((1, 1, HEIGHT, WIDTH), 4.0)
    moved = depth.clone()
    moved[..., 20:40, 30:60] = 1.0
    torch.testing.assert_close(steadied([(image, depth)] * 5 + [(image, moved)])[-1], moved)


def test_exposure_does_not_matter() -> None:
    frames = [(i, as_estimated(z, t)) for t, (i, z) in enumerate(shot(5, ball_px=2.0))]
    bright = [(1000.0 * i, z) for i, z in frames]
    for one, other in zip(steadied(frames), steadied(bright), strict=True):
        assert float(((one / other - 1).abs() > 1e-3).float().mean()) < 1e-3


def test_holes_take_the_stored_depth_and_infinity_stays() -> None:
    image, depth = shot(1)[0]
    depth[..., :10] = torch.inf
    holed = depth.clone()
    holed[..., 5:30] = torch.nan
    steady = Steady()
    assert bool(steady(image, holed)[..., 5:30].isnan().all())
    steady = Steady()
    steady(image, depth)
    torch.testing.assert_close(steady(image, holed), depth)


def test_items_of_a_batch_are_independent() -> None:
    one, other = ([(i, as_estimated(z, t)) for t, (i, z) in enumerate(shot(4, pan_px=p))] for p in (0.0, 1.5))
    both = [(torch.cat([a[0], b[0]]), torch.cat([a[1], b[1]])) for a, b in zip(one, other, strict=True)]
    alone = steadied(other)
    for together, single in zip(steadied(both), alone, strict=True):
        torch.testing.assert_close(together[1:], single)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 2), (33, 49)])
def test_a_frame_of_another_size_starts_anew(size: tuple[int, int]) -> None:
    steady = Steady()
    steady(torch.rand(1, 3, 20, 20), torch.ones(1, 1, 20, 20))
    for _ in range(3):
        given = torch.full((1, 1, *size), 2.0, dtype=torch.float64)
        torch.testing.assert_close(steady(torch.rand(1, 3, *size), given), given)  # and its dtype


@pytest.mark.parametrize("parts", [[range(40, 60)], [range(0, 3), range(3, 50)], [[47], [48], [90], [12]]])
def test_parts_of_a_shot_equal_the_whole(parts: list[Any]) -> None:
    image = torch.rand(1, 3, 16, 20)
    depths = [2.0 + 0.02 * torch.rand(1, 1, 16, 20) for _ in range(100)]
    reads = []

    def read(place: int) -> tuple[Tensor, Tensor]:
        reads.append(place)
        return image, depths[place]

    whole = SteadyFrames(read)
    expected = [whole.depth(place) for place in range(100)]
    assert reads == list(range(100))
    for part in parts:
        again = SteadyFrames(read)
        for place in part:
            reads.clear()
            assert torch.equal(again.depth(place), expected[place])
            assert len(reads) <= 64
