"""The encoding and the primaries that an image file states: PNG's gAMA and cICP, EXR's chromaticities."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from .transfer import Transfer

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
_BRADFORD = ((0.8951, 0.2664, -0.1614), (-0.7502, 1.7135, 0.0367), (0.0389, -0.0685, 1.0296))


def stated_transfer(attributes: Mapping[str, Any]) -> Transfer | None:
    """The encoding that a PNG states, by OpenImageIO's attributes; None if that is sRGB, or if it states none.

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
    """The exponent of the red or grey curve of an ICC profile; None for other curves, such as that of sRGB."""
    content = bytes(profile)
    for start in range(132, min(len(content), 132 + 12 * 100), 12):
        if content[start : start + 4] in (b"rTRC", b"kTRC"):
            place = int.from_bytes(content[start + 4 : start + 8], "big")
            kind, count, number = content[place : place + 4], content[place + 8 : place + 12], content[place + 12 :]
            if kind == b"curv" and int.from_bytes(count, "big") <= 1:
                return int.from_bytes(number[:2], "big") / 256 if any(count) else 1.0
            if kind == b"para" and count[:2] == b"\0\0":
                return int.from_bytes(number[:4], "big") / 65536
            break
    return None


def stated_primaries(metadata: Mapping[str, tuple[Any, Any]]) -> Chromaticities | None:
    """Chromaticities that the metadata of a picture state; None for those of sRGB, or if they state none."""
    given = metadata.get("chromaticities", (None, None))[1]
    if given is None and "CICP" in metadata:
        given = _CICP_PRIMARIES.get(int(metadata["CICP"][1][0]))
    if given is None or len(given) != 8:
        return None
    stated = tuple(float(number) for number in given)
    is_rec709 = all(abs(one - other) < 2e-3 for one, other in zip(stated, REC709, strict=True))
    return None if is_rec709 else stated


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
