"""``torchdof export``: a module to a verified ONNX file, and what such a file says about itself."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import typer
from rich.console import Console

from torchdof import Camera, DepthOfField
from torchdof.cli.settings import load_table
from torchdof.export.conversion import OPSET, to_onnx
from torchdof.export.metadata import describe, shown
from torchdof.options import tolerance_of_text

__all__ = ["export"]

_LENS, _BLUR, _GRAPH = "Lens", "Blur", "Graph"


def export(
    output: Annotated[Path | None, typer.Option("-o", "--output", help="The file to write.")] = None,
    show: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write nothing; print what this file says about itself.")
    ] = None,
    focal_length_mm: Annotated[float, typer.Option(help="Real focal length.", rich_help_panel=_LENS)] = 50.0,
    sensor_width_mm: Annotated[float, typer.Option(help="36 for full frame.", rich_help_panel=_LENS)] = 36.0,
    fov_deg: Annotated[
        float | None,
        typer.Option(help="Horizontal field of view of a rendered image, instead of a lens.", rich_help_panel=_LENS),
    ] = None,
    table: Annotated[
        str,
        typer.Option(help="disc, gaussian, a shipped table such as sato_j15, or a JSON file.", rich_help_panel=_BLUR),
    ] = "disc",
    max_coc: Annotated[
        float, typer.Option(help="Largest radius in pixels that the file holds.", rich_help_panel=_BLUR)
    ] = 32.0,
    tolerance: Annotated[
        str,
        typer.Option(
            help="Accepted RMS error on display, of 1: draft (8/255), preview (4/255), final (1/255) or a number; 0 is "
            "exact.",
            rich_help_panel=_BLUR,
        ),
    ] = "final",
    no_occlusion: Annotated[
        bool, typer.Option("--no-occlusion", help="One pass that ignores what hides what.", rich_help_panel=_BLUR)
    ] = False,
    method: Annotated[
        Literal["layered", "fold"],
        typer.Option(help="fold is the literal scatter: exact, slow, for small radii.", rich_help_panel=_BLUR),
    ] = "layered",
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
) -> None:
    """Write depth of field as one ONNX file, for pipelines without PyTorch.

    The file is compared with the module in onnxruntime before it is written; the comparison is printed.

        torchdof export -o dof.onnx --table sato_j15 --max-coc 16

    A table in millimetres is tied to an image width:

        torchdof export -o dof.onnx --table double_gauss_50mm_f2 --width 1920 --max-coc 24 --tolerance 0.008

    What a file is:

        torchdof export --show dof.onnx
    """
    if (output is None) == (show is None):
        raise ValueError("give either -o FILE to write or --show FILE to read")
    if show is not None:
        for line in _lines(show):
            print(line)
        return
    if output is None:
        return
    if output.suffix != ".onnx":
        raise ValueError(f"the file is ONNX: name it {output.with_suffix('.onnx')}")
    if fov_deg is None:
        camera = Camera(focal_length_mm=focal_length_mm, sensor_width_mm=sensor_width_mm)
    else:
        camera = Camera.from_fov(fov_deg, 0.01, 2.0)  # aperture and focus are inputs of the graph
    dof = DepthOfField(
        camera,
        load_table(table),
        tolerance=tolerance_of_text(tolerance),
        occlusion=not no_occlusion,
        method=method,
        max_coc_px=max_coc,
        check=False,
    )
    with Console(stderr=True).status(f"tracing and verifying with {torch.get_num_threads()} threads"):
        report = to_onnx(dof, output, inputs=inputs, channels=channels, width=width, opset=opset)
    print(report)
    print(f"wrote {output}")


def _lines(path: Path) -> Sequence[str]:
    """A file's metadata, a line each."""
    lines = []
    for name, value in describe(path).items():
        if isinstance(value, dict):
            lines.append(f"{shown(name)}:")
            lines += [f"  {shown(k)}: {_told(v)}" for k, v in value.items()]
        else:
            lines.append(f"{shown(name)}: {_told(value)}")
    return lines


def _told(value: Any) -> str:
    return shown(value if isinstance(value, str) else json.dumps(value))
