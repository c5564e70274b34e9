"""Targets of the fuzzer: every reader of files, with valid inputs.

A reader may refuse a file by an error of ``REFUSED``, one sentence that names the file. Everything else is a finding.
"""

import dataclasses
import functools
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenImageIO as oiio
import torch

from tests.files import spec_with, store_model, store_parts
from tests.fit.lens.test_zmx import HEAD, SINGLET
from tests.scenes import lens_with_a_field
from torchdof import BlurTable, blur_by_coc
from torchdof.depth import read_depth
from torchdof.export import describe
from torchdof.fit import FitError, read_captures
from torchdof.fit.lens.lens import Lens
from torchdof.fit.lens.spot import focus_sensor, point_spread
from torchdof.io.images import Picture, read_image, read_values, write_image
from torchdof.io.metadata import camera_settings
from torchdof.optics.aperture import Aperture

REFUSED = (ValueError, OSError, FitError)


class Target(NamedTuple):
    """Valid files of one suffix, and their readers."""

    suffix: str
    seeds: Callable[[Path], None]  # writes files into a folder
    runs: tuple[Callable[[Path], object], ...]


def _image_seeds(folder: Path, suffix: str) -> None:
    pixels = torch.linspace(0, 1, 4 * 6 * 7).reshape(1, 4, 6, 7)
    rgb = Picture(pixels[:, :3], ("R", "G", "B"))
    for sample in {".png": ("8", "16"), ".exr": ("half", "float"), ".tif": ("8", "float")}.get(suffix, (None,)):
        write_image(folder / f"rgb{sample}{suffix}", rgb, sample=sample)  # type: ignore[arg-type]
    if suffix in (".png", ".exr", ".tif"):
        write_image(folder / f"alpha{suffix}", Picture(pixels, ("R", "G", "B", "A")))
    if suffix == ".exr":
        for name, parts in EXR.items():
            store_parts(folder / f"{name}.exr", parts)
    if suffix == ".jpg":
        tags = {name: ("float", 2.0) for name in ("Exif:FocalLength", "FNumber", "Exif:SubjectDistance")}
        write_image(folder / "exif.jpg", dataclasses.replace(rgb, metadata=tags))


def _part(channels: str = "RGBZ", places: str = "", **attributes: Any) -> tuple[oiio.ImageSpec, np.ndarray]:
    values = np.linspace(0.1, 1, 256 * len(channels), dtype=np.float32).reshape(16, 16, len(channels))
    spec = spec_with(values, "half", tuple(channels), **attributes)
    for place in places.split():
        name, _, number = place.partition("=")
        setattr(spec, name, int(number))
    return spec, values


TILES = "tile_width=16 tile_height=16"
EXR = {
    "tiled": [_part(places=TILES)],
    "mipmap": [_part(places=TILES, openexr__levelmode=1, textureformat="Plain Texture")],
    "window": [_part(places="x=-3 y=-5 full_x=0 full_y=0 full_width=8 full_height=8")],
    "parts": [_part("RGB", name="beauty"), _part("Z", name="depth")],
}


def _read_image(path: Path) -> None:
    found = read_image(path)
    assert torch.isfinite(found.pixels).all(), "pixels that are not finite"
    camera_settings(found.metadata, found.pixels.shape[-1], found.pixels.shape[-2])


def _array_seeds(folder: Path, suffix: str) -> None:
    for number, kind in enumerate(("<f4", ">f8", "<u2", "<f2")):
        values = np.linspace(1, 2, 12).reshape(3, 4).astype(kind)
        if suffix == ".npy":
            np.save(folder / f"{number}.npy", values)
        else:
            (np.savez_compressed if number % 2 else np.savez)(folder / f"{number}.npz", depth=values)


def _read_array(path: Path, fill: Any) -> None:
    assert bool((read_depth(path, fill=fill) > 0).all()), "a depth of 0 or less"


def _table_seeds(folder: Path) -> None:
    for name in ("sato_j15", "wide_22mm_f4"):
        BlurTable.load(name).save(folder / f"{name}.json")
    soft = {"radius": [0.01, 0.02], "sigma": [0.003, 0.001], "b": [1.0, 0.0], "m": [2.0, 8.0]}
    BlurTable("softm", [-0.01, 0.02], soft, unit="mm", sensor_width_mm=36.0).save(folder / "soft.json")
    BlurTable.polygon(5, 12.0, 0.3, squeeze=1.5, vignetting=(0.3, 0.1)).save(folder / "polygon.json")
    opening = Aperture(rotation_deg=30.0, mask=torch.eye(5), vignetting=0.5)
    BlurTable.gaussian().replace(aperture=opening).save(folder / "mask.json")


def _read_table(path: Path) -> None:
    table = BlurTable.load(path)
    for width in (10, 640):
        try:
            kernels = table.kernels(torch.tensor([-5.0, -0.6, 0.0, 1.0, 9.0]), width, size=9)
        except ValueError as error:
            assert "at most" in str(error) or "passes no light" in str(error), f"read, but: {error}"
        else:
            assert torch.isfinite(kernels).all() and float(kernels.min()) >= 0, "kernels not finite, or negative"


def _field_seeds(folder: Path) -> None:
    """Tables with small fields; in files of large ones nearly every mutation would hit the light of one spot."""
    for colours in (1, 3):
        lens_with_a_field(colours).save(folder / f"{colours}.json")


def _read_field(path: Path) -> None:
    table = BlurTable.load(path)
    if table.channels not in (1, 3):
        return
    image = torch.linspace(0, 1, 3 * 12 * 16).reshape(1, 3, 12, 16)
    image[..., 6, 8] = 50.0
    coc = torch.linspace(-3, 4, 16).expand(1, 1, 12, 16)
    pictures = []
    for engine in ("torch", "native"):
        os.environ["TORCHDOF_ENGINE"] = engine
        pictures.append(blur_by_coc(image, coc, table=table, tolerance="preview"))
        assert torch.isfinite(pictures[-1]).all(), "read, but the picture is not finite"
        assert float(pictures[-1].max()) <= 60.0 and float(pictures[-1].min()) >= -1e-3, "brighter than its light"
    assert float((pictures[0] - pictures[1]).abs().max()) <= 1e-3 * 50.0, "the engines differ"


def _manifest_seeds(folder: Path) -> None:
    (folder / "capture.toml").write_text(
        'focus_m = 0.5\nsharp = "sharp.png"\nfocal_length_mm = 50.0\nf_number = 2.8\nsensor_width_mm = 36.0\n'
        'transfer = "srgb"\ndark = "dark.png"\nexposure_s = 0.02\ndots = "one"\nname = "my lens"\n\n'
        '[[shot]]\nfile = "near.png"\ndistance_m = 0.4\nexposure_s = 0.02\n\n'
        '[[shot]]\nfile = "far.png"\ndistance_m = 0.9\n'
    )


def _lens_seeds(folder: Path) -> None:
    for name in ("wide_22mm", "double_gauss_50mm", "telephoto_250mm"):
        lens = Lens.read(name)
        (folder / f"{name}.txt").write_text("\n".join([f"# source: {lens.source}", *lens.lines()]) + "\n")


def _zmx_seeds(folder: Path) -> None:
    for encoding in ("utf-16", "utf-8"):
        (folder / f"{encoding}.zmx").write_text(HEAD.format("MM") + SINGLET, encoding=encoding)


def _read_lens(path: Path) -> None:
    lens = Lens.read(path)
    try:
        sensor_mm = focus_sensor(lens, 2.0)
        spot = point_spread(lens, 1.0, sensor_mm, field_mm=1.0, rays=200)
    except ValueError as error:
        assert any(word in str(error) for word in ("lens", "focus", "object")), f"read, but: {error}"
    else:
        for numbers in (sensor_mm, spot.x, spot.y, spot.weight, spot.centre, spot.pupil_mm2):
            assert np.isfinite(numbers).all(), "rays that are not finite"


def _onnx_seeds(folder: Path) -> None:
    facts: dict[str, Any] = {"options": {"tolerance": 0.1}, "camera": {"f_number": 2.0}, "width": None, "layers": 9}
    store_model(folder / "dof.onnx", {f"torchdof.{key}": json.dumps(value) for key, value in facts.items()})


_FILLS = tuple(functools.partial(_read_array, fill=fill) for fill in ("far", 3.0, None))
TARGETS: dict[str, Target] = {
    **{suffix[1:]: Target(suffix, functools.partial(_image_seeds, suffix=suffix), (_read_image, read_values))
       for suffix in (".png", ".exr", ".tif", ".jpg", ".hdr", ".pfm")},
    **{suffix[1:]: Target(suffix, functools.partial(_array_seeds, suffix=suffix), _FILLS)
       for suffix in (".npy", ".npz")},
    "table": Target(".json", _table_seeds, (_read_table,)),
    "manifest": Target(".toml", _manifest_seeds, (lambda path: read_captures(path, root=path.parent),)),
    "field": Target(".json", _field_seeds, (_read_field,)),
    "lens": Target(".txt", _lens_seeds, (_read_lens,)),
    "zmx": Target(".zmx", _zmx_seeds, (_read_lens,)),
    "onnx": Target(".onnx", _onnx_seeds, (describe,)),
}  # fmt: skip
