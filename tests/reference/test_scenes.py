import json
import math
import re
from pathlib import Path

import pytest
import torch
import torch.nn.functional as functional

from torchdof.reference import metrics
from torchdof.reference.scenes import Plane, camera_of, plane_scene, posts, read_scenes, waves

DATA = Path(__file__).parents[1] / "data" / "scenes"
CAMERA = camera_of(200.0, 96, aperture_radius_m=0.02, focus_m=1.0)


def jinc(x: torch.Tensor) -> torch.Tensor:
    """Fourier transform of the unit disc, by its definition: the mean of cos(x t) over the disc's chords."""
    t = (torch.arange(200_000, dtype=torch.float64) + 0.5) / 200_000 * 2 - 1
    chord = (1 - t**2).sqrt()
    return torch.stack([(torch.cos(v * t) * chord).sum() / chord.sum() for v in x])


def test_the_truth_of_one_plane_is_its_sine_wave_damped_by_disc_and_pixel() -> None:
    k = torch.tensor([0.6], dtype=torch.float64)
    scene = plane_scene([Plane(2.0, lambda x, y: (1 + torch.sin(k * x))[None])], CAMERA, (4, 60), samples=4096)
    coc = float(scene.coc_px[0, 0, 0, 0])
    x = torch.arange(60, dtype=torch.float64) + 0.5
    pixel = torch.sinc(k / 2 / math.pi)
    sharp, blurred = 1 + pixel * torch.sin(k * x), 1 + pixel * jinc(k * coc) * torch.sin(k * x)
    assert coc == pytest.approx(CAMERA.coc_px(torch.tensor([[[[2.0]]]]), 60).item())
    assert float((blurred - 1).abs().max()) > 0.1
    torch.testing.assert_close(scene.image[0, 0, 0], sharp.float(), rtol=0, atol=1e-3)
    torch.testing.assert_close(scene.truth[0, 0, 0], blurred.float(), rtol=0, atol=2e-3)


def test_the_sharp_image_shows_the_nearest_plane_everywhere() -> None:
    planes = [Plane(1.0, waves(1), posts(20, 5)), Plane(3.0, waves(2)), Plane(2.0, waves(3), posts(31, 11, -0.2))]
    scene = plane_scene(planes, CAMERA, (20, 30), samples=256)
    y, x = torch.meshgrid(*((torch.arange(8 * n, dtype=torch.float64) + 0.5) / 8 for n in (20, 30)), indexing="ij")
    near, far, middle = (plane.light(x, y) for plane in planes)
    fine = torch.where(planes[0].covers(x, y), near, torch.where(planes[2].covers(x, y), middle, far))
    assert metrics.psnr(functional.avg_pool2d(fine.float()[None], 8), scene.image) > 45
    assert sorted(set(scene.depth.flatten().tolist())) == [1.0, 2.0, 3.0]


BAD_FIELDS: list[tuple[dict[str, object], str]] = [
    ({"F_px": None}, "F_px must be a number > 0"),
    ({"truths": 3}, "must describe a scene"),
    ({"truths": [{"aperture_radius_m": -1, "focus_distance_m": 1}]}, "aperture_radius_m must be a number > 0"),
]


def test_a_folder_without_scenes_is_refused_and_a_bad_scene_names_file_and_field(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no scene here"):
        list(read_scenes(tmp_path))
    meta = json.loads((DATA / "planes" / "meta.json").read_text())
    for change, message in BAD_FIELDS:
        (tmp_path / "meta.json").write_text(json.dumps(meta | change))
        with pytest.raises(ValueError, match=f"{re.escape(str(tmp_path))}.*{message}"):
            list(read_scenes(tmp_path))
