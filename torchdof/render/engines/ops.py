"""Operations that an exported graph implements differently from eager code; the pipeline passes them as an object.

Eager code reads values of tensors and then chooses its work. A graph cannot: it needs explicit branches and loops. Each
operation takes the eager code as a function. :data:`EAGER` calls this function; the operations of a graph may compute
the same result in another way (``export/operations.py``).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ... import pixels
from ...tensors import is_traced
from ..layers.convolution import CHANNELS
from ..surfaces.frame import Highlights, PaddedFrame

_PART = 40_000  # pixels that are processed at once; larger: faster, with more memory


class Level(NamedTuple):
    """A level of a pyramid: the farthest surfaces at every ``step``-th pixel.

    ``values`` are light, coc and weight, ``[B, C + 2, H, W]``. A sample of weight w has ``min(slope w, most)`` votes
    against other levels. A pixel uses the level above a blur of ``least_px`` pixels, and fully from twice that blur.
    """

    values: Tensor
    step: int
    least_px: float
    slope: float
    most: float


Seen = tuple[Tensor, Tensor]
"""Light and coc behind a map, ``[B, C + 1, h, w]``, and the sum of the levels' votes, ``[B, 1, h, w]``."""


Step = Callable[[Sequence[Tensor], bool], tuple[Sequence[Tensor], Tensor]]
"""A step of :meth:`Ops.repeated`, which makes the next state from a state, and says whether another step is needed, a
bool ``[]``. A state is maps ``[B, 1, H, W]`` and numbers ``[B, 1, 1, 1]``. False means that no step may follow."""


class Ops:
    """The operations of eager code."""

    lens_width: int | None = None
    """Width in pixels of the image for which a blur table with lengths makes kernels; None means the image at hand."""

    kernels: Sequence[Tensor] | None = None
    """Kernels of all layers, made in advance; None means they are made for the frame at hand."""

    channels: int = CHANNELS
    """Channels of one convolution, which blurs several layers; larger: fewer operations, and more memory."""

    has_rays: bool = True
    """Whether highlights are splatted ray by ray, and their light is given to the surfaces of their emitters."""

    def select(self, mask: Tensor) -> pixels.Selected:
        """Selects the pixels of a mask, to compute only these."""
        return pixels.Selected(mask)

    def equal_unless(self, needed: Callable[[], Tensor], result: Tensor, given: Tensor) -> Tensor:
        """Returns ``result``, of which the caller promises that it equals ``given`` unless ``needed()``, a bool ``[]``.

        Eager code relies on the promise and asks nothing. A graph returns ``given`` where it can, and skips ``result``.
        """
        return result

    def repeated(self, step: Step, state: Sequence[Tensor], times: int) -> Sequence[Tensor]:
        """The state after some steps, at most ``times``."""
        for left in reversed(range(1 if is_traced() else times)):  # a trace cannot read values
            state, continues = step(state, left > 0)
            if not left or not continues:
                break
        return state

    def by_parts(self, look: Callable[[Tensor], Tensor], pixels: Tensor) -> Tensor:
        """Computes ``look(pixels)``, ``[n, P]``, for pixels ``[P]``, in parts of the list to bound the memory."""
        return look(pixels) if is_traced() else torch.cat([look(part) for part in pixels.split(_PART)], 1)

    def seen(
        self, look: Callable[[Sequence[Level], Tensor], Seen], levels: Sequence[Level], coc_px: Tensor, mask: Tensor
    ) -> Seen:
        """Computes ``look(levels, coc_px)``, light and coc behind each pixel, needed where ``mask`` is 1, not 0."""
        return look(levels, coc_px)

    def splat(
        self, splat: Callable[[], Tensor], rays: Highlights, coc_px: Tensor, obstacles: Sequence[tuple[Tensor, Tensor]]
    ) -> Tensor:
        """Splats highlights to ``[B, C, H, W]``; ``obstacles`` are coc and cover of the occluders."""
        return splat()

    def render(self, frame: PaddedFrame, render: Callable[[PaddedFrame], Tensor]) -> Tensor:
        """Renders a frame with the function ``render``."""
        return render(frame)


EAGER = Ops()
"""The operations of eager code, and the default everywhere."""
