"""Writes portrait.heic, as an iPhone writes portraits: photograph, disparity and matte, all turned by 90 degrees.

Needs pillow-heif, which encodes the three pictures; this script puts them into one file. Run it in this folder.
"""

import io
import math
import struct

import numpy as np
import pillow_heif
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

D_MIN, D_MAX = 0.25, 2.0  # 1/m
PHOTOGRAPH, DISPARITY, MATTE, EXIF = 1, 2, 3, 4  # item numbers


def box(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", 8 + len(body)) + kind + body


def full(kind: bytes, body: bytes, version: int = 0) -> bytes:
    return box(kind, struct.pack(">I", version << 24) + body)


def encoded(values: np.ndarray, mode: str) -> tuple[bytes, bytes]:
    """Decoder configuration and data of a picture without loss."""
    heif, file = pillow_heif.from_bytes(mode, values.shape[1::-1], values.tobytes()), io.BytesIO()
    heif.save(file, quality=-1, chroma=444, matrix_coefficients=0 if mode == "RGB" else 6)
    content = file.getvalue()
    start = content.index(b"hvcC") - 4
    size = int.from_bytes(content[start : start + 4], "big")
    return content[start : start + size], content[content.index(b"mdat") + 4 :]


def bits_of(value: float) -> str:
    """Sign, exponent, length of the mantissa and mantissa of a number in a message about depth."""
    mantissa, exponent = math.frexp(value)  # value = mantissa * 2 ** exponent, mantissa in [0.5, 1)
    return f"0{exponent - 1 + 31:07b}{22:05b}{round((2 * mantissa - 1) * 2**23):023b}"


def message() -> bytes:
    """Supplemental information of kind 177: disparity, uniformly quantized between both ends."""
    bits = "0011" + "010" + "1" + bits_of(D_MIN) + bits_of(D_MAX) + "1"  # flags; kind 1; reference view 0; ends
    bits += "0" * (-len(bits) % 8)
    payload = int(bits, 2).to_bytes(len(bits) // 8, "big")
    unit = bytes([39 << 1, 1, 177, len(payload)]) + payload + b"\x80"
    unit = struct.pack(">I", len(unit)) + unit
    return struct.pack(">I", len(unit)) + unit


y, x = np.mgrid[:128, :192]  # each side of the maps is 64 or more: smaller ones would be padded
is_subject = (x > 31) & (abs(y - 64) < 32)
photograph = np.stack([x, y, np.full_like(x, 90)], -1).astype(np.uint8)
disparity = np.where(is_subject, 255, x)[::2, ::2].astype(np.uint8)
matte = np.where(is_subject, 255, 0).astype(np.uint8)
pictures = [encoded(photograph, "RGB"), encoded(disparity, "L"), encoded(matte, "L")]
tags = Image.Exif()
tags[0x010F], tags[0x0112] = "made", 6
tags.get_ifd(0x8769).update({0x920A: IFDRational(57, 10), 0x829D: IFDRational(3, 2), 0xA405: 26})
exif = struct.pack(">I", 6) + tags.tobytes()
items = {**{n: data for n, (_, data) in enumerate(pictures, 1)}, EXIF: exif}

# the first property turns a picture by 3 * 90 degrees counter-clockwise
properties, linked = (
    [box(b"irot", b"\x03")],
    {n: [1] for n in (PHOTOGRAPH, DISPARITY, MATTE)},
)
kinds = {
    PHOTOGRAPH: b"",
    DISPARITY: full(b"auxC", b"urn:mpeg:hevc:2015:auxid:2\0" + message()),
    MATTE: full(b"auxC", b"urn:com:apple:photo:2018:aux:portraiteffectsmatte\0"),
}
for n, ((configuration, _), values) in enumerate(zip(pictures, (photograph, disparity, matte), strict=True), 1):
    for body in (configuration, full(b"ispe", struct.pack(">II", *values.shape[1::-1])), kinds[n]):
        if body:
            properties.append(body)
            linked[n].insert(-1, len(properties))  # turned at the end
ipma = struct.pack(">I", 3) + b"".join(
    struct.pack(">HB", n, len(numbers)) + bytes(128 + number for number in numbers) for n, numbers in linked.items()
)


def meta(places: dict[int, int]) -> bytes:
    infos = b"".join(
        full(b"infe", struct.pack(">HH", n, 0) + (b"Exif" if n == EXIF else b"hvc1") + b"\0", 2) for n in items
    )
    iloc = (
        b"\x44\0"
        + struct.pack(">H", len(items))
        + b"".join(struct.pack(">HHHII", n, 0, 1, places[n], len(data)) for n, data in items.items())
    )
    links = [(b"auxl", DISPARITY), (b"auxl", MATTE), (b"cdsc", EXIF)]
    iref = b"".join(box(kind, struct.pack(">HHH", n, 1, PHOTOGRAPH)) for kind, n in links)
    return full(
        b"meta",
        full(b"hdlr", bytes(4) + b"pict" + bytes(13))
        + full(b"pitm", struct.pack(">H", PHOTOGRAPH))
        + full(b"iloc", iloc)
        + full(b"iinf", struct.pack(">H", len(items)) + infos)
        + full(b"iref", iref)
        + box(b"iprp", box(b"ipco", b"".join(properties)) + full(b"ipma", ipma)),
    )


ftyp = box(b"ftyp", b"heic" + bytes(4) + b"mif1heic")
start = len(ftyp) + len(meta(dict.fromkeys(items, 0))) + 8
places = {n: start + sum(len(items[k]) for k in items if k < n) for n in items}
content = ftyp + meta(places) + box(b"mdat", b"".join(items.values()))
open("portrait.heic", "wb").write(content)
