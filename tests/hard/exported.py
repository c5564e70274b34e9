"""The hard cases through onnxruntime: what a case renders, the exported file renders as well, held against float64.

The truth is the module with the layers of the file in eager PyTorch, in float64: an exported graph has the same layers
for every scene, so the closed forms of the other columns do not apply to it.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdof import DepthOfField
from torchdof.export.graph import Portable
from torchdof.export.verification import session


class Exported:
    """A file and the eager module of the same layers.

    Args:
        path: The file.
        dof: Its module.
    """

    def __init__(self, path: Path, dof: DepthOfField) -> None:
        self.camera = dof.camera
        self.session, self.portable = session(path), Portable(dof)

    def run(self, image: Tensor, depth: Tensor, focus_m: float, f_number: float) -> tuple[Tensor, Tensor]:
        """The picture of the file, and that of the module in float64: ``[B, 3, H, W]`` each."""
        image = image.float().expand(-1, 3, -1, -1)
        depth = depth.float().expand(image.shape[0], -1, -1, -1)
        tensors = {"image": image, "depth": depth}
        tensors |= {"focus_m": torch.full(image.shape[:1], focus_m), "f_number": torch.full(image.shape[:1], f_number)}
        feed = {name: np.ascontiguousarray(tensor.detach().numpy()) for name, tensor in tensors.items()}
        got = torch.from_numpy(self.session.run(None, feed)[0])
        with torch.no_grad():
            truth = self.portable(*(tensor.double() for tensor in tensors.values()))
        return got, truth

    def run_coc(self, image: Tensor, coc_px: Tensor) -> tuple[Tensor, Tensor]:
        """The same from a map of the coc, through the depth that has it: the file takes depth."""
        reach = 1.05 * float(coc_px.max().clamp_min(1.0))  # of infinity
        wide = self.camera.replace(f_number=1.0)
        f_number = float(wide.coc_px(torch.full((1, 1, 1, 1), torch.inf), image.shape[-1])) / reach
        depth = float(self.camera.focus_m) / (1.0 - coc_px.double() / reach)
        return self.run(image, depth, float(self.camera.focus_m), f_number)


def worst_error(exported: Exported, cases: ModuleType, case: Any) -> float:
    """Largest relative error of a pixel in all that a case renders, through onnxruntime."""
    with _through(exported, cases) as errors:
        case.measure(torch.float32)
    return max(errors)


@contextlib.contextmanager
def _through(exported: Exported, cases: ModuleType) -> Iterator[list[float]]:
    """While it lasts, the cases' renderings are repeated by the file; yields the list of their errors."""
    errors: list[float] = []
    blur_by_coc, module = cases.blur_by_coc, cases.DepthOfField

    def compare(image: Tensor, got: Tensor, truth: Tensor) -> None:
        # of each pixel; next to light that cancels (negative values) of the brightest
        scale = truth.abs() if float(image.min()) >= 0 else truth.abs().max()
        apart = (got.double() - truth).abs() / scale.clamp_min(torch.finfo(torch.float32).tiny)
        errors.append(float(torch.nan_to_num(torch.where(got == truth, 0.0, apart), nan=torch.inf).max()))

    def by_coc(image: Tensor, coc_px: Tensor, **options: Any) -> Tensor:
        if image.dtype == torch.float32:
            compare(image, *exported.run_coc(image, coc_px))
        return blur_by_coc(image, coc_px, **options)

    class ByDepth(DepthOfField):
        def forward(self, image: Tensor, depth: Tensor, *others: Any, **more: Any) -> Tensor:
            if image.dtype == torch.float32:
                lens = float(self.camera.focus_m), float(self.camera.f_number)
                compare(image, *exported.run(image, depth, *lens))
            return super().forward(image, depth, *others, **more)

    cases.blur_by_coc, cases.DepthOfField = by_coc, ByDepth  # type: ignore[attr-defined]
    try:
        yield errors
    finally:
        cases.blur_by_coc, cases.DepthOfField = blur_by_coc, module  # type: ignore[attr-defined]
