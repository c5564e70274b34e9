"""Scenes with known depth of field: read from a folder, or rendered from textured planes.

A folder holds ``sharp.exr`` (all in focus, linear light), ``depth.exr`` (metres along the optical axis), one
``truth_K.exr`` for each setting of the lens, and ``meta.json``::

    {"name": "planes", "F_px": 1055.03,
     "truths": [{"file": "truth_0.exr", "aperture_radius_m": 0.02, "focus_distance_m": 8.0, "margin_px": 20}]}

``matte.png`` or ``matte.exr``, if there is one, holds the coverage by a subject. ``F_px`` is the image distance in
pixels, also if the files show only a part of the frame. ``margin_px`` is needed only
where the largest circle of confusion lies outside the files.
"""

import dataclasses
import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from ..optics.camera import Camera
from ..validation import number

__all__ = ["Plane", "Scene", "camera_of", "plane_scene", "posts", "read_scenes", "spread_points", "waves"]

Light = Callable[[Tensor, Tensor], Tensor]
"""Linear light ``[C, ...]`` at positions x, y ``[...]``, in pixels of the frame."""

Shape = Callable[[Tensor, Tensor], Tensor]
"""Whether a surface covers positions x, y ``[...]``, in pixels of the frame: bool ``[...]``."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """A sharp image with its depth, and the truth for one setting of the lens.

    Args:
        name: Name of the scene and setting, such as ``planes/0``.
        image: ``[1, C, H, W]``, linear light, all in focus.
        depth: ``[1, 1, H, W]``, metres.
        camera: The setting of the lens.
        truth: ``[1, C, H, W]``, linear light.
        margin_px: Width of the border reached by light from outside the frame: the largest circle of confusion.
        matte: Coverage by a subject, ``[1, 1, H, W]``, or None.
    """

    name: str
    image: Tensor
    depth: Tensor
    camera: Camera
    truth: Tensor
    margin_px: int = 0
    matte: Tensor | None = None

    @property
    def coc_px(self) -> Tensor:
        """Signed circle of confusion, ``[1, 1, H, W]``."""
        return self.camera.coc_px(self.depth, self.image.shape[-1])

    @property
    def inner(self) -> Tensor:
        """Mask of the pixels inside the margin, ``[1, 1, H, W]``, bool."""
        mask, m = torch.zeros_like(self.depth, dtype=torch.bool), self.margin_px
        mask[..., m : mask.shape[-2] - m, m : mask.shape[-1] - m] = True
        return mask


def read_scenes(folder: str | os.PathLike[str]) -> Iterator[Scene]:
    """Every setting of every scene in a folder and its subfolders, sorted by name.

    Raises:
        OSError: If the folder has no scene, or a file is missing.
        ValueError: If a file is invalid; the message names it.
    """
    from ..io.images import read_image, read_values
    from ..io.matte import read_matte

    metas = sorted(Path(folder).rglob("meta.json"))
    if not metas:
        raise FileNotFoundError(f"{folder}: there is no scene here; a scene is a folder with meta.json and sharp.exr")
    for meta in metas:
        try:
            data = json.loads(meta.read_text(encoding="utf-8"))
            focal_px, truths = number("F_px", data["F_px"], 0), data["truths"]
            lenses = [
                {k: number(k, truth[k], 0) for k in ("aperture_radius_m", "focus_distance_m")} for truth in truths
            ]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{meta}: must describe a scene as torchdof.reference.scenes says; {error!r}") from None
        image, depth = read_image(meta.with_name("sharp.exr")).pixels, read_values(meta.with_name("depth.exr"))
        mattes = [path for path in map(meta.with_name, ("matte.png", "matte.exr")) if path.is_file()]
        matte = read_matte(mattes[0], image.shape[-2:]) if mattes else None
        for index, (entry, lens) in enumerate(zip(truths, lenses, strict=True)):
            truth = read_image(meta.with_name(str(entry.get("file", f"truth_{index}.exr")))).pixels
            if truth.shape != image.shape:
                raise ValueError(f"{meta}: truth {index} is {list(truth.shape)}, the sharp image {list(image.shape)}")
            name = f"{data.get('name', meta.parent.name)}/{entry.get('index', index)}"
            camera = camera_of(focal_px, image.shape[-1], *lens.values())
            largest_coc = math.ceil(float(camera.coc_px(depth, image.shape[-1]).abs().max()))
            margin_px = max(largest_coc, int(entry.get("margin_px", 0)))
            yield Scene(name, image, depth, camera, truth, margin_px, matte)


def camera_of(focal_px: float, width: int, aperture_radius_m: float, focus_m: float) -> Camera:
    """The camera of a rendered frame (or part of one) of this width, with the image distance ``focal_px`` in pixels.

    Example:
        >>> camera = camera_of(1055.0, 768, aperture_radius_m=0.02, focus_m=2.0)
        >>> round(float(camera.coc_px(torch.tensor([[[[1.0]]]]), 768)), 6)
        -10.55
    """
    fov = 2 * math.degrees(math.atan(width / (2 * focal_px)))
    return Camera.from_fov(fov_x_deg=fov, aperture_radius_m=aperture_radius_m, focus_m=focus_m)


@dataclasses.dataclass(frozen=True)
class Plane:
    """A plane parallel to the sensor that extends beyond the frame.

    Args:
        depth_m: Its distance in metres.
        light: Its texture, seen from the centre of the lens.
        shape: The area it covers; None: all of it.
    """

    depth_m: float
    light: Light
    shape: Shape | None = None

    def covers(self, x: Tensor, y: Tensor) -> Tensor:
        """Whether the plane covers positions ``[...]``, bool."""
        return torch.ones_like(x, dtype=torch.bool) if self.shape is None else self.shape(x, y)


def plane_scene(planes: Sequence[Plane], camera: Camera, size: tuple[int, int], samples: int = 1024) -> Scene:
    """Renders planes: exact except for the number of samples, because textures and shapes are known everywhere.

    A plane with circle of confusion ``c``, seen from the point ``u`` of a round lens, shows at pixel ``x`` what the
    centre of the lens sees at ``x - c u``. Pixels are box-filtered.

    Args:
        planes: In any order. The farthest must not have a shape: it has to cover the frame.
        camera: The setting of the lens.
        size: Height and width in pixels.
        samples: Points on lens and pixel, for each pixel; the sharp image uses as many on the pixel alone.

    Returns:
        The scene.

    Raises:
        ValueError: If the farthest plane has a shape.
    """
    planes = sorted(planes, key=lambda plane: -plane.depth_m)  # far to near
    if not planes or planes[0].shape is not None:
        raise ValueError("the farthest plane must have no shape: it has to cover the frame")
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) + 0.5 for n in size), indexing="ij")
    depth = torch.zeros(1, 1, *size, dtype=torch.float64)
    for plane in planes:
        depth = torch.where(plane.covers(x, y), plane.depth_m, depth)
    distances = torch.tensor([[[[plane.depth_m for plane in planes]]]], dtype=torch.float64)
    cocs = camera.coc_px(distances, size[1]).flatten().tolist()
    sharp = _average(planes, cocs, x, y, torch.zeros(samples, 2))
    truth = _average(planes, cocs, x, y, spread_points(samples))
    return Scene("planes", sharp, depth.float(), camera, truth, math.ceil(max(map(abs, cocs))))


def spread_points(count: int) -> Tensor:
    """Evenly spread points on the unit disc (a sunflower): x and y, ``[count, 2]``, float64.

    Example:
        >>> round(float(spread_points(1000).square().sum(1).mean()), 3)
        0.5
    """
    index = torch.arange(count, dtype=torch.float64)
    radius, angle = ((index + 0.5) / count).sqrt(), index * (math.pi * (3.0 - math.sqrt(5.0)))
    return torch.stack([radius * angle.cos(), radius * angle.sin()], -1)


def _average(planes: Sequence[Plane], cocs: Sequence[float], x: Tensor, y: Tensor, points: Tensor) -> Tensor:
    """Mean light ``[1, C, H, W]`` of the visible planes, seen from points ``[n, 2]`` of the unit disc of the lens.

    Planes are sorted far to near, with a signed coc each.
    """
    index = torch.arange(len(points), dtype=torch.float64)
    # Additive recurrences, so that position in the pixel and point on the lens are independent.
    shifts = torch.stack([(index * a + 0.5) % 1.0 - 0.5 for a in (0.7548776662466927, 0.5698402909980532)], -1)
    total = torch.zeros(())
    for (px, py), (ux, uy) in zip(shifts.tolist(), points.tolist(), strict=True):
        visible = torch.zeros(())
        for plane, coc in zip(planes, cocs, strict=True):
            point = x + px - coc * ux, y + py - coc * uy
            visible = torch.where(plane.covers(*point), plane.light(*point), visible)
        total = total + visible
    return (total / len(points)).float()[None]


def waves(seed: int, mean: Sequence[float] = (0.4, 0.4, 0.4), contrast: float = 0.8, shortest_px: float = 6.0) -> Light:
    """An endless texture of waves of random direction, none shorter than ``shortest_px``.

    Example:
        >>> waves(0)(torch.zeros(2, 5), torch.zeros(2, 5)).shape
        torch.Size([3, 2, 5])
    """
    generator = torch.Generator().manual_seed(seed)
    count = 12
    length = shortest_px * 8 ** torch.rand(count, generator=generator, dtype=torch.float64)
    angle, phase = 2 * math.pi * torch.rand(2, count, generator=generator, dtype=torch.float64)
    weight = torch.rand(len(mean), count, generator=generator, dtype=torch.float64)
    weight = contrast * weight / weight.sum(1, keepdim=True)
    kx, ky = 2 * math.pi / length * angle.cos(), 2 * math.pi / length * angle.sin()

    def light(x: Tensor, y: Tensor) -> Tensor:
        wave = torch.sin(x[..., None] * kx + y[..., None] * ky + phase)  # [..., count]
        return torch.stack([m * (1 + (wave * w).sum(-1)) for m, w in zip(mean, weight, strict=True)])

    return light


def posts(pitch_px: float, width_px: float, slant: float = 0.1, start_px: float = 0.0) -> Shape:
    """Upright bars with hard edges, slanted so that their edges cross the pixels everywhere.

    Example:
        >>> x = torch.tensor([0.5, 4.5, 9.5])
        >>> posts(pitch_px=8.0, width_px=3.0)(x, torch.zeros(3)).tolist()
        [True, False, True]
    """

    def shape(x: Tensor, y: Tensor) -> Tensor:
        return (x + slant * y - start_px) % pitch_px < width_px

    return shape
