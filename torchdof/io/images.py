"""Reads and writes images in linear light: EXR, PNG, TIFF, JPEG, WebP, HDR and PFM, with OpenImageIO.

Files of integers (PNG, JPEG, TIFF of 8 or 16 bits) are sRGB, and files of floats (EXR, HDR, PFM, TIFF of floats) linear
light, unless the argument ``transfer`` changes that, or a file of integers states another encoding: a PNG by gAMA or
cICP, any by the curve of its profile, which is read as an exponent. Other tags are ignored. Primaries are kept where
the written file can state them, and are otherwise converted to those of sRGB.
"""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ..validation import choice
from .channels import colour_channels, depth_channels, named_channels, nearest_channel
from .colour import stated_transfer
from .decode import Part, errors_named, read_array, read_parts, refuse_noise
from .heif import heif_maps, read_heif
from .jpeg import jpeg_maps
from .layers import Layers
from .metadata import turned
from .paths import PixelType, existing_image, existing_map, has_pi_heif
from .picture import Picture
from .portraits import Embedded
from .transfer import Transfer, decode, default_transfer, strips
from .windows import Window, placed
from .writing import OIIO_SAMPLE, write_image

__all__ = ["Picture", "read_image", "read_values", "write_image"]

_SAMPLE_TYPES: dict[str, PixelType] = {name: sample for sample, name in OIIO_SAMPLE.items()} | {"double": "float"}
_WHITE = {"8": 255.0, "16": 65535.0, "half": 1.0, "float": 1.0}


def read_image(
    path: str | os.PathLike[str], transfer: Transfer | None = None, layer: str | None = None, keep_layers: bool = False
) -> Picture:
    """Reads an image into linear light.

    Args:
        path: An EXR, PNG, TIFF, JPEG, WebP, HDR or PFM file; HEIC and AVIF with ``pip install 'torchdof[heif]'``; raw
            files if OpenImageIO was built to read them.
        transfer: "linear" or "srgb"; None uses what the file states, else "srgb" for integers and "linear" for floats.
        layer: Name of the part or layer of an EXR file to read; None takes the first that has colour.
        keep_layers: Keep the other layers and parts of an EXR file, so that a copy has them too.

    Returns:
        The picture, upright; its depth channel is one like ``Z``, ``depth`` or ``ViewLayer.Depth.Z`` of an EXR file, or
        the depth that a phone stored in a portrait, which may have another size. If a portrait holds the photograph
        without blur as well, that is read.

    Raises:
        OSError: If the file is missing, empty, truncated, not an image, or does not fit into memory.
        ValueError: If the type, the size or the kind of colours is not supported, a channel is missing, or colours are
            not finite.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_image(folder + "/grey.png", Picture(torch.full((1, 3, 2, 4), 0.2159)))
        ...     round(float(read_image(folder + "/grey.png").pixels.mean()), 3)  # 8 bits, sRGB
        0.216
    """
    path = existing_image(path)
    if transfer is not None:
        choice("transfer", transfer, ("linear", "srgb"))
    with errors_named(path):
        parts, maps = _read(path)
        part, indices, names = colour_channels(parts, layer)
        source = parts[part]
        stated = stated_transfer(source.stated) if transfer is None else None
        transfer = stated or transfer
        pixels, sample, transfer = _light(source, indices, transfer, has_alpha=names[-1] == "A")
        kept = Layers(tuple(parts), part, tuple(indices)) if keep_layers and source.is_exr else None
        depth, problem, places = None, maps.problem, {(part, k) for k in indices}
        in_layer = source.names[indices[0]].rpartition(".")[0]
        label = f"{source.label}.{in_layer}".strip(".")
        if found := depth_channels(parts):
            try:
                n, k = nearest_channel(parts, found, label)
                depth = _placed(parts[n], k, pixels.shape[-2:], source.window)
                places.add((n, k))
            except ValueError as error:
                problem = str(error)
        elif maps.depth is not None:
            depth = _map(turned(maps.depth, source.orientation, source.values.shape))
        matte = None
        if maps.matte is not None:
            coverage = _map(turned(maps.matte, source.orientation, source.values.shape))
            matte = interpolate(coverage, pixels.shape[-2:], mode="bilinear", antialias=True)
    left = [(p.label, name) for n, p in enumerate(parts) for k, name in enumerate(p.names) if (n, k) not in places]
    others = tuple(dict.fromkeys(name.rpartition(".")[0] or label or name for label, name in left))
    return Picture(
        pixels,
        names,
        depth,
        source.metadata,
        sample,
        transfer,
        source.window,
        source.orientation,
        others,
        is_stated=stated is not None,
        layer=label,
        depth_problem=problem,
        depth_meaning=maps.meaning,
        matte=matte,
        layers=kept,
    )


def _read(path: Path) -> tuple[list[Part], Embedded]:
    """The parts of a file, and the maps that a phone stored in it."""
    with path.open("rb") as file:
        start = file.read(12)
    is_heif = start[4:8] == b"ftyp" and has_pi_heif()
    parts, maps = [read_heif(path)] if is_heif else read_parts(path), Embedded()
    try:
        if is_heif:
            maps = heif_maps(path)
        elif start[:2] == b"\xff\xd8":
            maps = jpeg_maps(path)
    except (OSError, ValueError) as error:  # the photograph itself can be used
        maps = Embedded(problem=f"its depth cannot be used: {error}")
    if maps.original is not None:
        parts = [dataclasses.replace(maps.original, metadata=parts[0].metadata)]
    return parts, maps


def _light(
    source: Part, indices: list[int], transfer: Transfer | None, has_alpha: bool
) -> tuple[Tensor, PixelType, Transfer]:
    """Light ``[1, C, H, W]`` from stored numbers, their type, and their encoding."""
    kinds = {source.kinds[k] for k in indices}
    kind = kinds.pop() if len(kinds) == 1 else "float"
    if kind not in _SAMPLE_TYPES and not source.is_exr:
        raise ValueError(f"holds numbers of type {kind}, for which white is not defined; store 16 bits")
    sample = _SAMPLE_TYPES.get(kind, "float")
    transfer, white = transfer or default_transfer(sample), _WHITE[sample]
    curve = None  # light of each stored number, twice as fast as computing it for each pixel
    if white > 1 and (source.straight_alpha or not has_alpha):
        levels = torch.arange(white + 1, dtype=torch.float32) / white
        curve = decode(levels.reshape(1, 1, 1, -1), transfer, has_alpha=False, straight=False).flatten().numpy()
    height, width = source.values.shape[:2]
    light, bad_pixels = torch.from_numpy(np.empty((1, len(indices), height, width), np.float32)), 0
    for rows in strips(height, width * len(indices)):
        stored = source.values[rows][..., indices]
        values = _float32(stored) if curve is None else curve[stored]
        if curve is None and white > 1:
            values /= np.float32(white)
        elif curve is not None and has_alpha:
            values[..., -1] = stored[..., -1] / np.float32(white)
        bad_pixels += int((~np.isfinite(values)).any(axis=-1).sum()) if curve is None else 0
        pixels = torch.from_numpy(values).permute(2, 0, 1)[None]  # [h, W, C] -> [1, C, h, W]
        light[:, :, rows] = decode(pixels, transfer if curve is None else "linear", has_alpha, source.straight_alpha)
        if not bad_pixels and not bool(torch.isfinite(light[:, :, rows]).all()):
            raise ValueError("its light is beyond the range of float32; scale it down")
    if bad_pixels:
        raise ValueError(f"{bad_pixels} pixels are not finite (NaN or inf); repair them before blurring spreads them")
    return light, sample, transfer


def read_values(path: str | os.PathLike[str], channel: str | None = None, image: Picture | None = None) -> Tensor:
    """Reads the numbers of a one-channel map, such as a depth map, without transfer curve or scaling of integers.

    Args:
        path: An image of one channel (or of equal ones), an EXR file with a depth channel, ``.pgm``, ``.npy`` or
            ``.npz``, or a phone's portrait.
        channel: Name of a channel, layer or part of an image, or of an array in an ``.npz`` file; None takes the only
            one, or the depth channel, or the array called depth.
        image: The image that the map belongs to. Of several depth channels, that of its layer is taken; the map is
            placed by the data windows of both, NaN where the map has no numbers. None takes the map as it is stored.

    Returns:
        ``[1, 1, H, W]`` float32; a 16-bit file gives 0 to 65535, an 8-bit file 0 to 255. The scale in the header of
        a PFM file is not applied.

    Raises:
        OSError: If the file is missing, empty, truncated or unreadable, or does not fit into memory.
        ValueError: If the channel is ambiguous or missing, or the array is not two-dimensional numbers.
    """
    return read_map(path, channel, image=image)[0]


def read_map(
    path: str | os.PathLike[str],
    channel: str | None = None,
    place: tuple[int, int] | None = None,
    image: Picture | None = None,
) -> tuple[Tensor, Mapping[str, Any]]:
    """As :func:`read_values`, and the meaning of the numbers of a phone's portrait, as in :class:`Picture`.

    ``place`` is the index of an image in a sequence, and the number of images, for an array ``[N, H, W]``.
    """
    path = existing_map(path)
    with errors_named(path):
        if path.suffix.lower() in (".npy", ".npz"):
            part, k = Part("", ("Y",), read_array(path, channel, place)[..., None], ("float",)), 0
        else:
            parts, maps = _read(path)
            if maps.problem:
                raise ValueError(maps.problem)
            if maps.depth is not None:
                return _map(turned(maps.depth, parts[0].orientation, parts[0].values.shape)), maps.meaning
            n, k = _map_channel(parts, channel, "" if image is None else image.layer)
            part = parts[n]
        if image is None:
            return _map(part.values[..., k]), {}
        return _placed(part, k, image.pixels.shape[-2:], image.window), {}


def _map_channel(parts: list[Part], channel: str | None, layer: str) -> tuple[int, int]:
    """Index of the part and of the channel in it that is the map of an image of a layer."""
    every = [(n, k) for n, part in enumerate(parts) for k in range(len(part.names))]
    names = ", ".join(parts[n].names[k] for n, k in every)
    if channel is not None:
        if found := named_channels(parts, channel):
            return found[0] if len(found) == 1 else nearest_channel(parts, found, layer)
        labels = ", ".join(filter(None, (part.label for part in parts)))
        raise ValueError(f"no channel {channel!r}; it has {names}" + (f" in the parts {labels}" if labels else ""))
    if found := depth_channels(parts):
        return nearest_channel(parts, found, layer)
    first = parts[0].values[..., 0]
    is_float = first.dtype.kind == "f"  # a hole may be NaN
    if all(np.array_equal(parts[n].values[..., k], first, is_float) for n, k in every if parts[n].names[k] != "A"):
        return every[0]
    advice = "name it (--depth-channel); the colours of a heat map are no depth: save the map in grey, or as .npy"
    raise ValueError(f"which of the channels {names} is depth? {advice}")


def _placed(part: Part, channel: int, size: Sequence[int], target: Window | None) -> Tensor:
    """A channel as ``[1, 1, h, w]`` with the area of an image of a size and window; see :func:`placed`."""
    window = part.window if part.is_exr else None
    return _map(placed(part.values[..., channel], window, (size[0], size[1]), target))


def _map(values: np.ndarray) -> Tensor:
    """Numbers ``[H, W]`` as ``[1, 1, H, W]``, unless they are like random bytes."""
    if values.dtype.kind == "f":
        refuse_noise(values)
    return torch.from_numpy(_float32(values))[None, None]


def _float32(values: np.ndarray) -> np.ndarray:
    """Numbers in single precision; larger ones become infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32)
