"""Options that several commands share: depth map, scene, aperture, blur, accuracy; checks of the files they name."""

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..io.paths import existing_image, existing_map, samples_of
from .command import Group, Parsed, number_or, numbers, option, refuse
from .lens import Lens

if TYPE_CHECKING:
    from torch import Tensor
    from typing_extensions import Self

    from ..optics.blur_table import BlurTable

_NEAR_M, _FAR_PER_NEAR = 1.0, 8.0  # nearest relative depth in m, and farthest over nearest, by default
INTEGER_TYPES = (".png", ".jpg", ".jpeg", ".webp")  # types that hold whole numbers only
_RENDER_TYPES = (".exr", ".tif", ".tiff")  # types whose floats are taken for distances
LIKE_RELATIVE = (
    "its numbers grow downwards, as those of relative depth do: --relative-kind disparity if larger is nearer (Depth "
    "Anything), --relative-kind depth if larger is farther (Marigold), --depth-kind z if they are distances"
)


class DepthMap(Group):
    """Depth map."""

    depth_kind: Literal["auto", "z", "distance", "disparity", "inverse", "relative", "coc"] = option(
        "z along the axis or distance along the ray, in metres after scale * (value + offset); disparity or inverse "
        "depth, in metres after scale / (value + offset); relative, between --near-m and --far-m; coc, the signed "
        "blur radius in pixels; auto guesses and says so, but is z in sequences and with --strict.",
        "auto",
        basic=True,
    )
    depth_scale: float | None = option("0.001 for maps in millimetres.", basic=True)
    depth_offset: float = option("Added to each value first.", 0.0)
    near_m: float | None = option("Distance of the nearest value of relative depth. Default: 1, or --far-m / 8.")
    far_m: float | None = option("Distance of its farthest value (inf allowed). Default: 8 times --near-m.")
    relative_kind: Literal["disparity", "inverse", "depth"] | None = option(
        "Of relative depth: larger is nearer (MiDaS, Depth Anything; the default), or with depth farther (Marigold)."
    )
    value_range: tuple[float, float] | None = option(
        "Its smallest and largest value; default: those of each frame.", type=Parsed("LOW,HIGH", numbers(2), "0,255")
    )
    depth_unknown: float | None = option("A value that means 'not measured', such as 0, -1 or inf.")
    fill_depth: float | str | None = option(
        "Fill pixels without depth from the nearest one, from the farthest around, or with a distance (inf for a sky).",
        type=Parsed("nearest|far|METRES", number_or("nearest", "far")),
    )
    depth_channel: str | None = option("Channel, layer or part (or array of an .npz) that is depth.")
    strict: bool = option("Refuse what looks like a wrong unit or scale, instead of warning.", False)

    def __post_init__(self) -> None:
        super().__post_init__()
        given = self.given(DepthMap)
        has_scale = bool(given & {"depth_scale", "depth_offset"})
        is_relative = bool(given & {"near_m", "far_m", "relative_kind", "value_range"})
        if self.depth_kind == "auto" and (is_relative or has_scale or self.strict):  # these options imply the kind
            object.__setattr__(self, "depth_kind", "relative" if is_relative else "z")
        if self.depth_kind == "relative":
            refuse((has_scale, "relative depth has no --depth-scale and --depth-offset: near and far say it"))
        else:
            options = "--near-m, --far-m, --relative-kind and --value-range"
            refuse((is_relative, f"{options} are for relative depth, and not for --depth-kind {self.depth_kind}"))

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

    def with_meaning(self, meaning: Mapping[str, Any]) -> "tuple[Self, str]":
        """These options with what a phone states about its depth, unless an option states it, and a message."""
        if self.depth_kind not in ("auto", "relative"):
            return self, ""
        stated = {"relative_kind": meaning["kind"], "fill_depth": "far"}
        if self.depth_kind == "auto":  # no option states distances
            stated |= {name: meaning[name] for name in ("near_m", "far_m", "value_range")}
        unset = {name: value for name, value in stated.items() if getattr(self, name) is None}
        options = replace(self, depth_kind="relative", **unset)
        ends = "from {:.3g} to {:.3g} m".format(*options.ends_m)
        return options, f"its own depth is used, {ends} (else name a depth file after it: IMAGE DEPTH)"

    def guessed(self, values: "Tensor", path: Path, is_metric: bool) -> "tuple[Self, str]":
        """These options with a guessed kind, and a message unless it is clear; ``is_metric``: others are in metres."""
        from ..depth.guess import guess_kind, looks_relative

        known = values if self.depth_unknown is None else values.masked_fill(values == self.depth_unknown, math.nan)
        suffix = path.suffix.lower()
        guess = guess_kind(known, suffix in INTEGER_TYPES, is_metric or suffix in _RENDER_TYPES)
        if guess.kind == "z" and guess.scale is None and is_metric:
            is_clear = guess_kind(known).kind == "z"
            message = "" if is_clear else f"taken for metres, as the options are in metres, but {LIKE_RELATIVE}"
            return replace(self, depth_kind="z"), message
        options = replace(
            self,
            depth_kind=guess.kind,
            depth_scale=guess.scale,
            depth_unknown=guess.unknown if self.depth_unknown is None else self.depth_unknown,
            fill_depth="far" if self.fill_depth is None else self.fill_depth,
        )
        finite = known[known.isfinite()]
        if finite.numel() and bool((finite == finite[0]).all()):
            same = f"has one value everywhere, {float(finite[0]):g}, so nothing is nearer or farther"
            return options, f"{same}; is this the depth map? it was taken for metres (else --depth-kind)"
        if guess.kind == "z":
            unit, other = {
                0.001: (
                    "millimetres",
                    ", with 0.01 for centimetres, 0.0039 for KITTI's metres * 256, 0.0002 for * 5000",
                ),
                1 / 256: ("metres * 256, as KITTI's", ", with 0.01 for centimetres, 0.001 for millimetres"),
            }.get(guess.scale or 1.0, ("metres", ""))
            doubt = f", but {LIKE_RELATIVE}" if guess.scale is None and looks_relative(known) else ""
            return options, f"taken for {unit} (else --depth-kind, --depth-scale{other}){doubt}"
        larger, smaller = ("nearer", "farther") if guess.relative_kind == "disparity" else ("farther", "nearer")
        message = f"taken for relative depth (else --depth-kind), larger is {larger} "
        other_kind = "depth" if guess.relative_kind == "disparity" else "disparity"
        if guess.is_sure:
            message += f"(else --relative-kind {other_kind})"
        else:
            message += f"by a guess that is not safe: --relative-kind {guess.relative_kind} if larger is {larger}, "
            message += f"--relative-kind {other_kind} if larger is {smaller}"
        message += ", from {:g} to {:g} m (else --near-m, --far-m)".format(*self.ends_m)
        return replace(options, relative_kind=guess.relative_kind), message


class Scene(Lens, DepthMap):
    """Options for focus, lens and depth map, for commands that take an image and its depth."""

    def __post_init__(self) -> None:
        super().__post_init__()
        has_lens = self.depth_kind == "coc" and self.given(Lens) - {"fov_deg"}
        refuse((has_lens, "--depth-kind coc is the blur itself and takes no camera; leave focus and lens out"))


class Blur(Group):
    """Blur."""

    table: str = option("disc, gaussian, a shipped table such as sato_j15, or a JSON file.", "disc", basic=True)
    blades: int = option("Aperture blades, from 3; 0 is a round lens.", 0)
    rotation: float = option("Degrees by which blades or image are turned, counter-clockwise.", 0.0)
    curvature: float = option("Of the blades: 0 straight, 1 a circle.", 0.0)
    squeeze: float = option("Height of the blur over its width; 2 for an anamorphic lens.", 1.0)
    aperture: Path | None = option("Picture of the opening, bright where light passes.", metavar="IMAGE")
    vignetting: float = option("Cat's eyes towards the corners: 0 none, 1 closed; not in exported files.", 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        has_both = self.aperture and (self.blades or self.curvature)
        turns_nothing = self.rotation and not self.blades and not self.aperture
        refuse(
            (has_both, "--aperture is the whole opening; leave --blades and --curvature out"),
            (turns_nothing, "--rotation turns blades or an image; give --blades or --aperture too"),
        )

    def blur_table(self) -> "BlurTable":
        """The table; an aperture of these options replaces its own."""
        from ..io.images import read_image
        from ..optics.aperture import Aperture

        table = named_table(self.table)
        if not self.given(Blur) - {"table"}:
            return table
        mask = None if self.aperture is None else read_image(self.aperture).light[0].mean(0)
        aperture = Aperture(self.blades, self.rotation, self.curvature, self.squeeze, mask, self.vignetting)
        return table.replace(aperture=aperture)

    def files(self) -> list[Path]:
        """The table and the picture of the opening, if they are files."""
        return [Path(name) for name in (self.table, self.aperture) if name is not None and Path(name).is_file()]


class Accuracy(Group):
    """Blur."""

    tolerance: Any = option(
        "Accepted RMS error on display, of 1: draft is 8/255, preview 4/255, final 1/255; 0 is exact.",
        "final",
        type=Parsed("draft|preview|final|NUMBER", number_or("draft", "preview", "final")),
        basic=True,
    )
    no_occlusion: bool = option("One pass that ignores occlusion.", False)
    method: Literal["layered", "fold"] = option("fold is the literal scatter: exact, slow, for small radii.", "layered")
    depth_edges: Literal["auto", "repair", "as-given"] | None = option(
        "Move edges of the depth to those of the image: auto unless they prove exact, repair each one, as-given never. "
        "Default: auto; in exported files with --layout whole, which cannot repair them, as-given.",
        group="Depth map",
    )

    def arguments(self) -> dict[str, Any]:
        """These options as arguments of :class:`torchdof.DepthOfField`."""
        arguments = {"tolerance": self.tolerance, "occlusion": not self.no_occlusion, "method": self.method}
        return arguments | ({"depth_edges": self.depth_edges.replace("-", " ")} if self.depth_edges else {})


def named_table(name: str) -> "BlurTable":
    """A table by name or by path of a JSON file."""
    from ..optics.blur_table import BlurTable

    return getattr(BlurTable, name)() if name in ("disc", "gaussian") else BlurTable.load(name)


def check_files(image: Path, depth: Path | None, *outputs: Path | None, matte: Path | None = None) -> None:
    """Refuse missing inputs, outputs that are inputs or the same file, and outputs of an unsupported type."""
    existing_image(image)
    for path in filter(None, (depth, matte)):
        existing_map(path)
    inputs = map(os.path.realpath, filter(None, (image, depth, matte)))
    problems = dict.fromkeys(inputs, "is one of the inputs; write to another file")
    for out in filter(None, outputs):
        if problem := problems.get(os.path.realpath(out)):
            raise ValueError(f"{out}: {problem}")
        samples_of(out)
        problems[os.path.realpath(out)] = "would be written twice; give each picture a file of its own"
