"""``torchdof export``: a module to a verified ONNX file, and what such a file says about itself."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

from torchdof import Camera, DepthOfField
from torchdof.cli.arguments import (
    BLUR,
    LENS,
    ApertureImage,
    AsJson,
    Blades,
    Curvature,
    DepthEdgesName,
    FovDeg,
    MethodName,
    NoOcclusion,
    Rotation,
    Squeeze,
    TableName,
    ToleranceText,
)
from torchdof.cli.printed import json_line
from torchdof.cli.settings import depth_edges_of, load_aperture, load_table
from torchdof.export.conversion import OPSET, to_onnx
from torchdof.export.metadata import describe, shown
from torchdof.options import tolerance_of_text

__all__ = ["export"]

_GRAPH = "Graph"


def export(
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The file to write.")] = None,
    show: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write nothing; print what this file says about itself.")
    ] = None,
    focal_length_mm: Annotated[float, typer.Option(help="Real focal length.", rich_help_panel=LENS)] = 50.0,
    sensor_width_mm: Annotated[float, typer.Option(help="36 for full frame.", rich_help_panel=LENS)] = 36.0,
    fov_deg: FovDeg = None,
    table: TableName = "disc",
    blades: Blades = 0,
    rotation: Rotation = 0.0,
    curvature: Curvature = 0.0,
    squeeze: Squeeze = 1.0,
    aperture: ApertureImage = None,
    max_coc: Annotated[
        float, typer.Option(help="Largest radius in pixels that the file holds.", rich_help_panel=BLUR)
    ] = 32.0,
    tolerance: ToleranceText = "final",
    no_occlusion: NoOcclusion = False,
    method: MethodName = "layered",
    depth_edges: DepthEdgesName = "as-given",
    inputs: Annotated[
        Literal["depth", "coc_px"],
        typer.Option(
            help="The map the graph takes: depth in metres, with focus and f-number as inputs; or the signed blur "
            "radius in pixels.",
            rich_help_panel=_GRAPH,
        ),
    ] = "depth",
    channels: Annotated[int, typer.Option(help="Channels of the image.", rich_help_panel=_GRAPH)] = 3,
    width: Annotated[
        int | None,
        typer.Option(
            help="Image width whose kernels the file holds, for a table in millimetres or fractions of the width.",
            rich_help_panel=_GRAPH,
        ),
    ] = None,
    opset: Annotated[int, typer.Option(help="ONNX operator set.", rich_help_panel=_GRAPH)] = OPSET,
    as_json: AsJson = False,
) -> None:
    """Write depth of field as one ONNX file, for pipelines without PyTorch.

    The file is compared with the module in onnxruntime before it is written; the comparison is printed.

        torchdof export -o dof.onnx --table sato_j15 --max-coc 16

    A table in millimetres is tied to an image width:

        torchdof export -o dof.onnx --table double_gauss_50mm_f2 --width 1920 --max-coc 24 --tolerance 0.008

    What a file is:

        torchdof export --show dof.onnx
    """
    if (out is None) == (show is None):
        raise ValueError("give either -o FILE to write or --show FILE to read")
    if show is not None:
        facts = describe(show)
        print(json_line(facts) if as_json else "\n".join(_lines(facts)))
        return
    if out is None:
        return
    if out.suffix != ".onnx":
        raise ValueError(f"the file is ONNX: name it {out.with_suffix('.onnx')}")
    if fov_deg is None:
        camera = Camera(focal_length_mm=focal_length_mm, sensor_width_mm=sensor_width_mm)
    else:
        camera = Camera.from_fov(fov_deg, 0.01, 2.0)  # aperture and focus are inputs of the graph
    dof = DepthOfField(
        camera,
        load_table(table, load_aperture(blades, rotation, curvature, squeeze, aperture)),
        tolerance=tolerance_of_text(tolerance),
        occlusion=not no_occlusion,
        method=method,
        max_coc_px=max_coc,
        check=False,
    )
    with Console(stderr=True).status("tracing") as status:
        report = to_onnx(
            dof,
            out,
            inputs=inputs,
            channels=channels,
            width=width,
            depth_edges=depth_edges_of(depth_edges),
            opset=opset,
            progress=status.update,
        )
    print(json_line({"out": str(out), **dataclasses.asdict(report)}) if as_json else f"{report}\nwrote {out}")


def _lines(facts: Mapping[str, Any]) -> Sequence[str]:
    """A file's metadata, a line each."""
    lines = []
    for name, value in facts.items():
        if isinstance(value, dict):
            lines.append(f"{shown(name)}:")
            lines += [f"  {shown(k)}: {_told(v)}" for k, v in value.items()]
        else:
            lines.append(f"{shown(name)}: {_told(value)}")
    return lines


def _told(value: Any) -> str:
    return shown(value if isinstance(value, str) else json.dumps(value))
