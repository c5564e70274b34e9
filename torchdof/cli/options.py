"""Options that several commands share, besides those of the scene: aperture, blur, accuracy, files and device.

PyTorch is imported when an option is first used, so that help and errors about options appear at once.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..io.paths import existing_image, existing_map, samples_of
from .command import by_option, option, word_or_number

if TYPE_CHECKING:
    import torch

    from ..optics.aperture import Aperture
    from ..optics.blur_table import BlurTable

__all__ = ["Accuracy", "Blur", "Opening"]
__all__ += ["edges_option", "json_option", "pick_device", "make_folder_of", "check_files"]

_IDEAL = ("disc", "gaussian")


@dataclass(frozen=True, kw_only=True)
class Opening:
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
        is_round = self.blades == 0 and self.aperture is None
        if is_round and self.curvature:
            raise ValueError("--curvature is that of blades; give --blades too")
        if is_round and self.rotation:
            raise ValueError("--rotation turns blades or an image; give --blades or --aperture too")

    def opening(self) -> "Aperture | None":
        """The aperture of these options; None if it is round and the same everywhere."""
        from ..io.images import read_image
        from ..optics.aperture import Aperture

        mask = None if self.aperture is None else read_image(self.aperture).light[0].mean(0)
        names = {name: f"--{name.removesuffix('_deg')}" for name in ("blades", "rotation_deg", "curvature", "squeeze")}
        with by_option(names | {"vignetting": "--vignetting"}):
            aperture = Aperture(self.blades, self.rotation, self.curvature, self.squeeze, mask, self.vignetting)
        return None if aperture.is_round and self.squeeze == 1.0 and not aperture.depends_on_place else aperture

    def table_of(self, name: str) -> "BlurTable":
        """A table by name or by path of a JSON file; an aperture of these options replaces its own."""
        from ..optics.blur_table import BlurTable
        from ..optics.table_file import shipped

        opening = self.opening()
        try:
            table = getattr(BlurTable, name)() if name in _IDEAL else BlurTable.load(name)
        except FileNotFoundError:
            names = ", ".join([*_IDEAL, *shipped()])
            raise FileNotFoundError(f"no blur table {name!r}: neither a file nor one of {names}") from None
        return table if opening is None else table.with_aperture(opening)


@dataclass(frozen=True, kw_only=True)
class Blur(Opening):
    """Blur."""

    table: str = option("disc, gaussian, a shipped table such as sato_j15, or a JSON file.", "disc", basic=True)

    def chosen(self) -> "BlurTable":
        """The table of these options, as :meth:`table_of`."""
        return self.table_of(self.table)


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
    no_occlusion: bool = option("One pass that ignores what hides what.", False)
    method: Literal["layered", "fold"] = option("fold is the literal scatter: exact, slow, for small radii.", "layered")

    def options(self) -> dict[str, Any]:
        """These options as arguments of :class:`torchdof.DepthOfField`."""
        return {"tolerance": self.tolerance, "occlusion": not self.no_occlusion, "method": self.method}


def edges_option(default: str) -> Any:
    """The option ``--depth-edges``, whose default differs between commands."""
    return option(
        "Move and sharpen the edges of the depth to where the image has them: unless they prove exact, each one, or "
        "not at all.",
        default,
        group="Depth map",
    )


def json_option() -> Any:
    """The option ``--json``, which every command has."""
    return option("Print what is printed as JSON, for programs: one object a line.", False, names=("--json",))


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


def pick_device(name: str) -> "torch.device":
    """A device by name; "auto" is CUDA if available, else the CPU."""
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(1, device=device).sum().item()
    except (RuntimeError, AssertionError, NotImplementedError):
        raise ValueError(f"--device {name}: there is no such device here; use cpu") from None
    return device
