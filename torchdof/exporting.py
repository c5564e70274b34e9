"""What whoever exports a graph puts in: a graph cannot look at numbers and then choose its work, as eager code does."""

from collections.abc import Callable, Sequence
from contextvars import ContextVar
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:  # these look at what is exported themselves
    from .render.disocclusion import Seen
    from .render.highlights import Highlights
    from .render.plan import Blur
    from .render.surfaces import Frame

__all__ = ["Graph", "exported_graph", "graph_context", "where_needed"]


class Graph(NamedTuple):
    """How an exported graph goes over a frame.

    Args:
        align: What the frame must be a multiple of, given the pixels that the widest kernel reaches.
        render: The picture of a frame, from it, its kernels and what renders one piece of it.
        seen: What levels of a pyramid show behind the pixels of a frame, or behind its cells; as
            :mod:`torchdof.render.disocclusion` looks for it.
        splat: Highlights to ``[B, C, H, W]``, from all of them, the frame's coc and what may stand in the way of their
            rays; as :mod:`torchdof.render.highlights` splats them.
        choose: ``(needed, result, given)`` to the result where it is needed, else what is given. What only the result
            needs is computed only then.
        by_parts: What a function finds at a list of pixels, as :func:`torchdof.pixels.by_parts` finds it.
    """

    align: Callable[[int], int]
    render: "Callable[[Frame, Sequence[Blur], Callable[[Frame, Sequence[Blur]], Tensor]], Tensor]"
    seen: "Seen"
    splat: "Callable[[Highlights, Tensor, Sequence[tuple[Tensor, Tensor]]], Tensor]"
    choose: Callable[[Tensor, Tensor, Tensor], Tensor]
    by_parts: Callable[[Callable[[Tensor], Tensor], Tensor], Tensor]


graph_context: ContextVar[Graph | None] = ContextVar("graph_context", default=None)
"""Set by whoever exports a graph."""


def exported_graph() -> Graph | None:
    """The graph that this code is being traced for; None: it is run, or compiled."""
    return graph_context.get() if torch.compiler.is_exporting() else None


def where_needed(needed: Callable[[], Tensor], result: Tensor, given: Tensor) -> Tensor:
    """A result that a graph computes only if it is needed, a bool ``[]``; what is given is the same where it is not."""
    graph = exported_graph()
    return result if graph is None else graph.choose(needed(), result, given)
