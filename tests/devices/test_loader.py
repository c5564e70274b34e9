"""NVRTC compiles the kernels for all devices, a program is kept, and the driver is called as it must be.

The driver of these tests is a library that launches the kernels' C++ build; no GPU is needed.
"""

import contextlib
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from tests import on_cpu
from torchdof.kernels import edges, layers, loader, matting

CUDA = "12.9"


def has_nvrtc() -> bool:
    try:
        return bool(loader.nvrtc(CUDA))
    except OSError:
        return False


NEEDS_NVRTC = pytest.mark.skipif(not has_nvrtc(), reason="NVRTC of CUDA 12 is not installed")
VARIANTS = {
    ("layers.cu", "image"): layers.options(3, 2, False),
    ("layers.cu", "largest"): layers.options(loader.MOST_CHANNELS, layers.MOST_SURFACES, True),
    ("matting.cu", "image"): matting.options(3),
    ("matting.cu", "largest"): matting.options(loader.MOST_CHANNELS),
    ("edges.cu", "image"): edges.options(3),
    ("edges.cu", "largest"): edges.options(loader.MOST_CHANNELS),
    ("rays.cu", "image"): [],
}
THREADS = {"composite": 128, "convolve_back": 128, "sum_rows": 32}  # of a block


@NEEDS_NVRTC
@pytest.mark.parametrize(
    ("source", "variant", "capability"),
    [
        *(("layers.cu", "image", capability) for capability in (75, 80, 90, 120)),
        ("layers.cu", "largest", 75),
        *(("matting.cu", "image", capability) for capability in (75, 90, 120)),
        ("matting.cu", "largest", 80),
        *(("edges.cu", "image", capability) for capability in (75, 90, 120)),
        ("edges.cu", "largest", 80),
        *(("rays.cu", "image", capability) for capability in (75, 90, 120)),
    ],
)
def test_kernels_compile_for_every_device_without_spills(source: str, variant: str, capability: int) -> None:
    text = loader.text(source)
    image, log = loader.compile_program(text, [*VARIANTS[source, variant], "--ptxas-options=-v"], capability, CUDA)
    if not image.startswith(b"\x7fELF"):
        pytest.skip(f"this NVRTC does not know devices of compute capability {capability / 10}")
    kernels = re.findall(r"(\w+)\(const __grid_constant__ Run r\)", text)
    compiled = re.findall(r"Compiling entry function '(\w+)'", log)
    assert sorted(compiled) == sorted(kernels)
    moved = re.findall(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads", log)
    assert moved == [("0", "0", "0")] * len(kernels), log
    registers = dict(zip(compiled, map(int, re.findall(r"Used (\d+) registers", log)), strict=True))
    for kernel, count in registers.items():  # of a block of threads
        threads = THREADS.get(kernel, 512 if source == "layers.cu" else 128)
        assert threads * count <= 65536, f"{kernel}: {count} registers"


@NEEDS_NVRTC
def test_a_newer_device_gets_ptx_and_an_older_one_is_refused() -> None:
    source = 'extern "C" __global__ void nothing() {}'
    image, _ = loader.compile_program(source, [], 990, CUDA)
    assert b".target compute" in image or b".target sm_" in image
    with pytest.raises(RuntimeError, match=r"the device has compute capability 1.3, NVRTC 12.9 needs \d.\d or more"):
        loader.compile_program(source, [], 13, CUDA)
    with pytest.raises(RuntimeError, match="NVRTC 12.9 cannot compile the kernels: (.|\n)*undefined"):
        loader.compile_program('extern "C" __global__ void wrong() { nowhere(); }', [], 90, CUDA)


def test_nvrtc_is_found_in_packages_and_its_absence_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loader.sysconfig, "get_path", lambda name: str(tmp_path))
    loader.nvrtc.cache_clear()
    for platform, file in (("linux", "lib/libnvrtc.so.13"), ("win32", "bin/nvrtc64_130_0.dll")):
        monkeypatch.setattr(sys, "platform", platform)
        for part in ("cuda_nvrtc", "cu13"):
            path = tmp_path / "nvidia" / part / file
            path.parent.mkdir(parents=True)
            path.write_text("")
            assert str(path) in loader._candidates("13.0")
    monkeypatch.setattr(loader, "_candidates", lambda version: [str(tmp_path / "libnvrtc.so.13")])
    with pytest.raises(OSError, match="NVRTC of CUDA 13.0 was not found beside PyTorch"):
        loader.nvrtc("13.0")
    loader.nvrtc.cache_clear()


@pytest.fixture
def compilations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Sources that were compiled; the program of each is its text."""
    found: list[str] = []

    def compile_program(source: str, *how: Any) -> tuple[bytes, str]:
        found.append(source)
        return source.encode(), ""

    def version(major: Any, minor: Any) -> None:
        major._obj[0], major._obj[1] = 12, 9

    monkeypatch.setattr(loader, "compile_program", compile_program)
    monkeypatch.setattr(loader, "nvrtc", lambda version_of: SimpleNamespace(nvrtcVersion=version))
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.setenv(name, str(tmp_path / "cache"))
    return found


def test_a_program_is_kept_and_compiled_anew_if_it_is_damaged(compilations: list[str], tmp_path: Path) -> None:
    def compiled(source: str = "first", capability: int = 90) -> bytes:
        return loader.compiled(source, ["-DA=1"], capability, CUDA)

    assert compiled() == compiled() == b"first"
    assert compilations == ["first"]
    compiled(capability=80)
    assert compiled("second") == b"second" and len(compilations) == 3
    for file in (tmp_path / "cache" / "torchdof").iterdir():
        file.write_bytes(file.read_bytes()[:-1])
    assert compiled() == b"first" and len(compilations) == 4
    assert compiled() == b"first" and len(compilations) == 4


def test_a_folder_that_cannot_be_written_is_no_error(compilations: list[str], tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("not a folder")
    assert loader.compiled("first", [], 90, CUDA) == b"first"


def test_an_error_of_the_driver_is_an_error_that_names_it() -> None:
    if on_cpu.COMPILER is None:
        pytest.skip("there is no C++ compiler")
    driver, argument = on_cpu.driver("layers.cu", "-O3", *layers.options(3, 2, False)), layers.argument_type(2)()
    launch = loader.Module(driver, b"program", lambda: contextlib.nullcontext(on_cpu.STREAM))
    with pytest.raises(RuntimeError, match="the CUDA driver reports 'named symbol not found', error 500"):
        launch("nowhere", (1, 1, 1), (32, 16, 1), argument)
    launch = loader.Module(driver, b"program", lambda: contextlib.nullcontext(on_cpu.STREAM + 1))
    with pytest.raises(RuntimeError, match="the CUDA driver reports 'invalid argument', error 1"):
        launch("composite", (1, 1, 1), (32, 4, 1), argument)


def test_without_cuda_the_reason_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", None)
    with pytest.raises(RuntimeError, match="this PyTorch is not built for CUDA"):
        loader.on_device("", [], 0)
