"""The options of a rendering, spelled once: names, types, defaults, meaning, and what is wrong with them."""

import dataclasses
import inspect
import textwrap
from collections.abc import Mapping
from typing import Any, Literal, TypedDict, TypeVar

from typing_extensions import Unpack

from .optics.blur_table import BlurTable
from .optics.camera import Camera
from .validation import depth_edges as check_depth_edges
from .validation import show, tolerance_of

__all__ = [
    "OPTION_NAMES",
    "DepthEdges",
    "Method",
    "OptionArguments",
    "Options",
    "Tolerance",
    "read_state",
    "spells_options",
]

Method = Literal["layered", "fold"]
DepthEdges = Literal["auto", "repair", "as given"]
"""What is done to depth edges before rendering: repaired where the map proves inexact, or all of them, or nothing."""

Tolerance = float | Literal["draft", "preview", "final"]
"""RMS difference, display-encoded, from the same rendering with exact kernels, dense layers and full resolution."""

_DISC = BlurTable.disc()  # one for all: what was computed of a table is kept with it
_LATER_NUMBERS = {"focus_range_m": None, "tilt_deg": 0.0, "swing_deg": 0.0}  # of the camera; older states lack them
_Spelled = TypeVar("_Spelled")


@dataclasses.dataclass(frozen=True)
class Options:
    """How a picture is rendered.

    Args:
        table: Blur measured from a lens; None takes the ideal disc.
        tolerance: Accepted RMS difference, display-encoded, from the same rendering with exact kernels, dense layers
            and full resolution. 0 asks for that rendering itself, whose kernels are interpolated between layers half a
            pixel apart: where depth is noise, 1 to 2.5/255 RMS from a scatter of each pixel's own kernel. ``"draft"``
            is 8/255, ``"preview"`` 4/255 and ``"final"`` 1/255.
        occlusion: True composites layers far to near, so that blurred foregrounds cover what is behind and sharp ones
            are not bled upon. False is the paper's own algorithm: every pixel's light accumulates.
        normalize: With ``occlusion=False`` only: False leaves the plain sum that the paper accumulates.
        method: ``"layered"`` spreads layers by convolution (fast); ``"fold"`` by the paper's literal scatter.
        max_coc_px: Largest radius that a static plan (compiled, exported) covers; larger ones are rendered with it.
        check: Look for NaN and non-positive depths and non-finite light before rendering, and refuse them. False skips
            that (and its cost); a pixel with a bad depth then passes through sharp and touches nothing else.
        depth_edges: ``"auto"`` moves and sharpens the edges of the depth to where the image has them, unless they prove
            exact in this frame; ``"repair"`` asks each edge; ``"as given"`` takes the map as it is. See
            :func:`torchdof.depth.repair_edges`.

    Raises:
        ValueError: Naming the option that makes no sense.

    Example:
        >>> Options().tolerance == 1 / 255
        True
    """

    table: BlurTable = _DISC
    tolerance: float = 1 / 255
    occlusion: bool = True
    normalize: bool = True
    method: Method = "layered"
    max_coc_px: float = 64.0
    check: bool = True
    depth_edges: DepthEdges = "auto"

    def __post_init__(self) -> None:
        if not isinstance(self.table, BlurTable):
            got = type(self.table).__name__
            raise ValueError(f"table must be a torchdof.BlurTable, got {got}; read a file with BlurTable.load()")
        tolerance_of(self.tolerance)
        for name in ("occlusion", "normalize", "check"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be True or False, got {show(getattr(self, name))}")
        if not isinstance(self.method, str) or self.method not in ("layered", "fold"):
            raise ValueError(f"method must be 'layered' or 'fold', got {show(self.method)}")
        if self.occlusion and not self.normalize:
            raise ValueError("normalize=False is the plain sum of occlusion=False; set occlusion=False as well")
        reach = self.max_coc_px
        if isinstance(reach, bool) or not isinstance(reach, int | float) or not 0.5 < reach < 1e300:
            raise ValueError(f"max_coc_px must be a radius above 0.5 pixels, got {show(reach)}")
        check_depth_edges(self.depth_edges)

    @classmethod
    def of(cls, table: BlurTable | None = None, **arguments: Unpack["OptionArguments"]) -> "Options":
        """The options that a caller's arguments mean: no table is the disc, a tolerance's name its number.

        Raises:
            ValueError: Naming the option that makes no sense.
            TypeError: Naming an argument that is no option.

        Example:
            >>> Options.of(table=None, tolerance="preview") == Options(tolerance=4 / 255)
            True
        """
        values: dict[str, Any] = dict(arguments)
        for name in values:
            if name not in OPTION_NAMES:
                raise TypeError(f"there is no option {name!r}; options are {', '.join(OPTION_NAMES)}")
        if "tolerance" in values:
            values["tolerance"] = tolerance_of(values["tolerance"])
        return cls(_DISC if table is None else table, **values)

    def arguments(self) -> dict[str, Any]:
        """These options as keyword arguments of :class:`torchdof.DepthOfField` or :func:`torchdof.blur_by_coc`."""
        return {name: getattr(self, name) for name in OPTION_NAMES}


OPTION_NAMES = tuple(field.name for field in dataclasses.fields(Options))  # a compiler cannot ask for fields


class OptionArguments(TypedDict, total=False):
    """The same names for type checkers: what a caller may write beside the table; a tolerance may be a name too.

    They can read these off nothing but a class of this kind, so the names stand here once more, without their meaning
    and their defaults; a test holds the two together.
    """

    tolerance: Tolerance
    occlusion: bool
    normalize: bool
    method: Method
    max_coc_px: float
    check: bool
    depth_edges: DepthEdges


def spells_options(function: _Spelled) -> _Spelled:
    """Have ``help`` and editors show each option where a function or class takes ``**options``.

    The signature gets the names and defaults of :class:`Options`, the docstring's line ``**options`` their meaning.
    """
    called: Any = function.__init__ if inspect.isclass(function) else function
    signature = inspect.signature(called)
    own_parameters = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    own_names = {p.name for p in own_parameters}
    kinds = OptionArguments.__annotations__
    spelled = [
        inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, default=f.default, annotation=kinds[f.name])
        for f in dataclasses.fields(Options)
        if f.name in kinds
    ]
    called.__signature__ = signature.replace(parameters=[*own_parameters, *spelled])
    if function.__doc__ and Options.__doc__:
        meanings = inspect.cleandoc(Options.__doc__).partition("Args:\n")[2].partition("\n\n")[0]
        lines = [line for line in textwrap.dedent(meanings).splitlines() if line.partition(":")[0] not in own_names]
        shown = []
        for line in function.__doc__.splitlines():
            if line.lstrip().startswith("**options:"):
                indent = line[: len(line) - len(line.lstrip())]
                shown += [indent + meaning for meaning in lines]
            else:
                shown.append(line)
        function.__doc__ = "\n".join(shown)
    return function


def read_state(state: Any) -> tuple[Camera, Options]:
    """What a module's state describes.

    Returns:
        The camera, and the options with the table.

    Raises:
        ValueError: Naming the field that is missing, unknown or makes no sense.
    """
    names = ["camera", *(field.name for field in dataclasses.fields(Options))]
    if not isinstance(state, Mapping):
        raise ValueError(f"the state of a DepthOfField must be a dict, as state_dict() gives, got {show(state)}")
    _fields("the state of a DepthOfField", state, names)
    camera = state["camera"]
    if not isinstance(camera, Mapping):
        raise ValueError(f"camera of the state must be a dict, got {show(camera)}")
    camera = {**_LATER_NUMBERS, **camera}
    _fields("camera of the state", camera, list(Camera.__dataclass_fields__))
    try:
        restored_camera = Camera(**camera)
    except ValueError as error:
        raise ValueError(f"camera of the state: {error}") from error
    try:
        table = BlurTable.from_dict(state["table"])
    except ValueError as error:
        raise ValueError(f"table of the state: {error}") from error
    try:
        return restored_camera, Options(**{**{name: state[name] for name in names[1:]}, "table": table})
    except ValueError as error:
        raise ValueError(f"the state of a DepthOfField: {error}") from error


def _fields(what: str, fields: Mapping[str, Any], names: list[str]) -> None:
    missing, unknown = [n for n in names if n not in fields], [n for n in fields if n not in names]
    if missing or unknown:
        problem = f"{missing[0]!r} is missing" if missing else f"{show(unknown[0])} is not one of them"
        raise ValueError(f"{what} must have the fields {', '.join(names)}; {problem}")
