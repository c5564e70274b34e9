"""What an image file or array holds, as stored: every channel's numbers, before they mean light or depth.

OpenImageIO is imported when a file is read, so that ``import torchdof`` stays light.
"""

import dataclasses
import os
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..validation import show
from . import exr, png
from .memory import free_bytes
from .metadata import kept_metadata

__all__ = ["Part", "PixelType", "existing", "first_line", "read_array", "read_parts"]

PixelType = Literal["8", "16", "half", "float"]

MAX_PIXELS = 2**28
# what numpy and zipfile raise on bytes that are no array
_BROKEN: tuple[type[Exception], ...] = (ValueError, OSError, EOFError, KeyError, TypeError, MemoryError, OverflowError)
_BROKEN += (RuntimeError, SyntaxError, zipfile.BadZipFile, struct.error, zlib.error, tokenize.TokenError)
_SAMPLES: dict[str, PixelType] = {"uint8": "8", "uint16": "16", "half": "half"}


@dataclasses.dataclass(frozen=True)
class Part:
    """One part of a file, as stored.

    Args:
        label: Name of the part, often empty.
        names: Names of the channels.
        values: ``[H, W, C]``.
        samples: What each channel was stored as: "8", "16", "half" or "float".
        white: The number that stands for 1.0: 255, 65535 or 1.
        straight_alpha: Whether colour is not multiplied by alpha yet.
        metadata: Name -> (OpenImageIO type, value).
        window: x, y, full x, full y, full width, full height.
    """

    label: str
    names: tuple[str, ...]
    values: np.ndarray
    samples: tuple[PixelType, ...]
    white: float = 1.0
    straight_alpha: bool = False
    metadata: dict[str, tuple[Any, Any]] = dataclasses.field(default_factory=dict)
    window: tuple[int, int, int, int, int, int] | None = None


def existing(path: str | os.PathLike[str], suffixes: tuple[str, ...], what: str) -> Path:
    """The path, if there is a file of one of these types at it.

    Raises:
        ValueError: If the suffix is none of ``suffixes``; ``what`` names what was wanted.
        OSError: If there is no file, or it is empty.
    """
    if not isinstance(path, str | os.PathLike) or "\0" in os.fspath(path):
        raise ValueError(f"expected the path of {what}, got {show(path)}")
    path = Path(path)
    if os.path.islink(os.path.realpath(path)):
        raise OSError(f"{path}: is a link that leads back to itself")
    if path.suffix.lower() not in suffixes:
        raise ValueError(
            f"{path}: {path.suffix or 'no suffix'} is not {what} that can be read; use {' '.join(suffixes)}"
        )
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if not path.is_file():
        raise IsADirectoryError(f"{path}: is not a file")
    if path.stat().st_size == 0:
        raise OSError(f"{path}: the file is empty")
    return path


def read_parts(path: Path) -> list[Part]:
    """Reads every part of an image file.

    Raises:
        OSError: If the file is damaged, cut short or not an image.
        ValueError: If it is too large, or holds deep samples.
    """
    try:
        return [_read_pfm(path)] if path.suffix.lower() == ".pfm" else _read_every_part(path)
    except UnicodeDecodeError:
        raise OSError(f"{path}: is damaged (a name in its header is no text)") from None


def _read_every_part(path: Path) -> list[Part]:
    """The parts of a file that OpenImageIO reads; other than EXR files have one."""
    import OpenImageIO as oiio

    if path.suffix.lower() == ".png":
        png.check(path)
    elif path.suffix.lower() == ".exr":
        exr.check(path)
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise OSError(f"{path}: cannot be read ({first_line(oiio.geterror())})")
    parts: list[Part] = []
    promised = 0
    try:
        while source.seek_subimage(len(parts), 0):
            spec = source.spec()
            promised += _check_size(
                path, spec.width, spec.height, spec.pixel_bytes(True) + 4 * spec.nchannels, promised
            )
            if spec.deep:
                raise ValueError(f"{path}: holds deep samples; flatten it to one sample a pixel first")
            values = source.read_image(spec.format)
            problem = source.geterror()
            if values is None or problem:
                raise OSError(f"{path}: is damaged or cut short ({first_line(problem)})")
            names = tuple(spec.channelnames)
            is_exr = source.format_name() == "openexr"
            if not is_exr and len(names) <= 4:
                names = tuple(("Y", "YA", "RGB", "RGBA")[len(names) - 1])
            integers = np.issubdtype(values.dtype, np.integer)
            formats = [str(f) for f in spec.channelformats] or [str(spec.format)] * len(names)
            parts.append(
                Part(
                    label=spec.get_string_attribute("name"),
                    names=names,
                    values=values.reshape(spec.height, spec.width, len(names)),
                    samples=tuple(_SAMPLES.get(f, "16" if integers else "float") for f in formats),
                    white=float(np.iinfo(values.dtype).max) if integers and not is_exr else 1.0,
                    straight_alpha=bool(spec.get_int_attribute("oiio:UnassociatedAlpha")),
                    metadata=kept_metadata(spec.extra_attribs),
                    window=(spec.x, spec.y, spec.full_x, spec.full_y, spec.full_width, spec.full_height),
                )
            )
            if not is_exr:
                break
    finally:
        source.close()
    return parts


def _read_pfm(path: Path) -> Part:
    """PFM by hand: OpenImageIO multiplies by the header's scale, which ruins disparities (Middlebury's among them)."""
    with path.open("rb") as file:
        words: list[bytes] = []
        while len(words) < 4:
            line = file.readline(100)
            if not line:
                break
            words += line.split()
        try:
            channels = {b"PF": 3, b"Pf": 1}[words[0]]
            width, height, scale = int(words[1]), int(words[2]), float(words[3])
        except (IndexError, KeyError, ValueError):
            raise OSError(f"{path}: is not a PFM file (its header should read 'PF' or 'Pf', size and scale)") from None
        _check_size(path, width, height, 2 * 4 * channels)
        count = width * height * channels
        data = file.read(4 * count)
    if len(data) != 4 * count:
        raise OSError(f"{path}: is cut short ({len(data)} of {4 * count} bytes of pixels)")
    values = np.frombuffer(data, dtype="<f4" if scale < 0 else ">f4").astype(np.float32)
    values = values.reshape(height, width, channels)[::-1]  # stored from the bottom row up
    samples: list[PixelType] = ["float"] * channels
    return Part("", tuple("Y" if channels == 1 else "RGB"), values, tuple(samples))


def read_array(path: Path, key: str | None) -> np.ndarray:
    """Reads an ``.npy`` or ``.npz`` file as ``[H, W]`` numbers; pickled objects are refused.

    Args:
        path: The file.
        key: Name of the array in an ``.npz`` file; None takes the only one.

    Raises:
        ValueError: If the file is damaged, too large, or does not hold such an array.
    """
    try:
        if path.suffix.lower() == ".npz":
            with zipfile.ZipFile(path) as archive:
                largest = max((entry.file_size for entry in archive.infolist()), default=0)
                if largest > 8 * MAX_PIXELS + 4096:
                    raise ValueError(f"holds more than {MAX_PIXELS} pixels")
                if 2 * largest > free_bytes():
                    raise ValueError(f"holds {largest} bytes, more than there is memory for")
            with np.load(path, allow_pickle=False) as arrays:
                if key is None and len(arrays.files) != 1:
                    raise ValueError(
                        f"which of the arrays {', '.join(arrays.files)} is depth? name it (--depth-channel)"
                    )
                if key is not None and key not in arrays.files:
                    raise ValueError(f"no array {key!r}; it has {', '.join(arrays.files)}")
                array = arrays[key or arrays.files[0]]
        else:
            array = np.load(path, allow_pickle=False, mmap_mode="r")
        if not isinstance(array, np.ndarray):
            raise ValueError("it is no array")
    except _BROKEN as error:
        raise ValueError(f"{path}: cannot be read as an array ({first_line(str(error))})") from None
    shape = array.shape
    while array.ndim > 2 and 1 in (array.shape[0], array.shape[-1]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    if array.ndim != 2 or array.dtype.kind not in "fiu" or array.size == 0:
        raise ValueError(f"{path}: expected an array [H, W] of numbers, got {list(shape)} of {array.dtype}")
    _check_size(path, array.shape[1], array.shape[0], array.dtype.itemsize + 4)
    return np.asarray(array)


def _check_size(path: Path, width: int, height: int, pixel_bytes: int, others: int = 0) -> int:
    """Refuse what a header promises if it is too much to read, or more than there is memory for.

    Args:
        path: The file.
        width: In pixels.
        height: In pixels.
        pixel_bytes: What a pixel takes, as stored and as read.
        others: Bytes that other parts of the file take.

    Returns:
        The bytes that it takes.
    """
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise ValueError(f"{path}: its header claims {width} x {height} pixels; between 1 and {MAX_PIXELS} are read")
    needed, free = width * height * pixel_bytes, free_bytes()
    if needed + others > free:
        raise ValueError(
            f"{path}: its header claims {width} x {height} pixels, which take {(needed + others) / 2**30:.3g} GiB; "
            f"{max(0.0, free) / 2**30:.3g} GiB of memory are free"
        )
    return needed


def first_line(text: str) -> str:
    """The first line of a library's message."""
    return text.strip().splitlines()[0] if text.strip() else "no reason given"
