"""``first_pictures.py``, which times first renderings: its parts, its checks, and two installations in turns."""

from pathlib import Path

import pytest
import torch

from examples.benchmarks import first_pictures

SCENES = Path(__file__).parents[1] / "data" / "scenes"


def figures(part: str, turn: int = 0) -> list[first_pictures.Figure]:
    return list(first_pictures.figures(part, SCENES / "planes", turn))


@pytest.mark.parametrize(
    ("part", "sizes", "radii_px"),
    [
        pytest.param("fresh-39", [(1350, 1080)], [(39, 39)], marks=pytest.mark.sweep),
        pytest.param("fresh-60", [(1333, 2000)], [(60, 60)], marks=pytest.mark.sweep),
        pytest.param("command", [(1333, 2000)] * 3, [(30, 30), (60, 60), (111, 111)], marks=pytest.mark.sweep),
        ("cameras", [(160, 192)], [(4, 64)]),
        pytest.param("pull", [(1080, 1920)] * 2, [(69, 69)] * 2, marks=pytest.mark.sweep),
        ("small", [(256, 256)] * 3, [(2, 8)] * 3),
        ("lamps", [(480, 640)], [(500, 500)]),
        ("noise", [(480, 640)], [(59, 60)]),
    ],
)
def test_a_part_renders_its_stated_sizes_and_blur_radii(
    part: str, sizes: list[tuple[int, int]], radii_px: list[tuple[float, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "set_num_threads", lambda _: None)
    first, second = figures(part), figures(part, turn=1)
    for figure, size, (low, high) in zip(first, sizes, radii_px, strict=True):
        for scene in figure.scenes:
            widest = float(scene.coc_px.abs().max())
            assert scene.image.shape[-2:] == size == scene.coc_px.shape[-2:]
            assert low - 0.01 <= widest <= high + 0.01, "another blur"
    cocs = [scene.coc_px for turn in (first, second) for figure in turn for scene in figure.scenes]
    same = [torch.equal(a, b) for i, a in enumerate(cocs) for b in cocs[:i] if a.shape == b.shape]
    assert not any(same) or part == "lamps", "a camera was rendered before"


def test_the_command_renders_the_same_picture_as_blur_by_coc() -> None:
    scene = first_pictures.shipped(48, 64).seen(0.0, 5.0)
    picture, seconds = first_pictures.rendered(scene.image, scene.coc_px)
    expected = first_pictures.blur_by_coc(scene.image, scene.coc_px)
    assert first_pictures.error(picture, expected)["psnr_db"] > 30  # JPEG in and out
    assert seconds.wall > 0.1 and seconds.cpu > 0.1
