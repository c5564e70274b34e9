"""Writes pictures to files, with OpenImageIO."""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from ..validation import real_tensor, show
from .atomic import atomic_file
from .colour import Chromaticities, in_rec709, stated_primaries, stated_transfer
from .decode import first_line, is_complete, utf8_name
from .layers import LOSSLESS, OF_LAYERS
from .paths import PixelType, samples_of
from .picture import Picture, can_state_transfer, keeps_profile
from .transfer import Transfer, default_transfer, encode, encode_8_bits, strips
from .webp import add_exif

__all__ = ["write_image"]

OIIO_SAMPLE: dict[PixelType, str] = {"8": "uint8", "16": "uint16", "half": "half", "float": "float"}
"""OpenImageIO's name of a type of samples."""

_ALPHA_SUFFIXES = (".exr", ".png", ".tif", ".tiff", ".webp")
_GREY_SUFFIXES = (".exr", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".pfm")
_JPEG = {"compression": "jpeg:95", "jpeg:subsampling": "4:4:4"}
_SETTINGS: dict[str, Mapping[str, object]] = {
    **{".jpg": _JPEG, ".jpeg": _JPEG, ".webp": {"compression": "webp:95"}},
    ".png": {"png:compressionLevel": 4},  # a third of the time of the default, 6, and a twentieth more bytes
}
_LARGEST_HALF = 65504.0


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
    path = Path(path)
    if not isinstance(picture, Picture):
        raise ValueError(f"{path}: expected a Picture, such as Picture(tensor [1, 3, H, W]), got {show(picture)}")
    form = _form(path, picture, transfer, sample)
    pixels, names = _pixels(path, picture, form)
    array, spec = _encoded(pixels, names, form), _specification(picture, pixels, names, form)
    parts = [(spec, array)]
    if picture.layers is not None and form.suffix == ".exr":
        if len(picture.layers.channels) != len(names):
            raise ValueError(f"{path}: cannot keep the layers of a picture whose channels are now {', '.join(names)}")
        parts = picture.layers.replaced(spec, array)
    with atomic_file(path) as temporary:
        with temporary.open("wb") as file:
            if form.suffix in (".jpg", ".jpeg") and hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, array.size + 2**20)  # fails here: libjpeg exits on a full disk
        _write(path, temporary, parts)
        if form.suffix == ".webp" and picture.metadata:
            add_exif(temporary, spec)


class _Form(NamedTuple):
    """How a file stores a picture."""

    suffix: str
    sample: PixelType
    transfer: Transfer
    primaries: Chromaticities | None  # of the picture; None for those of sRGB
    is_cicp: bool  # the file states its encoding as the picture does, by cICP
    has_profile: bool  # by the picture's profile

    @property
    def is_straight(self) -> bool:
        """Whether colour is stored without its alpha."""
        return self.suffix != ".exr"


def _form(path: Path, picture: Picture, transfer: Transfer | None, sample: PixelType | None) -> _Form:
    """The form in which :func:`write_image` writes a picture."""
    suffix, samples = path.suffix.lower(), samples_of(path)
    if sample is None:
        default: PixelType = "float" if picture.sample == "half" and suffix[:4] == ".tif" else samples[0]
        sample = picture.sample if picture.sample in samples else default
    if sample not in samples:
        raise ValueError(f"{path}: a {suffix} file holds samples of {' or '.join(samples)}, not {sample}")
    if transfer is None:
        both_floats_or_integers = default_transfer(sample) == default_transfer(picture.sample)
        is_kept = both_floats_or_integers and can_state_transfer(picture, suffix)
        transfer = picture.transfer if is_kept else default_transfer(sample)
    codes = {name: value for name, (_, value) in picture.metadata.items() if name == "CICP"}
    is_cicp = bool(codes) and suffix == ".png" and transfer == (stated_transfer(codes) or "srgb")
    has_profile = keeps_profile(picture, suffix) and transfer == picture.transfer
    return _Form(suffix, sample, transfer, stated_primaries(picture.metadata), is_cicp, has_profile)


def _pixels(path: Path, picture: Picture, form: _Form) -> tuple[Tensor, tuple[str, ...]]:
    """Pixels ``[1, C, H, W]`` in linear light, with the primaries of the file, and names of its channels."""
    pixels = real_tensor("pixels", picture.pixels, "[1, C, H, W] in linear light").detach().cpu().float()
    names, suffix = picture.channels, form.suffix
    if pixels.ndim != 4 or pixels.shape[:2] != (1, len(names)):
        raise ValueError(f"{path}: pixels must be [1, {len(names)}, H, W] for {names}, got {list(pixels.shape)}")
    if picture.has_alpha and suffix not in _ALPHA_SUFFIXES:
        if bool((pixels[:, -1] < 1.0).any()):
            raise ValueError(f"{path}: a {suffix} file cannot hold the alpha channel; write .exr, .png or .tif instead")
        pixels, names = pixels[:, :-1], names[:-1]
    is_converted = suffix != ".exr" and not form.is_cicp and not form.has_profile
    if form.primaries is not None and names[0] == "R" and is_converted:
        try:
            pixels = in_rec709(pixels, form.primaries)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    if names[0] == "Y" and suffix not in _GREY_SUFFIXES:
        pixels, names = pixels.expand(-1, 3, -1, -1), ("R", "G", "B")
    return pixels, names


def _encoded(pixels: Tensor, names: tuple[str, ...], form: _Form) -> np.ndarray:
    """Numbers ``[H, W, C]`` that OpenImageIO stores as the form's samples."""
    has_alpha = names[-1] == "A"
    if form.sample == "8":
        return encode_8_bits(pixels, form.transfer, has_alpha and form.is_straight)
    array = np.empty((*pixels.shape[2:], len(names)), np.float32)
    for rows in strips(array.shape[0], array.shape[1] * len(names)):
        encoded = encode(pixels[:, :, rows], form.transfer, has_alpha, has_alpha and form.is_straight)
        encoded = encoded.clamp(-_LARGEST_HALF, _LARGEST_HALF) if form.sample == "half" else encoded
        array[rows] = encoded[0].permute(1, 2, 0).numpy()  # [C, h, W] -> [h, W, C]
    return array


def _specification(picture: Picture, pixels: Tensor, names: tuple[str, ...], form: _Form) -> Any:
    """OpenImageIO's description of the file: size, type and names of the samples, and metadata."""
    import OpenImageIO as oiio

    suffix, transfer = form.suffix, form.transfer
    spec = oiio.ImageSpec(pixels.shape[3], pixels.shape[2], len(names), OIIO_SAMPLE[form.sample])
    spec.channelnames = names
    spec.alpha_channel = len(names) - 1 if names[-1] == "A" else -1
    if picture.window is not None:
        spec.x, spec.y, spec.full_x, spec.full_y, spec.full_width, spec.full_height = picture.window
    for name, (kind, value) in picture.metadata.items():
        is_lossless = suffix == ".exr" and name == "compression" and value in LOSSLESS
        is_same = {"ICCProfile": form.has_profile, "CICP": form.is_cicp, "chromaticities": suffix == ".exr"}
        is_lost = picture.layers is None and re.match(OF_LAYERS, name) is not None
        if {"compression": is_lossless, **is_same}.get(name, not is_lost):
            typed = (value,) if isinstance(value, int) else (kind, value)  # with a 16-bit type it would be dropped
            spec.attribute(name, *typed)
    if form.is_cicp or transfer not in ("linear", "srgb"):  # "unknown": OpenImageIO states what other attributes say
        spec.attribute("oiio:ColorSpace", "unknown")
        if transfer.startswith("gamma") and not form.is_cicp:
            spec.attribute("oiio:Gamma", float(transfer.split()[1]))
    elif transfer == "srgb" or suffix != ".exr":  # not of linear EXR files, whose primaries are those of the input
        spec.attribute("oiio:ColorSpace", "srgb_rec709_scene" if transfer == "srgb" else "lin_rec709_scene")
    if suffix == ".exr" and form.primaries is not None:
        spec.attribute("chromaticities", "float[8]", form.primaries)
    if transfer != "srgb" and suffix != ".exr":
        spec.attribute("Exif:ColorSpace", 65535)  # "uncalibrated"; OpenImageIO cannot write a TIFF without any EXIF
    if names[-1] == "A" and form.is_straight:
        spec.attribute("oiio:UnassociatedAlpha", 1)
    for name, setting in _SETTINGS.get(suffix, {}).items():
        spec.attribute(name, setting)
    return spec


def _write(path: Path, temporary: Path, parts: list[tuple[Any, np.ndarray]]) -> None:
    """Writes specifications and numbers of all parts of a file to a temporary one; errors name the file."""
    import OpenImageIO as oiio

    specs = tuple(spec for spec, _ in parts)
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
