"""The options of a rendering, defined once: names, types, defaults, meaning, checks."""

import dataclasses
import inspect
import math
from typing import Any, Literal, TypedDict, TypeVar, get_args

import torch
from torch import Tensor

from .optics.blur_table import BlurTable
from .optics.camera import Camera
from .validation import choice, fields, number, show, tolerance_of

__all__ = [
    "OPTION_NAMES",
    "DepthEdges",
    "Method",
    "OptionArguments",
    "Options",
    "Tolerance",
    "from_config",
    "spells_options",
    "to_config",
]

Method = Literal["layered", "fold"]
DepthEdges = Literal["auto", "repair", "as given"]
"""Repair of depth edges before rendering: if the map is inexact, always, or never."""

Tolerance = float | Literal["draft", "preview", "final"]
"""RMS difference, display-encoded, from the same rendering with exact kernels, dense layers and full resolution."""

_DISC = BlurTable.disc()  # shared, because a table caches its hash
_Decorated = TypeVar("_Decorated")


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of a rendering.

    Args:
        table: Blur measured from a lens; None takes the ideal disc.
        tolerance: Accepted RMS difference, display-encoded, from the same rendering with exact kernels, dense layers
            and full resolution. 0 gives that rendering itself. Its kernels are interpolated between layers half a pixel
            apart; if depth is noise, this differs by 1 to 2.5/255 RMS from a scatter of each pixel's own kernel. While
            gradients with respect to the circle of confusion are recorded, layers are fixed instead of lying at the
            scene's ends: if the image is noise, the picture then differs by up to 2.5/255 for blurs of about 1 px and
            1.5/255 up to 4 px, whatever the tolerance, and by less than 1/255 beyond the tolerance for larger ones.
            ``"draft"`` is 8/255, ``"preview"`` 4/255 and ``"final"`` 1/255.
        occlusion: True composites layers far to near: blurred foregrounds cover the surfaces behind them, and blurred
            backgrounds do not bleed onto sharp foregrounds. False is the algorithm of the paper: the light of all
            pixels is added.
        normalize: Only with ``occlusion=False``: False leaves the plain sum of the paper.
        method: ``"layered"`` convolves layers (fast); ``"fold"`` is the literal scatter of the paper.
        max_coc_px: Largest radius in a static plan (compiled, exported); larger ones are rendered with this radius.
        check: Refuse NaN and non-positive depths and non-finite light before rendering. False skips these checks and
            their cost; a pixel with an invalid depth is then returned sharp and does not affect others.
        depth_edges: ``"auto"`` sharpens the edges of the depth and moves them to the edges of the image, unless the
            depth of this frame is found exact; ``"repair"`` examines each edge; ``"as given"`` changes nothing. See
            :func:`torchdof.depth.repair_edges`.

    Raises:
        ValueError: If an option is invalid; the message names it.

    Example:
        >>> Options(table=None, tolerance="preview") == Options(tolerance=4 / 255)
        True
    """

    table: BlurTable = None  # type: ignore[assignment]  # becomes the disc
    tolerance: float = 1 / 255
    occlusion: bool = True
    normalize: bool = True
    method: Method = "layered"
    max_coc_px: float = 64.0
    check: bool = True
    depth_edges: DepthEdges = "auto"

    def __post_init__(self) -> None:
        object.__setattr__(self, "table", _DISC if self.table is None else self.table)
        if not isinstance(self.table, BlurTable):
            got = type(self.table).__name__
            raise ValueError(f"table must be a torchdof.BlurTable, got {got}; read a file with BlurTable.load()")
        object.__setattr__(self, "tolerance", tolerance_of(self.tolerance))
        for name in ("occlusion", "normalize", "check"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be True or False, got {show(getattr(self, name))}")
        choice("method", self.method, get_args(Method))
        choice("depth_edges", self.depth_edges, get_args(DepthEdges))
        if self.occlusion and not self.normalize:
            raise ValueError("normalize=False is the plain sum of occlusion=False; set occlusion=False as well")
        number("max_coc_px", self.max_coc_px, 0.5, 1e300, "pixels")

    def arguments(self) -> dict[str, Any]:
        """These options as keyword arguments of :class:`torchdof.DepthOfField` or :func:`torchdof.blur_by_coc`."""
        return {name: getattr(self, name) for name in OPTION_NAMES}


OPTION_NAMES = tuple(field.name for field in dataclasses.fields(Options))  # torch.compile cannot trace fields()


class OptionArguments(TypedDict, total=False):
    """The options besides ``table`` for type checkers, which can only read them from a ``TypedDict``.

    A test compares the names with :class:`Options`.
    """

    tolerance: Tolerance
    occlusion: bool
    normalize: bool
    method: Method
    max_coc_px: float
    check: bool
    depth_edges: DepthEdges


def spells_options(function: _Decorated, **defaults: Any) -> _Decorated:
    """Decorator that shows, in the signature of a function with ``**options``, each option with its default.

    ``defaults`` are those that differ from :class:`Options`.
    """
    target: Any = function.__init__ if inspect.isclass(function) else function
    signature = inspect.signature(target)
    parameters = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    options = {field.name: field.default for field in dataclasses.fields(Options)} | defaults
    options_shown = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=options[name], annotation=kind)
        for name, kind in OptionArguments.__annotations__.items()
    ]
    target.__signature__ = signature.replace(parameters=[*parameters, *options_shown])
    return function


def to_config(camera: Camera, options: Options) -> dict[str, Any]:
    """Camera and options (with the table) as plain JSON types; a tensor ``[B]`` becomes a list, infinity ``"inf"``."""
    numbers = {name: _as_json(getattr(camera, name)) for name in Camera.__dataclass_fields__}
    return {"camera": numbers, **options.arguments(), "table": options.table.to_dict()}


def from_config(config: Any) -> tuple[Camera, Options]:
    """Camera and options from :func:`to_config`; missing fields are defaults, ``ValueError`` names a wrong field."""
    part = "the configuration of a DepthOfField"
    given = fields(part, config, ("camera",), OPTION_NAMES)
    numbers = fields("camera of the configuration", given.pop("camera"), (), Camera.__dataclass_fields__)
    try:
        part = "camera of the configuration"
        camera = Camera(**{name: _from_json(value, name == "focus_range_m") for name, value in numbers.items()})
        part = "table of the configuration"
        if given.get("table") is not None:
            given["table"] = BlurTable.from_dict(given["table"])
        part = "the configuration of a DepthOfField"
        return camera, Options(**given)
    except ValueError as error:
        raise ValueError(f"{part}: {error}") from error


def _as_json(value: Any) -> Any:
    """A number, a tensor ``[B]`` or a range of these as plain JSON types."""
    value = value.tolist() if isinstance(value, Tensor) else value
    if isinstance(value, list | tuple):
        return [_as_json(item) for item in value]
    return "inf" if isinstance(value, float) and value == math.inf else value  # JSON has no infinity


def _from_json(value: Any, is_range: bool) -> Any:
    """The inverse of :func:`_as_json`; a list becomes a tensor, or with ``is_range`` a tuple of two numbers."""
    if not isinstance(value, list | tuple):
        return math.inf if isinstance(value, str) and value == "inf" else value
    values = [_from_json(item, False) for item in value]
    if is_range:
        return tuple(values)
    try:
        wide = torch.tensor(values, dtype=torch.float64, device="cpu")
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return value  # the camera refuses it by its name
    return wide.float() if torch.equal(wide.float().double(), wide) else wide  # most often a tensor of float32
