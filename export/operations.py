"""The operations of an exported graph, in place of those of eager code (:mod:`torchdof.render.ops`)."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchdof.optics.blur_table import BlurTable
from torchdof.render.ops import Level, Ops, Seen
from torchdof.render.plan import Plan
from torchdof.render.surfaces import Highlights, PaddedFrame

from .lists import by_parts
from .operators import choose
from .rays import kernels_of, splat
from .tiling import seen, side, tile_by_tile

__all__ = ["GraphOps"]


class GraphOps(Ops):
    """Operations that use a branch for work that only some frames need, and a loop for work on parts of a frame.

    The kernels of layers and highlights are made before tracing and become constants of the graph.

    Args:
        plan: The layers of the graph.
        table: Table of the kernels.
        layered: Whether layers are blurred at coarser resolutions where that is accurate enough.
        lens_width: Image width in pixels for the kernels of a table with lengths.
    """

    def __init__(self, plan: Plan, table: BlurTable, layered: bool, lens_width: int | None) -> None:
        self.lens_width = lens_width
        self.kernels = plan.constants(table, layered, lens_width or 1)
        self.rays = kernels_of(table, plan, lens_width or 1)

    def choose(self, needed: Callable[[], Tensor], result: Tensor, given: Tensor) -> Tensor:
        """A branch."""
        return choose(needed(), result, given)

    def by_parts(self, look: Callable[[Tensor], Tensor], pixels: Tensor) -> Tensor:
        """A loop over parts of the list."""
        return by_parts(look, pixels)

    def seen(
        self, look: Callable[[Sequence[Level], Tensor], Seen], levels: Sequence[Level], coc_px: Tensor, mask: Tensor
    ) -> Seen:
        """Tile by tile."""
        return seen(levels, coc_px, mask, self)

    def splat(
        self,
        splat_all: Callable[[], Tensor],
        rays: Highlights,
        coc_px: Tensor,
        obstacles: Sequence[tuple[Tensor, Tensor]],
    ) -> Tensor:
        """A loop over parts of the highlights, if there are any."""
        splats = splat(rays, coc_px, obstacles, self.rays)
        # broadcasts over the frame without taking its memory
        nothing = rays.coc_px.new_zeros(coc_px.shape[0], len(rays.light), 1, 1)
        return self.choose(lambda: torch.ones_like(rays.pixels).sum() > 0, splats, nothing)

    def align(self, margin: int, coarsest: int) -> int:
        """Whole tiles."""
        return side(margin)

    def render(self, frame: PaddedFrame, render: Callable[[PaddedFrame], Tensor]) -> Tensor:
        """A loop over tiles."""
        return tile_by_tile(frame, render, self)
