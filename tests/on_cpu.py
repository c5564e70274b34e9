"""The kernels of `torchdof/kernels` on the CPU: compiled by the C++ compiler, one thread runs after the other.

So the tests run the kernels and their host code without a GPU.
"""

import ctypes
import functools
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from torchdof.kernels import layers

ROOT = Path(__file__).parents[1]
COMPILER = os.environ.get("CXX") or shutil.which("c++")
_SOURCES = [ROOT / "torchdof" / "kernels", ROOT / "torchdof" / "native" / "src"]

_BEFORE = """
#define __global__
#define __device__
#define __grid_constant__
struct Index { int x, y, z; };
static thread_local Index blockIdx, threadIdx;
#include "layers.cu"
template <typename Kernel>
static void launch(Kernel kernel, const Index &grid, const Index &block, const Run &run) {
  for (blockIdx.z = 0; blockIdx.z < grid.z; blockIdx.z++)
    for (blockIdx.y = 0; blockIdx.y < grid.y; blockIdx.y++)
      for (blockIdx.x = 0; blockIdx.x < grid.x; blockIdx.x++)
        for (threadIdx.y = 0; threadIdx.y < block.y; threadIdx.y++)
          for (threadIdx.x = 0; threadIdx.x < block.x; threadIdx.x++) kernel(run);
}
"""
_OF_KERNEL = """
extern "C" void run_{0}(const Index *grid, const Index *block, const Run *run) {{ launch({0}, *grid, *block, *run); }}
"""
_OPTIONS = ("-std=c++17", "-O3", "-march=native", "-shared", "-fPIC", "-Wno-unknown-pragmas")


class _Index(ctypes.Structure):
    _fields_ = [(name, ctypes.c_int) for name in "xyz"]


@functools.cache
def module(channels: int, surfaces: int, stacked: bool, device: int = 0) -> layers.Launch:
    """As :func:`torchdof.kernels.layers.module`, for the CPU. The library is kept for other processes of a test run."""
    source = (_SOURCES[0] / "layers.cu").read_text()
    kernels = re.findall(r'^extern "C" __global__ void (\w+)\(', source, re.MULTILINE)
    program = _BEFORE + "".join(map(_OF_KERNEL.format, kernels))
    given = [*_OPTIONS, *layers.options(channels, surfaces, stacked)]
    headers = [file.read_text() for file in sorted(_SOURCES[1].glob("*.h"))]
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
    loaded = ctypes.CDLL(str(library))

    def launch(kernel: str, grid: Sequence[int], block: Sequence[int], argument: ctypes.Structure) -> None:
        getattr(loaded, f"run_{kernel}")(*map(ctypes.byref, (_Index(*grid), _Index(*block), argument)))

    return launch
