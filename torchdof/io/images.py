"""Reads and writes images in linear light: EXR, PNG, TIFF, JPEG, WebP, HDR and PFM, with OpenImageIO.

Files of integers (PNG, JPEG, TIFF of 8 or 16 bits) are sRGB, and files of floats (EXR, HDR, PFM, TIFF of floats) linear
light, unless the argument ``transfer`` changes that, or a file of integers states another encoding: a PNG by gAMA or
cICP, any by the curve of its profile, which is read as an exponent. Other tags are ignored. Primaries are kept where
the written file can state them, and are otherwise converted to those of sRGB.
"""

import dataclasses
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ..validation import choice, real_tensor, show
from .atomic import atomic_file
from .channels import colour_channels, depth_channels, named_channels, nearest_channel
from .colour import in_rec709, stated_primaries, stated_transfer
from .decode import Part, errors_named, first_line, is_complete, read_array, read_parts, refuse_noise, utf8_name
from .heif import heif_maps, read_heif
from .jpeg import jpeg_maps
from .layers import LOSSLESS, OF_LAYERS, Layers
from .metadata import turned
from .paths import PixelType, existing_image, existing_map, has_pi_heif, samples_of
from .portraits import Embedded
from .transfer import Transfer, decode, default_transfer, encode, encode_8_bits
from .webp import add_exif
from .windows import Window, placed

__all__ = ["Picture", "read_image", "read_values", "write_image"]

_OIIO_SAMPLE: dict[PixelType, str] = {"8": "uint8", "16": "uint16", "half": "half", "float": "float"}
_SAMPLE_TYPES: dict[str, PixelType] = {name: sample for sample, name in _OIIO_SAMPLE.items()} | {"double": "float"}
_WHITE = {"8": 255.0, "16": 65535.0, "half": 1.0, "float": 1.0}
_ALPHA_SUFFIXES = (".exr", ".png", ".tif", ".tiff", ".webp")
_GREY_SUFFIXES = (".exr", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".pfm")
_PROFILE_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".webp")
_JPEG = {"compression": "jpeg:95", "jpeg:subsampling": "4:4:4"}
_SETTINGS: dict[str, Mapping[str, object]] = {
    **{".jpg": _JPEG, ".jpeg": _JPEG, ".webp": {"compression": "webp:95"}},
    ".png": {"png:compressionLevel": 4},  # a third of the time of the default, 6, and a twentieth more bytes
}


@dataclasses.dataclass(frozen=True)
class Picture:
    """An image in linear light, with the properties of its file that are needed to write it back.

    Args:
        pixels: ``[1, C, H, W]`` float32 in linear light. Colour is premultiplied by alpha, if there is alpha.
        channels: Names of the channels: ``("R", "G", "B")`` or grey ``("Y",)``, either with ``"A"`` at the end.
        depth: ``[1, 1, H, W]``, the numbers of the file's own depth channel, or None. Where another data window leaves
            pixels without depth, it is NaN.
        metadata: Name -> (OpenImageIO type, value).
        sample: Stored type of a sample: "8", "16", "half" or "float".
        transfer: Encoding of the file: "linear" or "srgb", or another one that it states.
        is_stated: Whether the file states its encoding, and that is not sRGB.
        window: Place of the pixels in the full frame (EXR data window): x, y, full x, full y, full width, full height.
        orientation: EXIF orientation of the file; the pixels are upright already.
        other_layers: Names of the layers of the file that are neither the pixels nor the depth.
        layer: Names of the part and layer of the pixels, joined by a dot.
        depth_problem: The reason why none of several depth channels, or a phone's own depth, was taken, or empty.
        layers: All parts and layers of an EXR file, which :func:`write_image` then writes too; None writes the pixels.
        depth_meaning: Arguments of :func:`torchdof.depth.from_relative` with which a phone's own depth becomes metres,
            and ``along_ray`` if these are distances along the ray; empty if the file does not state it.
        matte: Coverage by the subject that a phone stored, ``[1, 1, H, W]`` in [0, 1], or None.
    """

    pixels: Tensor
    channels: tuple[str, ...] = ("R", "G", "B")
    depth: Tensor | None = None
    metadata: Mapping[str, tuple[Any, Any]] = dataclasses.field(default_factory=dict)
    sample: PixelType = "float"
    transfer: Transfer = "linear"
    window: Window | None = None
    orientation: int = 1
    other_layers: tuple[str, ...] = ()
    is_stated: bool = False
    layer: str = ""
    depth_problem: str = ""
    layers: Layers | None = None
    depth_meaning: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    matte: Tensor | None = None

    @property
    def has_alpha(self) -> bool:
        """Whether the last channel is alpha."""
        return self.channels[-1] == "A"

    @property
    def light(self) -> Tensor:
        """The pixels without alpha."""
        return self.pixels[:, :-1] if self.has_alpha else self.pixels


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
    for rows in _strips(height, width * len(indices)):
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


def _strips(height: int, numbers_per_row: int) -> list[slice]:
    """Slices of rows with about a million numbers each, which keep temporary arrays small."""
    rows = 1 + 2**20 // numbers_per_row
    return [slice(top, top + rows) for top in range(0, height, rows)]


def can_state_transfer(picture: Picture, suffix: str) -> bool:
    """Whether a file of a type can state the encoding of a picture: a PNG any, others sRGB or that of a profile."""
    return suffix == ".png" or not picture.is_stated or keeps_profile(picture, suffix)


def keeps_profile(picture: Picture, suffix: str) -> bool:
    """Whether a file of a type keeps the profile of a picture, if its encoding is not changed."""
    return suffix in _PROFILE_SUFFIXES and "ICCProfile" in picture.metadata and "CICP" not in picture.metadata


def write_image(
    path: str | os.PathLike[str], picture: Picture, transfer: Transfer | None = None, sample: PixelType | None = None
) -> None:
    """Writes a picture whole or not at all.

    Args:
        path: Output file; its suffix gives the format (.exr .png .tif .tiff .jpg .jpeg .webp .hdr .pfm). A missing
            folder is made.
        picture: Pixels in linear light; metadata that the format supports is written too.
        transfer: "linear" or "srgb". None keeps the picture's own if both its ``sample`` and the new one are integers,
            or both floats, and the file can state it where the picture's file does; otherwise it is "srgb" for integers
            and "linear" for floats.
        sample: "8", "16", "half" or "float"; None keeps the picture's own if the format supports it, and otherwise
            takes the default of the format (8 bits, or half for EXR).

    Raises:
        ValueError: If the format does not support the request (alpha in a JPEG, 16 bits in an HDR, ...).
        OSError: If the file cannot be written; an existing file is then unchanged.
    """
    import OpenImageIO as oiio

    path = Path(path)
    if not isinstance(picture, Picture):
        raise ValueError(f"{path}: expected a Picture, such as Picture(tensor [1, 3, H, W]), got {show(picture)}")
    suffix = path.suffix.lower()
    sample_types = samples_of(path)
    if sample is None:
        default: PixelType = "float" if picture.sample == "half" and suffix[:4] == ".tif" else sample_types[0]
        sample = picture.sample if picture.sample in sample_types else default
    if sample not in sample_types:
        raise ValueError(f"{path}: a {suffix} file holds samples of {' or '.join(sample_types)}, not {sample}")
    if transfer is None:
        both_floats_or_integers = default_transfer(sample) == default_transfer(picture.sample)
        is_kept = both_floats_or_integers and can_state_transfer(picture, suffix)
        transfer = picture.transfer if is_kept else default_transfer(sample)
    pixels = real_tensor("pixels", picture.pixels, "[1, C, H, W] in linear light").detach().cpu().float()
    names = picture.channels
    if pixels.ndim != 4 or pixels.shape[:2] != (1, len(names)):
        raise ValueError(f"{path}: pixels must be [1, {len(names)}, H, W] for {names}, got {list(pixels.shape)}")
    if picture.has_alpha and suffix not in _ALPHA_SUFFIXES:
        if bool((pixels[:, -1] < 1.0).any()):
            raise ValueError(f"{path}: a {suffix} file cannot hold the alpha channel; write .exr, .png or .tif instead")
        pixels, names = pixels[:, :-1], names[:-1]
    primaries = stated_primaries(picture.metadata)
    codes = {name: value for name, (_, value) in picture.metadata.items() if name == "CICP"}
    is_cicp = bool(codes) and suffix == ".png" and transfer == (stated_transfer(codes) or "srgb")
    has_profile = keeps_profile(picture, suffix) and transfer == picture.transfer
    if primaries is not None and names[0] == "R" and suffix != ".exr" and not is_cicp and not has_profile:
        try:
            pixels = in_rec709(pixels, primaries)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    if names[0] == "Y" and suffix not in _GREY_SUFFIXES:
        pixels, names = pixels.expand(-1, 3, -1, -1), ("R", "G", "B")
    straight = names[-1] == "A" and suffix != ".exr"
    if sample == "8":
        array = encode_8_bits(pixels, transfer, straight)
    else:
        array = np.empty((*pixels.shape[2:], len(names)), np.float32)
        for rows in _strips(array.shape[0], array.shape[1] * len(names)):
            encoded = encode(pixels[:, :, rows], transfer, names[-1] == "A", straight)
            encoded = encoded.clamp(-65504.0, 65504.0) if sample == "half" else encoded
            array[rows] = encoded[0].permute(1, 2, 0).numpy()  # [C, h, W] -> [h, W, C]

    spec = oiio.ImageSpec(array.shape[1], array.shape[0], array.shape[2], _OIIO_SAMPLE[sample])
    spec.channelnames = names
    spec.alpha_channel = len(names) - 1 if names[-1] == "A" else -1
    if picture.window is not None:
        spec.x, spec.y, spec.full_x, spec.full_y, spec.full_width, spec.full_height = picture.window
    for name, (kind, value) in picture.metadata.items():
        is_lossless = suffix == ".exr" and name == "compression" and value in LOSSLESS
        is_same = {"ICCProfile": has_profile, "CICP": is_cicp, "chromaticities": suffix == ".exr"}
        is_lost = picture.layers is None and re.match(OF_LAYERS, name) is not None
        if {"compression": is_lossless, **is_same}.get(name, not is_lost):
            typed = (value,) if isinstance(value, int) else (kind, value)  # with a 16-bit type it would be dropped
            spec.attribute(name, *typed)
    if is_cicp or transfer not in ("linear", "srgb"):  # "unknown": OpenImageIO states what the other attributes say
        spec.attribute("oiio:ColorSpace", "unknown")
        if transfer.startswith("gamma") and not is_cicp:
            spec.attribute("oiio:Gamma", float(transfer.split()[1]))
    elif transfer == "srgb" or suffix != ".exr":  # not of linear EXR files, whose primaries are those of the input
        spec.attribute("oiio:ColorSpace", "srgb_rec709_scene" if transfer == "srgb" else "lin_rec709_scene")
    if suffix == ".exr" and primaries is not None:
        spec.attribute("chromaticities", "float[8]", primaries)
    if transfer != "srgb" and suffix != ".exr":
        spec.attribute("Exif:ColorSpace", 65535)  # "uncalibrated"; OpenImageIO cannot write a TIFF without any EXIF
    if straight:
        spec.attribute("oiio:UnassociatedAlpha", 1)
    for name, setting in _SETTINGS.get(suffix, {}).items():
        spec.attribute(name, setting)

    parts = [(spec, array)]
    if picture.layers is not None and suffix == ".exr":
        if len(picture.layers.channels) != len(names):
            raise ValueError(f"{path}: cannot keep the layers of a picture whose channels are now {', '.join(names)}")
        parts = picture.layers.replaced(spec, array)
    specs = tuple(each for each, _ in parts)

    with atomic_file(path) as temporary:
        with temporary.open("wb") as file:
            if suffix in (".jpg", ".jpeg") and hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, array.size + 2**20)  # fails here: libjpeg exits on a full disk
        with utf8_name(temporary) as name:
            output = oiio.ImageOutput.create(name)
            if output is None or not output.open(name, specs if len(specs) > 1 else specs[0]):
                problem = (oiio if output is None else output).geterror()
                raise OSError(f"{path}: could not be opened for writing ({first_line(problem)})")
            is_written = True
            for number, (each, values) in enumerate(parts):
                is_open = number == 0 or output.open(name, each, "AppendSubimage")
                is_written = is_written and is_open and output.write_image(np.ascontiguousarray(values))
            is_closed = output.close()
            problem = output.geterror()  # of a full disk, unless it fills up in the last flush of the buffer
            if not (is_written and is_closed) or problem or not is_complete(temporary):
                raise OSError(f"{path}: could not be written ({first_line(problem)}); is the disk full?")
            if suffix == ".webp" and picture.metadata:
                add_exif(temporary, spec)


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
