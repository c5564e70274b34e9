import struct
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from torchdof.io.images import Picture, read_image, write_image

TAGS: dict[str, tuple[Any, Any]] = {
    **{"Make": ("string", "A"), "FNumber": ("float", 1.75), "DateTime": ("string", "2026:01:02 03:04:05")},
    **{"Exif:FocalLength": ("float", 4.25), "Exif:FocalLengthIn35mmFilm": ("uint16", 26)},
    **{"GPS:Latitude": ("float[3]", (48.0, 8.0, 14.0)), "Orientation": ("uint16", 1)},
}


def chunks(path: Path) -> dict[bytes, bytes]:
    """The chunks of a RIFF file, whose sizes must add up to its own."""
    content = path.read_bytes()
    assert content[:4] + content[8:12] == b"RIFFWEBP" and struct.unpack_from("<I", content, 4)[0] + 8 == len(content)
    start, found = 12, {}
    while start < len(content):
        name, length = struct.unpack_from("<4sI", content, start)
        found[name] = content[start + 8 : start + 8 + length]
        start += 8 + length + length % 2
    assert start == len(content)
    return found


@pytest.mark.parametrize("channels", [("R", "G", "B"), ("R", "G", "B", "A")])
def test_the_tags_are_a_chunk_after_the_picture_which_stays_as_it_is(channels: tuple[str, ...], tmp_path: Path) -> None:
    pixels = torch.rand(1, len(channels), 15, 23, generator=torch.Generator().manual_seed(0)) * 0.5
    plain, tagged = tmp_path / "plain.webp", tmp_path / "tagged.webp"
    write_image(plain, Picture(pixels, channels))
    write_image(tagged, Picture(pixels, channels, metadata=TAGS))
    parts = chunks(tagged)
    assert [*parts] == [b"VP8X", *[b"ALPH"] * (len(channels) == 4), b"VP8 ", b"EXIF"]
    assert parts[b"VP8X"] == bytes([0x18 if len(channels) == 4 else 0x08, 0, 0, 0, 22, 0, 0, 14, 0, 0])
    without, with_tags = (oiio.ImageBuf(str(path)).get_pixels(oiio.UINT8) for path in (plain, tagged))
    np.testing.assert_array_equal(with_tags, without)
    metadata = read_image(tagged).metadata
    assert {name: metadata[name][1] for name in TAGS} == {name: value for name, (_, value) in TAGS.items()}
    assert b"EXIF" not in chunks(plain)
