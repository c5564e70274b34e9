"""Operations that an exported graph does otherwise than eager code: an object that is passed down the pipeline.

Eager code looks at numbers and then chooses its work. A graph cannot: it holds branches and loops instead. Each
operation is given what eager code does as a function; :data:`EAGER` calls it, a graph may do something else to the same
result (``export/operations.py``).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..tensors import is_traced
from .surfaces import Frame, Highlights

__all__ = ["EAGER", "Level", "Ops", "Seen"]

_PART = 40_000  # pixels that are looked at together


class Level(NamedTuple):
    """Farthest surfaces at every ``step``-th pixel: light, coc and weight ``[B, C + 2, H, W]``.

    ``vote`` is the level's weight against other levels; None means that ``values`` hold it in their weights. A pixel
    uses the level where its blur exceeds ``least_px`` pixels, and fully above twice that blur.
    """

    values: Tensor
    step: int
    vote: float | None
    least_px: float


Seen = tuple[Tensor, Tensor]
"""What levels show behind a map: light and coc ``[B, C + 1, h, w]``, and the sum of their votes ``[B, 1, h, w]``."""


class Ops:
    """The operations of eager code."""

    lens_width: int | None = None
    """Width in pixels of the image whose kernels are used, for a table with lengths; None: the image's own."""

    kernels: Sequence[Tensor] | None = None
    """Kernels of all layers, made before; None: they are made for the frame at hand."""

    def choose(self, needed: Callable[[], Tensor], result: Tensor, given: Tensor) -> Tensor:
        """``result`` where ``needed()``, a bool ``[]``, is true; else ``given``, which then equals it.

        A graph computes what only the result needs only then.
        """
        return result

    def by_parts(self, look: Callable[[Tensor], Tensor], pixels: Tensor) -> Tensor:
        """``look(pixels)``, ``[n, P]``, of pixels ``[P]``: by parts of the list, to bound the memory."""
        return look(pixels) if is_traced() else torch.cat([look(part) for part in pixels.split(_PART)], 1)

    def seen(
        self, look: Callable[[Sequence[Level], Tensor], Seen], levels: Sequence[Level], coc_px: Tensor, mask: Tensor
    ) -> Seen:
        """``look(levels, coc_px)``: what levels of a pyramid show behind each pixel. A mask of 0 and 1 says where."""
        return look(levels, coc_px)

    def splat(
        self, splat: Callable[[], Tensor], rays: Highlights, coc_px: Tensor, obstacles: Sequence[tuple[Tensor, Tensor]]
    ) -> Tensor:
        """Highlights to ``[B, C, H, W]``, given the frame's coc and what may stand in their way: coc and cover."""
        return splat()

    def align(self, margin: int, coarsest: int) -> int:
        """What a frame's sides must be multiples of, given the pixels around it and those of the coarsest layer's."""
        return coarsest

    def render(self, frame: Frame, render: Callable[[Frame], Tensor]) -> Tensor:
        """The picture of a frame, given what renders a frame."""
        return render(frame)


EAGER = Ops()
"""Those of all code but an exported graph's."""
