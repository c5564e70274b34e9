"""The frame tile by tile, in a loop: how an exported graph does only the work that a scene needs.

A graph cannot choose its work before it runs. In a loop over tiles each step sees a small window, and the branches
inside skip every layer that the window does not hold.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof.render.pipeline import Tiling, tiling
from torchdof.render.plan import Blur
from torchdof.render.surfaces import Frame, Placed

__all__ = ["in_tiles", "side", "tile_by_tile"]

_SIDE = 128


def side(margin: int) -> int:
    """Pixels of a tile along each axis, given those that the widest kernel reaches beyond it."""
    return _SIDE if margin <= _SIDE // 2 else 2 * _SIDE


def tile_by_tile(frame: Frame, blurs: Sequence[Blur], render: Callable[[Frame, Sequence[Blur]], Tensor]) -> Tensor:
    """Render each tile of a frame as a frame of its own.

    Args:
        frame: Surfaces and their border; its area is a multiple of :func:`side`.
        blurs: Kernel and resolution of each layer.
        render: Renders one tile with them: ``[1, C, side, side]``.

    Returns:
        ``[B, C, H, W]``.
    """
    from torch._higher_order_ops.scan import scan  # the graph's loop

    length, margin = side(frame.margin), frame.margin
    window = length + 2 * margin
    rows, columns = (n // length for n in frame.area)
    parts = [t for s in frame.surfaces for t in s if t is not None]
    batch, colours = parts[0].shape[0], int(parts[0].shape[1])
    if frame.behind is not None:
        parts.append(functional.pad(frame.behind, (margin,) * 4))
    channels = [int(t.shape[1]) for t in parts]
    weighted, backed = frame.surfaces[0].weight is not None, frame.behind is not None
    across = torch.arange(window)
    tiles = torch.cat(parts, 1)
    tiles = tiles[:, :, (torch.arange(rows) * length)[:, None] + across]  # [B, P, rows, window, W]
    tiles = tiles[..., (torch.arange(columns) * length)[:, None] + across]  # [B, P, rows, window, columns, window]
    tiles = tiles.permute(0, 2, 4, 1, 3, 5).reshape(-1, sum(channels), window, window)

    # a loop takes no two views of one tensor, and inside it sizes are unknown until they are stated
    bank = [(blur.kernel.clone(), tuple(blur.kernel.shape), blur.scale) for blur in blurs]

    def step(count: Tensor, tile: Tensor) -> tuple[Tensor, Tensor]:
        fields = [t.clone() for t in tile.reshape(1, sum(channels), window, window).split(channels, 1)]
        inner = slice(margin, margin + length)
        behind = fields.pop()[..., inner, inner] if backed else None
        each = 3 if weighted else 2
        surfaces = [Placed(*fields[i : i + each]) for i in range(0, len(fields), each)]
        whole = (length, length)
        piece = Frame(surfaces, frame.nodes, behind, margin, whole, whole, frame.occlusion)
        tile = render(piece, [Blur(kernel.reshape(shape), scale) for kernel, shape, scale in bank])
        return count + 1, tile.reshape(colours, length, length)

    _, pieces = scan(step, torch.zeros(1), tiles)
    image = pieces.reshape(batch, rows, columns, colours, length, length).permute(0, 3, 1, 4, 2, 5)
    return image.reshape(batch, colours, *frame.area)[..., : frame.size[0], : frame.size[1]]


@contextlib.contextmanager
def in_tiles() -> Iterator[None]:
    """Within this context graphs that are exported render their frames tile by tile."""
    token = tiling.set(Tiling(side, tile_by_tile))
    try:
        yield
    finally:
        tiling.reset(token)
