"""The encoding and the primaries that an image file states: PNG's gAMA and cICP, profiles, EXR's chromaticities."""

import math
import struct
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .transfer import Transfer, decode

Chromaticities = tuple[float, ...]
"""x and y of red, green, blue and white, as EXR files state them."""

REC709: Chromaticities = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
_CICP_PRIMARIES: dict[int, Chromaticities] = {  # code of ITU-T H.273 -> chromaticities
    1: REC709,
    9: (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329),  # Rec.2020
    11: (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.314, 0.351),  # DCI P3
    12: (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329),  # Display P3
}
_CICP_TRANSFERS: dict[int, Transfer] = {  # code of ITU-T H.273 -> encoding
    **{1: "bt709", 6: "bt709", 14: "bt709", 15: "bt709", 4: "gamma 2.2", 5: "gamma 2.8"},
    **{8: "linear", 13: "srgb", 16: "pq", 18: "hlg"},
}
_SRGB_GAMMAS = (2.15, 2.25)  # a gAMA of 1 / 2.2 without more stands for sRGB
_PARAMETERS = ("g", "gab", "gabc", "gabcd", "gabcdef")  # of the formulas of ICC.1, 10.18: (a x + b)^g, c x below d
_CURVE_PLACES = (0.25, 0.5, 0.75)  # encoded numbers at which a curve is compared
_LIKE_SRGB = 0.01  # largest difference in light of a curve that is taken for sRGB's
_BRADFORD = ((0.8951, 0.2664, -0.1614), (-0.7502, 1.7135, 0.0367), (0.0389, -0.0685, 1.0296))


def stated_transfer(attributes: Mapping[str, Any]) -> Transfer | None:
    """The encoding that a file states, by OpenImageIO's attributes; None if that is sRGB, or if it states none.

    cICP comes before a profile, and this before gAMA.

    Raises:
        ValueError: If the file states an encoding that is not decoded.
    """
    if (codes := attributes.get("CICP")) is not None:
        primaries, code, matrix, is_full = (int(number) for number in codes)
        if code not in _CICP_TRANSFERS or primaries not in (*_CICP_PRIMARIES, 2) or matrix or not is_full:
            known = f"transfer {', '.join(map(str, _CICP_TRANSFERS))}, primaries 1, 9, 11 or 12, RGB of full range"
            raise ValueError(
                f"its colours are encoded as cICP {(*codes,)}; expected {known}: convert it to sRGB or EXR"
            )
        return None if code == 13 else _CICP_TRANSFERS[code]
    gamma = _profile_gamma(attributes["ICCProfile"]) if "ICCProfile" in attributes else None
    if gamma is None and "ICCProfile" not in attributes:
        is_linear = str(attributes.get("oiio:ColorSpace", "")).lower().startswith("lin")
        gamma = 1.0 if is_linear else float(attributes.get("oiio:Gamma", 2.2))
    if gamma is None or gamma == 1.0:
        return None if gamma is None else "linear"
    return None if _SRGB_GAMMAS[0] <= gamma <= _SRGB_GAMMAS[1] else f"gamma {gamma:.5g}"


def _profile_gamma(profile: Any) -> float | None:
    """The exponent of the red or grey curve of an ICC profile, from its value at 0.5; None for a curve like sRGB's."""
    content = next((content for name, content in _tags(profile) if name in (b"rTRC", b"kTRC")), b"")
    places = np.array(_CURVE_PLACES)
    srgb = decode(torch.from_numpy(places), "srgb", has_alpha=False, straight=False).numpy()
    try:
        light = _curve(content, places)
    except (struct.error, ValueError):  # cut short
        return None
    if np.abs(light - srgb).max() < _LIKE_SRGB or not 0.01 < light[1] < 0.9:
        return None
    return round(math.log(light[1]) / math.log(_CURVE_PLACES[1]), 4)


def _tags(profile: Any) -> Iterator[tuple[bytes, bytes]]:
    """Names of the tags of an ICC profile, and its content from each on."""
    content = bytes(profile)
    for start in range(132, min(len(content), 132 + 12 * 100), 12):
        yield content[start : start + 4], content[int.from_bytes(content[start + 4 : start + 8], "big") :]


def _curve(content: bytes, encoded: np.ndarray) -> np.ndarray:
    """Light of encoded numbers by a curve of an ICC profile, which is a table, an exponent or a formula."""
    kind, count = content[:4], int.from_bytes(content[8:12], "big")
    if kind == b"curv" and count != 1:
        table = np.frombuffer(content, ">u2", count, 12) / 65535 if count else np.array([0.0, 1.0])
        return np.interp(encoded, np.linspace(0.0, 1.0, len(table)), table)
    if kind == b"curv":
        return encoded ** (int.from_bytes(content[12:14], "big") / 256)
    formula = int.from_bytes(content[8:10], "big") if kind == b"para" else -1
    if not 0 <= formula < len(_PARAMETERS):
        raise ValueError
    numbers = struct.unpack_from(f">{len(_PARAMETERS[formula])}i", content, 12)
    p = dict.fromkeys("bcdef", 0.0) | {"a": 1.0}
    p |= {name: number / 65536 for name, number in zip(_PARAMETERS[formula], numbers, strict=True)}
    if formula in (1, 2):  # both have their threshold where the base is 0; c is added everywhere
        p |= {"d": -p["b"] / (p["a"] or 1.0), "e": p["c"], "f": p["c"], "c": 0.0}
    power = np.maximum(p["a"] * encoded + p["b"], 0.0) ** p["g"] + p["e"]
    return np.where(encoded >= p["d"], power, p["c"] * encoded + p["f"])


def stated_primaries(metadata: Mapping[str, tuple[Any, Any]]) -> Chromaticities | None:
    """Chromaticities that the metadata of a picture state; None for those of sRGB, or if they state none."""
    given = metadata.get("chromaticities", (None, None))[1]
    if given is None and "CICP" in metadata:
        given = _CICP_PRIMARIES.get(int(metadata["CICP"][1][0]))
    elif given is None and "ICCProfile" in metadata:
        given = _profile_primaries(metadata["ICCProfile"][1])
    if given is None or len(given) != 8:
        return None
    stated = tuple(float(number) for number in given)
    is_rec709 = all(abs(one - other) < 2e-3 for one, other in zip(stated, REC709, strict=True))
    return None if is_rec709 else stated


def _profile_primaries(profile: Any) -> Chromaticities | None:
    """Chromaticities of an ICC profile under its white, D50; None without a matrix, or if they are those of sRGB."""
    tags = {name: content for name, content in _tags(profile) if name in (b"rXYZ", b"gXYZ", b"bXYZ")}
    try:
        columns = [np.array(struct.unpack_from(">3i", tags[name], 8)) / 65536 for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
    except (KeyError, struct.error):
        return None
    colours = [*columns, np.sum(columns, axis=0)]
    if min(colour.sum() for colour in colours) <= 0 or colours[3][1] <= 0:
        return None
    places = tuple(float(number) for colour in colours for number in colour[:2] / colour.sum())
    try:
        white = in_rec709(torch.eye(3, dtype=torch.float64).reshape(1, 3, 3, 1), places)[0, ..., 0]
    except ValueError:
        return None
    return None if float((white - torch.eye(3, dtype=torch.float64)).abs().max()) < _LIKE_SRGB else places


def in_rec709(pixels: Tensor, primaries: Chromaticities) -> Tensor:
    """Linear light ``[1, C, H, W]`` with C of 3 or 4, of some primaries, in those of Rec.709 and sRGB.

    Raises:
        ValueError: If the chromaticities are no triangle.
    """
    try:
        matrix = torch.linalg.inv(_to_xyz(REC709)) @ _adapted(primaries) @ _to_xyz(primaries)
    except (RuntimeError, ZeroDivisionError):
        matrix = torch.full((3, 3), torch.nan)
    if not bool(matrix.isfinite().all()):
        raise ValueError(f"its chromaticities must be a triangle around white, got {primaries}")
    light = torch.einsum("ij,bjhw->bihw", matrix.to(pixels), pixels[:, :3])
    return torch.cat([light, pixels[:, 3:]], dim=1)


def _white(primaries: Chromaticities) -> Tensor:
    """XYZ of white, with Y = 1."""
    x, y = primaries[6:]
    return torch.tensor([x / y, 1.0, (1.0 - x - y) / y], dtype=torch.float64)


def _to_xyz(primaries: Chromaticities) -> Tensor:
    """The matrix ``[3, 3]`` from RGB to XYZ."""
    columns = [[x, y, 1.0 - x - y] for x, y in zip(primaries[0:6:2], primaries[1:6:2], strict=True)]
    colours = torch.tensor(columns, dtype=torch.float64).T
    return colours * torch.linalg.solve(colours, _white(primaries))


def _adapted(primaries: Chromaticities) -> Tensor:
    """The matrix ``[3, 3]`` in XYZ that turns a white into that of Rec.709, by Bradford's method."""
    bradford = torch.tensor(_BRADFORD, dtype=torch.float64)
    gains = (bradford @ _white(REC709)) / (bradford @ _white(primaries))
    return torch.linalg.inv(bradford) @ (gains[:, None] * bradford)
