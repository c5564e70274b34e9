"""Compile CUDA C with the NVRTC that PyTorch brings along, and launch it on PyTorch's stream, by ctypes alone."""

import contextlib
import ctypes
import functools
import glob
import hashlib
import importlib.resources
import os
import re
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

_CONSTANTS = (
    *("composite", "disocclusion", "edge_colours", "edge_prior", "edge_search"),
    *("frame", "layer_weights", "matting", "windows"),
)
HEADERS = (
    *("frame.h", "weights.h", "matting.h", "split.h", "pixel.h"),
    *("edge_rules.h", "mixed_pixel.h", "mixture.h", "rules.h", "numbers.h"),
    *(f"constants/{name}.h" for name in _CONSTANTS),
)
"""Files beside this one that kernels include; the build installs those that the compiled engine includes too."""

_NO_STANDARD_LIBRARY = {"cstdint": "typedef long long int64_t;\ntypedef unsigned int uint32_t;\n"}
_OPTIONS = ("--std=c++17", "--device-as-default-execution-space")

MOST_CHANNELS, MOST_ITEMS = 8, 4000  # of a launch

_TILE_ROWS, TILE_COLUMNS = 4, 32  # of a block of threads, as in pixel.h

Launch = Callable[[str, Sequence[int], Sequence[int], ctypes.Structure], None]
"""``launch(kernel, grid, block, argument)``."""


def text(name: str) -> str:
    """Text of a source or a header."""
    return (importlib.resources.files(__package__) / name).read_text(encoding="utf-8")


def structure(source: str, sizes: dict[str, int]) -> type[ctypes.Structure]:
    """The structure ``Run`` of a source, one member a line: the argument of its kernels.

    ``sizes`` are the lengths of its arrays, by their names.
    """
    body = re.search(r"struct Run {\n(.*?)\n};", source, re.DOTALL)
    assert body is not None
    fields: list[tuple[str, Any]] = []
    for kind, name, size in re.findall(r"^  (?:const )?([\w ]+ ?\*?)\b(\w+)(?:\[(\w+)\])?;", body[1], re.MULTILINE):
        of_one: Any = ctypes.c_void_p if "*" in kind else ctypes.c_int
        fields.append((name, of_one * sizes[size] if size else of_one))
    return type("Run", (ctypes.Structure,), {"_fields_": fields})


def pointer(values: Tensor | None) -> int | None:
    """The address of a tensor's memory, for a member of the structure; None for None."""
    return None if values is None else values.data_ptr()


def options(channels: int) -> list[str]:
    """The compiler's options for the kernels of :func:`by_channels`."""
    return [f"-DCHANNELS={channels}"]


def by_channels(source: str) -> Callable[[int, int], Launch]:
    """``module(channels, device)``: the kernels of a source for light of some channels, compiled for a CUDA device."""
    return functools.cache(lambda channels, device: on_device(text(source), options(channels), device))


def frame_grid(like: Tensor) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """Grid and block of a launch with a thread for each pixel of a map ``[B, ..., H, W]``, as ``pixel.h`` reads it."""
    height, width = like.shape[-2:]
    return (-(-width // TILE_COLUMNS), -(-height // _TILE_ROWS), len(like)), (TILE_COLUMNS, _TILE_ROWS, 1)


def _candidates(version: str) -> Iterator[str]:
    """Paths at which NVRTC of CUDA, such as "12.8", may be: in packages of pip and conda, or the system's."""
    major = version.partition(".")[0]
    if sys.platform == "win32":
        folders, pattern, name = ("bin", "bin/x86_64", "lib"), f"nvrtc64_{major}0_0.dll", f"nvrtc64_{major}0_0.dll"
    else:
        folders, pattern, name = ("lib",), f"libnvrtc.so.{major}*", f"libnvrtc.so.{major}"
    packages = [sysconfig.get_path("purelib"), str(Path(torch.__file__).parents[1])]
    roots = [f"{package}/nvidia/{part}" for package in packages for part in ("cuda_nvrtc", f"cu{major}")]
    roots += [f"{package}/torch" for package in packages] + [sys.prefix, f"{sys.prefix}/Library"]
    for root in roots:
        for folder in folders:
            yield from sorted(glob.glob(f"{root}/{folder}/{pattern}"))
    yield name


@functools.cache
def nvrtc(version: str) -> ctypes.CDLL:
    """NVRTC for a version of CUDA.

    Raises:
        OSError: If it is not found.
    """
    for path in _candidates(version):
        with contextlib.suppress(OSError):
            return ctypes.CDLL(path)
    raise OSError(f"NVRTC of CUDA {version} was not found beside PyTorch")


def compiled(source: str, options: Sequence[str], capability: int, version: str) -> bytes:
    """A program for a device of a capability such as 90, as :func:`compile_program`; kept in a folder of the user.

    A kept file has a digest of its content, is written whole or not at all, and is compiled anew if it is damaged.
    """
    library, numbers = nvrtc(version), (ctypes.c_int * 2)()
    library.nvrtcVersion(ctypes.byref(numbers, 0), ctypes.byref(numbers, ctypes.sizeof(ctypes.c_int)))
    parts = (source, *map(text, HEADERS), *_OPTIONS, *options, *map(str, numbers), str(capability))
    caches = os.environ.get("LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME") or "~/.cache"
    file = Path(caches).expanduser() / "torchdof" / hashlib.sha256("\0".join(parts).encode()).hexdigest()
    with contextlib.suppress(OSError):
        kept = file.read_bytes()
        if hashlib.sha256(kept[32:]).digest() == kept[:32]:
            return kept[32:]
    image, _ = compile_program(source, options, capability, version)
    with contextlib.suppress(OSError):  # a folder that cannot be written: each process compiles
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, delete=False) as whole:
            whole.write(hashlib.sha256(image).digest() + image)
        os.replace(whole.name, file)
    return image


def compile_program(source: str, options: Sequence[str], capability: int, version: str) -> tuple[bytes, str]:
    """A program for a device of a capability such as 90, and the log of the compiler.

    The program is machine code, or PTX if this NVRTC does not know so new a device: then the driver compiles it.

    Raises:
        OSError: If NVRTC is not found.
        RuntimeError: If it refuses the device or the source.
    """
    library, program, size = nvrtc(version), ctypes.c_void_p(), ctypes.c_size_t()
    names = {**_NO_STANDARD_LIBRARY, **{name: text(name) for name in HEADERS}}
    count = ctypes.c_int()
    library.nvrtcGetNumSupportedArchs(ctypes.byref(count))
    known = (ctypes.c_int * count.value)()
    library.nvrtcGetSupportedArchs(known)
    usable = [each for each in known if each <= capability]
    if not usable:
        needed = f"NVRTC {version} needs {min(known) / 10:.1f} or more"
        raise RuntimeError(f"the device has compute capability {capability / 10:.1f}, {needed}")
    is_known = capability in usable
    target = f"--gpu-architecture={'sm' if is_known else 'compute'}_{capability if is_known else max(usable)}"
    texts, includes = (_strings(part) for part in (names.values(), names))
    library.nvrtcCreateProgram(ctypes.byref(program), source.encode(), b"kernels.cu", len(names), texts, includes)
    given = [target, *_OPTIONS, *options]
    failed = library.nvrtcCompileProgram(program, len(given), _strings(given))

    def result(name: str) -> bytes:
        getattr(library, f"nvrtcGet{name}Size")(program, ctypes.byref(size))
        out = ctypes.create_string_buffer(size.value)
        getattr(library, f"nvrtcGet{name}")(program, out)
        return out.raw

    log = result("ProgramLog").rstrip(b"\0").decode()
    image = b"" if failed else result("CUBIN" if is_known else "PTX")
    library.nvrtcDestroyProgram(ctypes.byref(program))
    if failed:
        raise RuntimeError(f"NVRTC {version} cannot compile the kernels: {log}")
    return image, log


def _strings(texts: Iterable[str]) -> Any:
    encoded = [each.encode() for each in texts]
    return (ctypes.c_char_p * len(encoded))(*encoded)


Queue = Callable[[], AbstractContextManager[int]]
"""A block in which a device's context is current; its value is the handle of the stream in use."""


def on_device(source: str, options: Sequence[str], device: int) -> "Module":
    """Kernels of a source on a CUDA device, on PyTorch's current stream there.

    Raises:
        OSError: If NVRTC or the driver is not found.
        RuntimeError: If the source cannot be compiled or loaded.
    """
    if torch.version.cuda is None:
        raise RuntimeError("this PyTorch is not built for CUDA")
    driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    major, minor = torch.cuda.get_device_capability(device)
    image = compiled(source, options, 10 * major + minor, torch.version.cuda)

    @contextlib.contextmanager
    def queue() -> Iterator[int]:
        with torch.cuda.device(device):
            yield torch.cuda.current_stream().cuda_stream

    with torch.cuda.device(device):
        torch.cuda.synchronize()  # PyTorch makes its context current
    return Module(driver, image, queue)


class Module:
    """Kernels on a device; ``module(name, grid, block, argument)`` launches one, whose only argument is a structure."""

    def __init__(self, driver: ctypes.CDLL, image: bytes, queue: Queue) -> None:
        self._driver, self._queue, self._functions = driver, queue, dict[str, ctypes.c_void_p]()
        self._module = ctypes.c_void_p()
        with queue():
            self._check(driver.cuModuleLoadData(ctypes.byref(self._module), image))

    def __call__(self, name: str, grid: Sequence[int], block: Sequence[int], argument: ctypes.Structure) -> None:
        """Launch a kernel; grid and block are x, y, z."""
        pointers = (ctypes.c_void_p * 1)(ctypes.addressof(argument))
        with self._queue() as stream:
            if name not in self._functions:
                function = ctypes.c_void_p()
                self._check(self._driver.cuModuleGetFunction(ctypes.byref(function), self._module, name.encode()))
                self._functions[name] = function
            given = (*grid, *block, 0, ctypes.c_void_p(stream), pointers, None)
            self._check(self._driver.cuLaunchKernel(self._functions[name], *given))

    def _check(self, status: int) -> None:
        if status:
            reason = ctypes.c_char_p()
            self._driver.cuGetErrorString(status, ctypes.byref(reason))
            raise RuntimeError(f"the CUDA driver reports {(reason.value or b'nothing').decode()!r}, error {status}")
