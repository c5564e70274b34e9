"""Options that several commands share, besides those of the scene: aperture, blur, accuracy and files.

PyTorch is imported when an option is first used, so that help and errors about options appear at once.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..io.paths import existing_image, existing_map, samples_of
from .command import by_option, option, word_or_number

if TYPE_CHECKING:
    from ..optics.blur_table import BlurTable

_IDEAL_TABLES = ("disc", "gaussian")


@dataclass(frozen=True, kw_only=True)
class ApertureOptions:
    """Blur."""

    blades: int = option("Aperture blades, from 3; 0 is a round lens.", 0)
    rotation: float = option("Degrees by which blades or image are turned, counter-clockwise.", 0.0)
    curvature: float = option("Of the blades: 0 straight, 1 a circle.", 0.0)
    squeeze: float = option("Height of the blur over its width; 2 for an anamorphic lens.", 1.0)
    aperture: Path | None = option("Picture of the opening, bright where light passes.", metavar="IMAGE")
    vignetting: float = option("Cat's eyes towards the corners: 0 none, 1 closed; not in exported files.", 0.0)

    def __post_init__(self) -> None:
        if self.aperture is not None and (self.blades or self.curvature):
            raise ValueError("--aperture is the whole opening; leave --blades and --curvature out")
        if self.curvature and not self.blades:
            raise ValueError("--curvature is that of blades; give --blades too")
        if self.rotation and not self.blades and self.aperture is None:
            raise ValueError("--rotation turns blades or an image; give --blades or --aperture too")

    def table_of(self, name: str) -> "BlurTable":
        """A table by name or by path of a JSON file; an aperture of these options replaces its own."""
        from ..io.images import read_image
        from ..optics.aperture import Aperture
        from ..optics.blur_table import BlurTable
        from ..optics.table_file import shipped

        mask = None if self.aperture is None else read_image(self.aperture).light[0].mean(0)
        names = {name: f"--{name.removesuffix('_deg')}" for name in ("blades", "rotation_deg", "curvature", "squeeze")}
        with by_option(names | {"vignetting": "--vignetting"}):
            aperture = Aperture(self.blades, self.rotation, self.curvature, self.squeeze, mask, self.vignetting)
        try:
            table = getattr(BlurTable, name)() if name in _IDEAL_TABLES else BlurTable.load(name)
        except FileNotFoundError:
            names_known = ", ".join([*_IDEAL_TABLES, *shipped()])
            raise FileNotFoundError(f"no blur table {name!r}: neither a file nor one of {names_known}") from None
        is_default = aperture.is_round and self.squeeze == 1.0 and not aperture.depends_on_place
        return table if is_default else table.with_aperture(aperture)


@dataclass(frozen=True, kw_only=True)
class Blur(ApertureOptions):
    """Blur."""

    table: str = option("disc, gaussian, a shipped table such as sato_j15, or a JSON file.", "disc", basic=True)

    def files(self) -> list[Path]:
        """The table and the picture of the opening, if they are files."""
        return [Path(name) for name in (self.table, self.aperture) if name is not None and Path(name).is_file()]


@dataclass(frozen=True, kw_only=True)
class Accuracy:
    """Blur."""

    tolerance: Any = option(
        "Accepted RMS error on display, of 1: draft (8/255), preview (4/255), final (1/255) or a number; 0 is exact.",
        "final",
        metavar="NAME|NUMBER",
        read=word_or_number(("draft", "preview", "final"), "--tolerance expects draft, preview, final or a number"),
        basic=True,
    )
    no_occlusion: bool = option("One pass that ignores occlusion.", False)
    method: Literal["layered", "fold"] = option("fold is the literal scatter: exact, slow, for small radii.", "layered")
    depth_edges: Literal["auto", "repair", "as-given"] | None = option(
        "Sharpen the edges of the depth and move them to those of the image: auto unless they prove exact, repair each "
        "one, as-given never. Default: auto; in exported files as-given.",
        group="Depth map",
    )

    def arguments(self) -> dict[str, Any]:
        """These options as arguments of :class:`torchdof.DepthOfField`."""
        edges = {} if self.depth_edges is None else {"depth_edges": self.depth_edges.replace("-", " ")}
        return {"tolerance": self.tolerance, "occlusion": not self.no_occlusion, "method": self.method, **edges}


def json_option() -> Any:
    """The option ``--json``, which every command has."""
    return option("Print results as JSON, for programs: one object a line.", False, names=("--json",))


def make_folder_of(path: Path) -> None:
    """Creates the folder of ``path`` if it is missing.

    Raises:
        OSError: If the folder cannot be created.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(f"{path}: its folder cannot be made ({error.strerror})") from None


def check_files(image: Path, depth: Path | None, out: Path | None) -> None:
    """Refuse missing inputs, an output that is also an input, and an output of an unsupported type."""
    existing_image(image)
    if depth is not None:
        existing_map(depth)
    if out is None:
        return
    if any(source is not None and os.path.realpath(source) == os.path.realpath(out) for source in (image, depth)):
        raise ValueError(f"{out}: is one of the inputs; write to another file")
    samples_of(out)
