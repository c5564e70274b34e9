"""JPEG portraits as phones write them: pictures of :func:`jpeg`, put together by hand."""

import base64
import struct
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from tests.files import store

XMP, EXTENSION = b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"


def jpeg(values: np.ndarray, **attributes: Any) -> bytes:
    """A picture as JPEG."""
    with tempfile.TemporaryDirectory() as folder:
        settings: dict[str, Any] = {"compression": "jpeg:100", "jpeg__subsampling": "4:4:4", **attributes}
        return store(Path(folder, "a.jpg"), values, "uint8", **settings).read_bytes()


def png(values: np.ndarray) -> bytes:
    """A picture as PNG of 8 or 16 bits."""
    with tempfile.TemporaryDirectory() as folder:
        return store(Path(folder, "a.png"), values, str(values.dtype)).read_bytes()


def segment(marker: int, body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, 2 + len(body)) + body


def with_segments(picture: bytes, *segments: bytes) -> bytes:
    """A JPEG picture with segments at its start."""
    return picture[:2] + b"".join(segments) + picture[2:]


def xmp(text: str) -> bytes:
    return segment(0xE1, XMP + f"<x:xmpmeta><rdf:RDF>{text}</rdf:RDF></x:xmpmeta>".encode())


def gdepth(picture: bytes, depth: bytes, extended: bool = False, original: bytes = b"", **properties: object) -> bytes:
    """A photograph with a GDepth map in its XMP data, or in its extended XMP data, which has pieces of 60,000 bytes."""
    stated = " ".join(f'GDepth:{name}="{value}"' for name, value in properties.items())
    data = f'<rdf:Description GDepth:Data="{base64.b64encode(depth).decode()}"'
    data += f' GImage:Data="{base64.b64encode(original).decode()}"/>' if original else "/>"
    if not extended:
        return with_segments(picture, xmp(f"<rdf:Description {stated}/>{data}"))
    pieces = [data.encode()[start : start + 60_000] for start in range(0, len(data), 60_000)]
    segments = [
        segment(0xE1, EXTENSION + b"0" * 32 + struct.pack(">II", len(data), 60_000 * n) + piece)
        for n, piece in enumerate(pieces)
    ]
    return with_segments(picture, xmp(f"<rdf:Description {stated}/>"), *reversed(segments))


def dynamic_depth(
    picture: bytes, *items: tuple[str, bytes], gap: bytes = b"", padding: int = 0, **properties: object
) -> bytes:
    """A photograph with further pictures behind it, listed by their meaning; a gap of bytes is not listed."""
    stated = " ".join(f'DepthMap:{name}="{value}"' for name, value in properties.items())
    first = f'Item:Semantic="Primary" Item:Mime="image/jpeg" Item:Padding="{padding}"'
    listed = f"<rdf:li><Container:Item {first}/></rdf:li>"
    for meaning, content in items:
        name = f'Item:DataURI="{meaning}"' if "/" in meaning else f'Item:Semantic="{meaning}"'
        listed += f'<rdf:li><Container:Item {name} Item:Mime="image/jpeg" Item:Length="{len(content)}"/></rdf:li>'
    text = f"<Container:Directory><rdf:Seq>{listed}</rdf:Seq></Container:Directory><Camera:DepthMap {stated}/>"
    return with_segments(picture, xmp(text)) + bytes(padding) + gap + b"".join(content for _, content in items)


def multi_picture(picture: bytes, *others: bytes) -> bytes:
    """A multi-picture file, with its index in the first picture."""
    count = 1 + len(others)
    head = struct.pack("<2sHIH", b"II", 42, 8, 1) + struct.pack("<HHII", 0xB002, 7, 16 * count, 26) + bytes(4)
    index_at = 2 + 4 + 4  # behind the start of the file, marker and size, "MPF"
    place = len(picture) + 4 + 4 + len(head) + 16 * count - index_at
    entries = struct.pack("<IIIHH", 0x030000, len(picture), 0, 0, 0)
    for other in others:
        entries += struct.pack("<IIIHH", 0, len(other), place, 0, 0)
        place += len(other)
    return with_segments(picture, segment(0xE2, b"MPF\0" + head + entries)) + b"".join(others)


def apple(picture: bytes, kind: str, ends: tuple[float, float] | None = None) -> bytes:
    """A further picture with Apple's statement of its kind."""
    stated = f"<apdi:AuxiliaryImageType>{kind}</apdi:AuxiliaryImageType>"
    for name, value in zip(("Min", "Max"), ends or (), strict=False):
        stated += f"<apdi:Float{name}Value>{value}</apdi:Float{name}Value>"
    return with_segments(picture, xmp(f"<rdf:Description>{stated}</rdf:Description>"))
