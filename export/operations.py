"""The operations of exported graphs, in place of those of eager code (:mod:`torchdof.render.ops`)."""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof.optics.blur_table import BlurTable
from torchdof.pixels import Selected
from torchdof.render.ops import Level, Ops, Seen
from torchdof.render.plan import Plan
from torchdof.render.surfaces import Highlights, PaddedFrame

from .rays import kernels_of, splat
from .structure import choose
from .tiling import by_parts, seen, side, tile_by_tile

__all__ = ["GraphOps", "WholeOps"]


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


class WholeOps(Ops):
    """Operations of a graph without control flow (``layout="whole"``), which renders all layers of the whole frame.

    Runtimes on GPUs and in browsers compute loops, branches and lists of pixels on the CPU, or not at all. This graph
    has none: it computes every pixel, also where a tiled graph skips work, and it has no rays of highlights.
    """

    channels = 32
    has_rays = False

    def select(self, mask: Tensor) -> Selected:
        """All pixels; only those of the mask are changed."""
        return _Everywhere(mask)


class _Everywhere(Selected):
    """All pixels of a map, P = B H W, as lists of values; :meth:`put` changes only those of the mask."""

    def __init__(self, mask: Tensor) -> None:
        self._mask = mask

    def pick(self, values: Tensor) -> Tensor:
        return values.transpose(0, 1).flatten(1)

    def around(self, values: Tensor) -> Tensor:
        padded = functional.pad(values, (1, 1, 1, 1), mode="replicate").transpose(0, 1).unsqueeze(1)
        kept = [slice(first, first - 2 or None) for first in range(3)]
        return torch.cat([padded[..., rows, columns] for rows in kept for columns in kept], 1).flatten(2)

    def of_item(self, values: Tensor) -> Tensor:
        height, width = self._mask.shape[-2:]
        return values.t()[..., None].expand(-1, -1, height * width).flatten(1)

    def put(self, values: Tensor, new: Tensor) -> Tensor:
        batch, channels, height, width = values.shape
        maps = new.reshape(channels, batch, height, width).transpose(0, 1)
        return torch.where(self._mask, maps, values)
