"""The samples of ``examples/embed`` give the pixels that onnxruntime in Python gives for the same file."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from tests.node import NEEDS_NODE, NODE_FOLDER, ROOT, linear, needs, pixels, run, srgb_codes
from torchdof.depth import from_relative

DATA = ROOT / "examples" / "data" / "motorcycle"
EMBED = ROOT / "examples" / "embed"
FOCUS_M, F_NUMBER = 2.3, 1.2
DISPARITY = json.loads((DATA / "camera.json").read_text())["depth"]


def header_folder() -> Path | None:
    """The folder with onnxruntime's C++ headers, which the PyPI and npm packages do not include."""
    folders = [Path(os.environ["TORCHDOF_ONNXRUNTIME"], "include")] if "TORCHDOF_ONNXRUNTIME" in os.environ else []
    folders += [Path(root, "include", "onnxruntime") for root in ("/usr", "/usr/local")]
    return next((folder for folder in folders if (folder / "onnxruntime_cxx_api.h").is_file()), None)


def write(path: Path, values: np.ndarray) -> Path:
    assert oiio.ImageBuf(np.ascontiguousarray(values)).write(str(path))
    return path


def crop() -> tuple[np.ndarray, np.ndarray]:
    """A piece of the photograph, 8-bit sRGB ``[H, W, 3]``, and its depth in whole millimetres ``[H, W, 1]``."""
    piece = np.s_[150:246, 300:428]
    disparity = np.load(DATA / "motorcycle_disp.npz")["arr_0"][piece][..., None]
    depth_mm = np.where(np.isfinite(disparity), 1000 * DISPARITY["scale"] / (disparity + DISPARITY["offset"]), 0)
    photo = np.rint(255 * pixels(DATA / "motorcycle_left.png")[piece])
    return photo.astype(np.uint8), np.rint(depth_mm).astype(np.uint16)


def area_means(old: int, new: int) -> np.ndarray:
    """``[new, old]``: weight of each old pixel in the mean that is a new pixel."""
    return np.kron(np.eye(new), np.ones(old)).reshape(new, old, new).sum(2) / old


def rendered(exported: Any, light: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """The file's output for ``[H, W, 3]`` light and ``[H, W, 1]`` metres, by onnxruntime in Python."""
    image, depth = (torch.tensor(x.transpose(2, 0, 1)[None], dtype=torch.float32) for x in (light, depth_m))
    out = exported.render(image, depth, torch.tensor([FOCUS_M]), torch.tensor([F_NUMBER]))
    return out[0].numpy().transpose(1, 2, 0)


def test_python_needs_no_torch(plain: Any, tmp_path: Path) -> None:
    (tmp_path / "torch.py").write_text("raise ImportError('torch was imported')")
    (tmp_path / "torchdof.py").write_text("raise ImportError('torchdof was imported')")
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    check = subprocess.run([sys.executable, "-c", "import torch"], env=environment, capture_output=True, text=True)
    assert "torch was imported" in check.stderr
    call = [sys.executable, EMBED / "run_onnx.py", plain.path, DATA / "motorcycle_left.png"]
    call += [DATA / "motorcycle_disp.npz", tmp_path / "out.png", "--focus-m", FOCUS_M, "--f-number", F_NUMBER]
    call += ["--disparity-scale", DISPARITY["scale"], "--disparity-offset", DISPARITY["offset"]]
    output = run(call, environment)
    assert "741 x 500" in output and "'disc'" in output
    sharp, blurred = (pixels(path)[..., :3] for path in (DATA / "motorcycle_left.png", tmp_path / "out.png"))
    assert sharp.shape == blurred.shape
    assert 0.002 < np.abs(sharp - blurred).mean() < 0.2


def test_python_reads_depth_in_a_png_as_the_javascript_sample_does(plain: Any, tmp_path: Path) -> None:
    photo, depth_mm = crop()
    write(tmp_path / "photo.png", photo)
    half = write(tmp_path / "half.png", depth_mm[::2, ::2])
    small = np.repeat(np.repeat(depth_mm[::2, ::2], 2, 0), 2, 1).astype(np.float64)
    share = (small - small.min()) / (small.max() - small.min())
    metres = {
        "--scale 0.001": np.where(small > 0, small / 1000, np.nan),
        "--near-m 1 --far-m 5": 1 / (share / 1 + (1 - share) / 5),
    }
    for options, expected in metres.items():
        call = [sys.executable, EMBED / "run_onnx.py", plain.path, tmp_path / "photo.png", half, tmp_path / "out.png"]
        run([*call, "--focus-m", FOCUS_M, "--f-number", F_NUMBER, *options.split()])
        value = rendered(plain, linear(photo / 255), expected)
        difference = np.abs(np.rint(255 * pixels(tmp_path / "out.png")[..., :3]) - srgb_codes(value))
        assert difference.max() <= 1 and (difference > 0).mean() < 1e-3


@needs("onnxruntime-web")
def test_javascript_gives_the_pixels_of_the_file(plain: Any, tmp_path: Path) -> None:
    shutil.copytree(EMBED / "javascript", tmp_path / "sample")
    (tmp_path / "sample" / "node_modules").symlink_to(NODE_FOLDER / "node_modules")
    photo, depth_mm = crop()
    call = ["node", tmp_path / "sample" / "run_onnx.mjs", plain.path, write(tmp_path / "photo.png", photo)]
    call += [write(tmp_path / "depth.png", depth_mm), tmp_path / "out.png"]
    call += ["--focus-m", FOCUS_M, "--f-number", F_NUMBER, "--scale", 0.001]
    assert "128 x 96" in run(call)
    value = rendered(plain, linear(photo / 255), np.where(depth_mm > 0, depth_mm / 1000, np.nan))
    difference = np.abs(np.rint(255 * pixels(tmp_path / "out.png")[..., :3]) - srgb_codes(value))
    assert difference.max() <= 1 and (difference > 0).mean() < 1e-3


@NEEDS_NODE
def test_javascript_decodes_resizes_and_scales_as_python_does(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    rgba = generator.integers(0, 256, (6, 10, 4), np.uint8)
    values = generator.uniform(3, 9, (4, 5))
    (tmp_path / "rgba.bin").write_bytes(rgba.tobytes())
    np.save(tmp_path / "depth.npy", values)
    got = json.loads(run(["node", ROOT / "tests" / "examples" / "modules.mjs", tmp_path]))

    light = linear(rgba[..., :3] / 255).transpose(2, 0, 1)
    np.testing.assert_allclose(np.reshape(got["light"], light.shape), light, atol=1e-6)
    expected = area_means(6, 3) @ light @ area_means(10, 4).T
    np.testing.assert_allclose(np.reshape(got["smaller"], expected.shape), expected, atol=1e-6)
    assert got["codes"] == [255 if i % 4 == 3 else i // 4 for i in range(1024)]
    assert got["beyond"] == [0, 255, 0, 255]
    assert got["png"] == rgba.flatten().tolist()

    assert got["size"] == [5, 4]
    np.testing.assert_allclose(got["values"], values.flatten(), rtol=1e-6)
    for kind in ("disparity", "depth"):
        expected = from_relative(torch.from_numpy(values)[None, None], 1.0, 5.0, kind).flatten()
        np.testing.assert_allclose(got[kind], expected, rtol=1e-5)
    assert got["resized"] == [1, 1, 2, 2, 3, 3, 4, 4, 3, 3, 4, 4]
    assert got["holes"] == [2, 5, 5, 2, 5, 5, 1, 1, 1, 1, 1, 1] and got["share"] == 9 / 12
    assert "greater than the nearest, got 5 m to 1 m" in got["wrongWay"]
    assert "PNG file or a NumPy array" in got["noFile"] and "damaged" in got["cut"]


@pytest.mark.skipif(
    header_folder() is None,
    reason="onnxruntime's C++ headers are not installed: libonnxruntime-dev of Debian 13, or an unpacked release in "
    "TORCHDOF_ONNXRUNTIME",
)
@pytest.mark.skipif(shutil.which("cmake") is None or shutil.which("c++") is None, reason="no CMake or C++ compiler")
def test_cpp_gives_the_pixels_of_the_file(plain: Any, tmp_path: Path) -> None:
    spec = importlib.util.find_spec("onnxruntime")
    assert spec is not None and spec.origin is not None
    (library,) = Path(spec.origin).parent.glob("capi/libonnxruntime.so.*")
    release = tmp_path / "onnxruntime"  # the folders of a release: headers of this machine, library from PyPI
    (release / "lib").mkdir(parents=True)
    (release / "include").symlink_to(str(header_folder()))
    for name in ("libonnxruntime.so", "libonnxruntime.so.1"):
        (release / "lib" / name).symlink_to(library)
    configure = ["cmake", "-S", EMBED / "cpp", "-B", tmp_path / "build", f"-DONNXRUNTIME={release}"]
    run([*configure, "-DCMAKE_CXX_FLAGS=-Wall -Wextra -Werror"])
    run(["cmake", "--build", tmp_path / "build"])
    photo, depth_mm = crop()
    light, depth_m = linear(photo / 255), np.where(depth_mm > 0, depth_mm / 1000, np.nan).astype(np.float32)
    call = [str(tmp_path / "build" / "run_onnx"), str(plain.path), str(write(tmp_path / "image.pfm", light))]
    call += [str(write(tmp_path / "depth.pfm", depth_m)), str(tmp_path / "out.pfm"), str(FOCUS_M), str(F_NUMBER)]
    assert "128 x 96" in run(call)
    out = np.frombuffer((tmp_path / "out.pfm").read_bytes()[-light.nbytes :], "<f4").reshape(light.shape)[::-1]
    np.testing.assert_allclose(out, rendered(plain, light, depth_m), atol=1e-6)
    refused = subprocess.run([*call[:3], str(EMBED / "README.md"), *call[4:]], capture_output=True, text=True)
    assert refused.returncode == 1 and "README.md is not a little-endian PFM file" in refused.stderr
