"""Options that several commands take alike: the lens, the numbers of a depth map, the blur, and what is printed."""

from pathlib import Path
from typing import Annotated, Literal

import typer

__all__ = [
    "BLUR",
    "DEPTH",
    "LENS",
    "ApertureImage",
    "ApertureRadiusM",
    "AsJson",
    "Blades",
    "Curvature",
    "DepthChannel",
    "DepthEdgesName",
    "DepthOffset",
    "DepthScale",
    "DepthUnknown",
    "FNumber",
    "FarM",
    "FillDepth",
    "FocalLengthMm",
    "FocusAt",
    "FocusMOrMedian",
    "FocusRange",
    "FovDeg",
    "MethodName",
    "NearM",
    "NoOcclusion",
    "RelativeKind",
    "Rotation",
    "SensorWidthMm",
    "Squeeze",
    "Swing",
    "TableName",
    "Tilt",
    "ToleranceText",
    "ValueRange",
    "Vignetting",
]

LENS, DEPTH, BLUR = "Focus and lens", "Depth map", "Blur"
"""Panels of the help that these options stand in."""

FocusMOrMedian = Annotated[
    float | None, typer.Option(help="Distance in focus in metres; default: the median.", rich_help_panel=LENS)
]
FocusAt = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y",
        help="Focus on what is seen at this pixel, counted from the top left; in a sequence, anew in each frame.",
        rich_help_panel=LENS,
    ),
]
FocusRange = Annotated[
    str | None,
    typer.Option(
        metavar="NEAR,FAR",
        help="In focus from NEAR to FAR metres, blurred beyond; instead of --focus-m.",
        rich_help_panel=LENS,
    ),
]
Tilt = Annotated[
    float,
    typer.Option(
        help="Degrees by which the lens is tilted down: focus comes nearer towards the bottom.", rich_help_panel=LENS
    ),
]
Swing = Annotated[
    float, typer.Option(help="Degrees to the right: focus comes nearer towards the right.", rich_help_panel=LENS)
]
FNumber = Annotated[float | None, typer.Option(help="Smaller is blurrier.", rich_help_panel=LENS)]
FocalLengthMm = Annotated[
    float | None, typer.Option(help="Real focal length, not the 35 mm equivalent.", rich_help_panel=LENS)
]
SensorWidthMm = Annotated[float | None, typer.Option(help="36 for full frame.", rich_help_panel=LENS)]
FovDeg = Annotated[
    float | None,
    typer.Option(help="Horizontal field of view of a rendered image, instead of a lens.", rich_help_panel=LENS),
]
ApertureRadiusM = Annotated[
    float | None, typer.Option(help="Radius of the opening, with --fov-deg.", rich_help_panel=LENS)
]

Blades = Annotated[int, typer.Option(help="Aperture blades, from 3; 0 is a round lens.", rich_help_panel=BLUR)]
Rotation = Annotated[
    float,
    typer.Option(help="Degrees by which blades or image are turned, counter-clockwise.", rich_help_panel=BLUR),
]
Curvature = Annotated[float, typer.Option(help="Of the blades: 0 straight, 1 a circle.", rich_help_panel=BLUR)]
Squeeze = Annotated[
    float, typer.Option(help="Height of the blur over its width; 2 for an anamorphic lens.", rich_help_panel=BLUR)
]
Vignetting = Annotated[
    float, typer.Option(help="Cat's eyes towards the corners: 0 none, 1 closed.", rich_help_panel=BLUR)
]
ApertureImage = Annotated[
    Path | None,
    typer.Option(metavar="IMAGE", help="Picture of the opening, bright where light passes.", rich_help_panel=BLUR),
]

DepthScale = Annotated[float | None, typer.Option(help="0.001 for maps in millimetres.", rich_help_panel=DEPTH)]
DepthOffset = Annotated[float, typer.Option(help="Added to each value first.", rich_help_panel=DEPTH)]
NearM = Annotated[
    float | None, typer.Option(help="Distance of the nearest value of relative depth.", rich_help_panel=DEPTH)
]
FarM = Annotated[
    float | None, typer.Option(help="Distance of its farthest value (inf allowed).", rich_help_panel=DEPTH)
]
RelativeKind = Annotated[
    Literal["disparity", "inverse", "depth"] | None,
    typer.Option(
        help="What relative depth is: disparity or inverse depth, larger is nearer (MiDaS, Depth Anything; the "
        "default), or depth, larger is farther (Marigold).",
        rich_help_panel=DEPTH,
    ),
]
ValueRange = Annotated[
    str | None,
    typer.Option(
        metavar="LOW,HIGH",
        help="Smallest and largest value of relative depth; default: those of each frame.",
        rich_help_panel=DEPTH,
    ),
]
DepthUnknown = Annotated[
    float | None,
    typer.Option(help="A value that means 'not measured', such as 0, -1 or inf.", rich_help_panel=DEPTH),
]
DepthEdgesName = Annotated[
    Literal["auto", "repair", "as-given"],
    typer.Option(
        help="Move and sharpen the edges of the depth to where the image has them: unless they prove exact, each one, "
        "or not at all.",
        rich_help_panel=DEPTH,
    ),
]
DepthChannel = Annotated[
    str | None, typer.Option(help="Channel (or array of an .npz) that is depth.", rich_help_panel=DEPTH)
]
FillDepth = Annotated[
    str | None,
    typer.Option(
        metavar="nearest|far|METRES",
        help="Fill pixels without depth: from the nearest one, from the farthest around (what stereo cannot see "
        "lies behind), or with a distance (inf for a sky).",
        rich_help_panel=DEPTH,
    ),
]

TableName = Annotated[
    str, typer.Option(help="disc, gaussian, a shipped table such as sato_j15, or a JSON file.", rich_help_panel=BLUR)
]
ToleranceText = Annotated[
    str,
    typer.Option(
        help="Accepted RMS error on display, of 1: draft (8/255), preview (4/255), final (1/255) or a number; 0 is "
        "exact.",
        rich_help_panel=BLUR,
    ),
]
NoOcclusion = Annotated[
    bool, typer.Option("--no-occlusion", help="One pass that ignores what hides what.", rich_help_panel=BLUR)
]
MethodName = Annotated[
    Literal["layered", "fold"],
    typer.Option(help="fold is the literal scatter: exact, slow, for small radii.", rich_help_panel=BLUR),
]

AsJson = Annotated[bool, typer.Option("--json", help="Print what is printed as JSON, for programs: one object a line.")]
