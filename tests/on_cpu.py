"""The kernels of `torchdof/kernels` on the CPU: compiled by the C++ compiler, one thread runs after the other.

So the tests run the kernels and their host code without a GPU.
"""

import contextlib
import ctypes
import functools
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from torchdof.kernels import edges, layers, loader, matting

ROOT = Path(__file__).parents[1]
COMPILER = os.environ.get("CXX") or shutil.which("c++")
_SOURCES = [ROOT / "torchdof" / "kernels", ROOT / "torchdof" / "native" / "src"]

_BEFORE = """
#include <cmath>
#define __global__
#define __device__
#define __grid_constant__
#define __launch_bounds__(threads)
struct Index { int x, y, z; };
static thread_local Index blockIdx, threadIdx;
#include SOURCE
template <typename Kernel>
static void launch(Kernel kernel, const Index &grid, const Index &block, const Run &run) {
  for (blockIdx.z = 0; blockIdx.z < grid.z; blockIdx.z++)
    for (blockIdx.y = 0; blockIdx.y < grid.y; blockIdx.y++)
      for (blockIdx.x = 0; blockIdx.x < grid.x; blockIdx.x++)
        for (threadIdx.y = 0; threadIdx.y < block.y; threadIdx.y++)
          for (threadIdx.x = 0; threadIdx.x < block.x; threadIdx.x++) kernel(run);
}
"""

# Functions of the CUDA driver: a "function" is a kernel, the only parameter of which is a Run.
_DRIVER = """
#include <cstring>
typedef void (*Kernel)(Run);
static const struct { const char *name; Kernel kernel; } KERNELS[] = {%s};
extern "C" int cuModuleLoadData(const void **module, const void *image) {
  *module = KERNELS;
  return image ? 0 : 1;
}
extern "C" int cuModuleGetFunction(Kernel *function, const void *module, const char *name) {
  for (const auto &each : KERNELS)
    if (module == KERNELS && !strcmp(each.name, name)) {
      *function = each.kernel;
      return 0;
    }
  return 500;
}
extern "C" int cuLaunchKernel(Kernel function, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by,
                              unsigned bz, unsigned shared, void *stream, void **parameters, void **extra) {
  if (shared || extra || bz != 1 || stream != (void *)7) return 1;
  launch(function, {(int)gx, (int)gy, (int)gz}, {(int)bx, (int)by, 1}, *(const Run *)parameters[0]);
  return 0;
}
extern "C" int cuGetErrorString(int status, const char **text) {
  *text = status == 500 ? "named symbol not found" : "invalid argument";
  return 0;
}
"""
STREAM = 7  # the only one of this driver
OTHER_PICTURE = "on this device they render another picture than PyTorch"  # of the warning after a trial
_OPTIONS = ("-std=c++17", "-march=native", "-shared", "-fPIC", "-Wno-unknown-pragmas")


@functools.cache
def driver(name: str, *options: str) -> ctypes.CDLL:
    """A driver with the kernels of a source and the compiler's options, kept for the other processes of a run."""
    source = (_SOURCES[0] / name).read_text()
    kernels = re.findall(r'^extern "C" __global__ void (?:__launch_bounds__\(.*?\) )?(\w+)\(', source, re.MULTILINE)
    program = _BEFORE + _DRIVER % ", ".join(f'{{"{name}", {name}}}' for name in kernels)
    given = [*_OPTIONS, f'-DSOURCE="{name}"', *options]
    headers = [file.read_text() for folder in _SOURCES for file in sorted(folder.glob("*.h"))]
    constants = (ROOT / "cmake" / "constants.py").read_text()
    key = hashlib.sha256("\0".join([source, program, *given, *headers, constants]).encode()).hexdigest()
    folder = Path(tempfile.gettempdir()) / f"torchdof_kernels_{key[:16]}"
    library = folder / "kernels.so"
    if not library.exists():
        with tempfile.TemporaryDirectory() as made:
            path = Path(made)
            subprocess.run([sys.executable, ROOT / "cmake" / "constants.py", path / "constants"], check=True)
            (path / "kernels.cpp").write_text(program)
            includes = [f"-I{each}" for each in (*_SOURCES, path)]
            command = [COMPILER or "c++", *given, *includes, "kernels.cpp", "-o", "kernels.so"]
            subprocess.run(command, check=True, cwd=path)
            folder.mkdir(exist_ok=True)
            shutil.copy(path / "kernels.so", unfinished := folder / f"{os.getpid()}.so")
            unfinished.replace(library)
    return ctypes.CDLL(str(library))


def _module(name: str, *options: str) -> loader.Launch:
    return loader.Module(driver(name, *options), b"program", lambda: contextlib.nullcontext(STREAM))


def layers_module(channels: int, surfaces: int, stacked: bool, device: int = 0) -> loader.Launch:
    """As :func:`torchdof.kernels.layers.module`, with that driver."""
    return _module("layers.cu", "-O3", *layers.options(channels, surfaces, stacked))


def matting_module(channels: int, device: int = 0) -> loader.Launch:
    """As :func:`torchdof.kernels.matting.module`, with that driver."""
    return _module("matting.cu", "-O1", *matting.options(channels))


def edges_module(channels: int, device: int = 0) -> loader.Launch:
    """As :func:`torchdof.kernels.edges.module`, with that driver."""
    return _module("edges.cu", "-O3", *edges.options(channels))


def rays_module(device: int = 0) -> loader.Launch:
    """As :func:`torchdof.kernels.rays.module`, with that driver."""
    return _module("rays.cu", "-O3")


@contextlib.contextmanager
def new_memory_of_nan() -> Iterator[None]:
    """A block in which new memory is NaN, so that what a kernel does not write is never right by chance."""
    torch.use_deterministic_algorithms(True)
    try:
        assert torch.empty(1).isnan()
        yield
    finally:
        torch.use_deterministic_algorithms(False)


def without(wrong: str, module: Callable[..., loader.Launch]) -> Callable[..., loader.Launch]:
    """A module of which one kernel is not launched, as on a device on which it fails."""

    def other(*variant: Any) -> loader.Launch:
        launch = module(*variant)
        return lambda kernel, *arguments: None if kernel == wrong else launch(kernel, *arguments)

    return other
