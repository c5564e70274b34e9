"""Options for the depth map: their meaning, their defaults and guesses, and contradictions; and those of a whole scene.

PyTorch is imported when an option is first used, so that help and errors about options appear at once.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from .command import numbers, option, word_or_number
from .lens import Lens

if TYPE_CHECKING:
    from torch import Tensor

_NEAR_M, _FAR_PER_NEAR = 1.0, 8.0  # nearest relative depth in m, and farthest over nearest, by default
_INTEGER_TYPES = (".png", ".jpg", ".jpeg", ".webp")  # types that hold whole numbers only
_RENDER_TYPES = (".exr", ".tif", ".tiff")  # types whose floats are taken for distances


@dataclass(frozen=True, kw_only=True)
class DepthMap:
    """Depth map."""

    depth_kind: Literal["auto", "z", "distance", "disparity", "inverse", "relative", "coc"] = option(
        "What the numbers are: z along the optical axis or distance along the ray, in metres after scale * (value + "
        "offset); disparity or inverse depth, in metres after scale / (value + offset); relative, as estimators give "
        "it, between --near-m and --far-m; or coc, the signed blur radius in pixels (negative is near). auto guesses "
        "between relative, millimetres and metres, and says which; in sequences, and with --strict, it is z.",
        "auto",
        basic=True,
    )
    depth_scale: float | None = option("0.001 for maps in millimetres.", basic=True)
    depth_offset: float = option("Added to each value first.", 0.0)
    near_m: float | None = option("Distance of the nearest value of relative depth. Default: 1, or --far-m / 8.")
    far_m: float | None = option("Distance of its farthest value (inf allowed). Default: 8 times --near-m.")
    relative_kind: Literal["disparity", "inverse", "depth"] | None = option(
        "What relative depth is: disparity or inverse depth, larger is nearer (MiDaS, Depth Anything; the default), or "
        "depth, larger is farther (Marigold)."
    )
    value_range: tuple[float, float] | None = option(
        "Smallest and largest value of relative depth; default: those of each frame.",
        metavar="LOW,HIGH",
        read=numbers(2, "--value-range expects two numbers such as 0,255"),
    )
    depth_unknown: float | None = option("A value that means 'not measured', such as 0, -1 or inf.")
    fill_depth: float | str | None = option(
        "Fill pixels without depth: from the nearest one, from the farthest around (stereo misses the background), or "
        "with a distance (inf for a sky).",
        metavar="nearest|far|METRES",
        read=word_or_number(("nearest", "far"), "--fill-depth expects nearest, far or metres"),
    )
    depth_channel: str | None = option("Channel (or array of an .npz) that is depth.")
    strict: bool = option("Refuse what looks like a wrong unit or scale, instead of warning.", False)

    def __post_init__(self) -> None:
        has_scale = self.depth_scale is not None or self.depth_offset != 0.0
        is_relative = any(
            value is not None for value in (self.near_m, self.far_m, self.relative_kind, self.value_range)
        )
        if self.depth_kind == "auto" and (is_relative or has_scale or self.strict):  # these options imply the kind
            object.__setattr__(self, "depth_kind", "relative" if is_relative else "z")
        if self.depth_kind == "relative" and has_scale:
            raise ValueError("relative depth has no --depth-scale and --depth-offset: near and far say it")
        if self.depth_kind != "relative" and is_relative:
            raise ValueError(
                "--near-m, --far-m, --relative-kind and --value-range are for relative depth, and not for --depth-kind "
                f"{self.depth_kind}"
            )

    @property
    def ends_m(self) -> tuple[float, float]:
        """Distances in metres of the nearest and the farthest value of relative depth."""
        near_m, far_m = self.near_m, self.far_m
        if near_m is None:
            near_m = _NEAR_M if far_m is None or far_m == math.inf else far_m / _FAR_PER_NEAR
        return near_m, near_m * _FAR_PER_NEAR if far_m is None else far_m

    @property
    def is_to_scale(self) -> bool:
        """Whether distances are in metres, and not only assumed for relative depth."""
        return self.depth_kind != "relative" or self.near_m is not None or self.far_m is not None

    def guessed(self, values: "Tensor", path: Path, is_metric: bool) -> "tuple[DepthMap, str]":
        """The same with a guessed kind in the place of ``auto``, and a message about the guess.

        If other options are in metres (``is_metric``) and so is the guess, the message is empty. Otherwise holes are
        filled from the far side by default.
        """
        from ..depth.guess import guess_kind

        known = values if self.depth_unknown is None else values.masked_fill(values == self.depth_unknown, math.nan)
        suffix = path.suffix.lower()
        guess = guess_kind(known, suffix in _INTEGER_TYPES, is_metric or suffix in _RENDER_TYPES)
        if guess.kind == "z" and guess.scale == 1.0 and is_metric:
            return replace(self, depth_kind="z"), ""
        fill, unknown = "far" if self.fill_depth is None else self.fill_depth, self.depth_unknown
        unknown = guess.unknown if unknown is None else unknown
        guessed_map = replace(self, depth_kind=guess.kind, depth_unknown=unknown, fill_depth=fill)
        if guess.kind == "z":
            unit = "metres" if guess.scale == 1.0 else "millimetres"
            message = f"taken for {unit} (else --depth-kind, --depth-scale)"
            return replace(guessed_map, depth_scale=None if guess.scale == 1.0 else guess.scale), message
        larger, other = ("nearer", "depth") if guess.relative_kind == "disparity" else ("farther", "disparity")
        near_m, far_m = guessed_map.ends_m
        message = f"taken for relative depth (else --depth-kind), larger is {larger} (else --relative-kind {other}), "
        message += f"from {near_m:g} to {far_m:g} m (else --near-m, --far-m)"
        return replace(guessed_map, relative_kind=guess.relative_kind), message


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Options for focus, lens and depth map, for commands that take an image and its depth."""

    lens: Lens = Lens()
    depth_map: DepthMap = DepthMap()

    def __post_init__(self) -> None:
        lens = self.lens
        if self.depth_map.depth_kind == "coc" and lens != Lens(fov_deg=lens.fov_deg):
            raise ValueError(
                "--depth-kind coc is the blur itself and takes no camera; leave focus and lens options out"
            )

    def of_sequence(self) -> "Scene":
        """The same for a sequence: "auto" becomes "z", because a guess could differ from frame to frame."""
        is_guessed = self.depth_map.depth_kind == "auto"
        return replace(self, depth_map=replace(self.depth_map, depth_kind="z")) if is_guessed else self
