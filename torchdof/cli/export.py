"""``torchdof export``: writes a verified ONNX file, or prints the metadata of one."""

import dataclasses
import json
from pathlib import Path
from typing import Literal

from ..io.atomic import check_writable
from .command import Command, Group, Parsed, option
from .lens import Sensor
from .options import Accuracy, Blur
from .output import print_result, progress_bar


def _size(text: str) -> tuple[int, int]:
    """Reads ``WIDTHxHEIGHT`` as height and width."""
    width, height = map(int, text.lower().split("x"))
    return height, width


class _Graph(Group):
    """Graph."""

    inputs: Literal["depth", "coc_px", "depth+matte", "coc_px+matte"] = option(
        "Depth in metres, with focus and f-number as further inputs; or the signed blur radius in pixels. With +matte "
        "there is an input for the coverage by a subject.",
        "depth",
    )
    channels: int = option("Channels of the image.", 3)
    width: int | None = option("Image width whose kernels the file holds, for a table in millimetres or fractions.")
    layout: Literal["tiles", "whole"] = option(
        "tiles skip work, for CPUs; whole is a straight graph without rays of highlights, for GPUs and browsers.",
        "tiles",
    )
    size: tuple[int, int] | None = option(
        "Width and height of the only frame, for --layout whole and runtimes that need fixed sizes.",
        type=Parsed("WxH", _size, "1920x1080"),
    )
    opset: int = option("ONNX operator set.", 20)


class Export(Sensor, Blur, Accuracy, _Graph, Command):
    """Write depth of field as one ONNX file, for pipelines without PyTorch.

    The file is compared with the module in onnxruntime before it is written; the comparison is printed.

        torchdof export -o dof.onnx --table sato_j15 --max-coc 16

    A table in millimetres is tied to an image width:

        torchdof export -o dof.onnx --table double_gauss_50mm_f2 --width 1920 --max-coc 24 --tolerance 0.008

    For a GPU, with frames of one size:

        torchdof export -o dof.onnx --layout whole --size 1920x1080 --max-coc 16
    """

    out: Path | None = option("The file to write.", names=("--out", "-o"))
    show: Path | None = option("Write nothing; print the metadata of this file.", metavar="FILE")
    max_coc: float = option("Largest radius in pixels that the file holds.", 32.0, basic=True)

    def run(self) -> None:
        """Writes a file, or prints the metadata of one."""
        if self.show is not None and self.out is None:
            from torchdof.export.metadata import describe, shown

            metadata = describe(self.show)
            lines = map(shown, json.dumps(metadata, indent=1).splitlines())
            return print_result(self.as_json, metadata, "\n".join(lines))
        if self.out is None or self.show is not None:
            raise ValueError("give either -o FILE to write or --show FILE to read")
        if self.out.suffix != ".onnx":
            raise ValueError(f"the file is ONNX: name it {self.out.with_suffix('.onnx')}")
        check_writable(self.out)
        from torchdof import Camera, DepthOfField
        from torchdof.export.conversion import to_onnx

        if self.fov_deg is None:
            camera = Camera(**{name: getattr(self, name) for name in self.given(Sensor)})
        else:
            camera = Camera.from_fov(self.fov_deg, 0.01, 2.0)  # aperture and focus are inputs of the graph
        options = {**self.arguments(), "max_coc_px": self.max_coc, "check": False}
        with progress_bar("tracing") as update:
            dof = DepthOfField(camera, self.blur_table(), **options)
            graph = {field.name: getattr(self, field.name) for field in dataclasses.fields(_Graph)}
            report = to_onnx(dof, self.out, **graph, depth_edges=options.get("depth_edges"), progress=update)
        facts = {"out": str(self.out), **dataclasses.asdict(report)}
        print_result(self.as_json, facts, f"{report}\nwrote {self.out}")
