"""Steps of a differentiated rendering that the compiled engine computes, forward and backward."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from .. import native
from ..tensors import is_in_memory, is_traced
from .surfaces import PaddedFrame, PaddedSurface

__all__ = ["blended", "finest_level", "looked_behind", "matted"]


def blended(
    frame: PaddedFrame,
    layers: Sequence[tuple[Tensor, int]],
    backed: bool,
    plain: Callable[[Sequence[PaddedSurface]], Tensor],
) -> Tensor | None:
    """Composite all layers of a frame, with its gradient: light followed by its weights, ``[B, C + 1 or C, h, w]``.

    The gradient of the gradient comes from the plain engine.

    Args:
        frame: One surface, or two that share each pixel, in any order.
        layers: Kernel ``[1 or C, k, k]`` and scale of each layer: the distance of its pixels in pixels of the frame.
        backed: Whether the weights are transmittances, not coverages; without occlusion they are sums of weights.
        plain: The same computation by PyTorch, from the frame's surfaces.

    Returns:
        None if the compiled engine cannot compute it: it needs float32 on the CPU, eager code without function
        transforms, and kernels without gradient.
    """
    given = [[t for t in surface if t is not None] for surface in frame.surfaces]
    tensors = [t for of_surface in given for t in of_surface]
    if frame.stacked or len(frame.nodes) > 1 or not _supported(tensors):
        return None
    if any(kernel.requires_grad or kernel.shape[-1] // 2 > native.HALF_LARGEST for kernel, _ in layers):
        return None
    if frame.colours + max(len(kernel) for kernel, _ in layers) > native.MOST_PLANES:
        return None
    padded = native.FrameLayers(frame.margin, frame.area, frame.nodes[0], layers, frame.occlusion, backed)
    result: Tensor = _Blend.apply(padded, list(map(len, given)), plain, *tensors)
    return result


def looked_behind(
    values: Sequence[Tensor],
    rules: native.Rules,
    coc_px: Tensor,
    plain: Callable[[Sequence[Tensor], Tensor], Tensor],
) -> Tensor | None:
    """Light, coc and votes of the surfaces behind those of an image, ``[B, C + 2, H, W]``, with their gradient.

    Args:
        values: Light, coc and weight of each level of a pyramid that is centred on the image, ``[B, C + 2, h, w]``.
        rules: For each level: the distance of two samples in pixels, the smallest blur in pixels at which the level is
            read, its votes per weight, and its largest number of votes.
        coc_px: Signed coc of the image, ``[B, 1, H, W]``.
        plain: The same computation by PyTorch, from the levels' values and the coc.

    Returns:
        None if the compiled engine cannot compute it, as in :func:`blended`.
    """
    if not _supported([coc_px, *values]) or len(values) > native.MOST_LEVELS or values[0].shape[1] > native.MOST_PLANES:
        return None

    def forward(coc: Tensor, *levels: Tensor) -> Tensor:
        return native.look_behind(levels, rules, coc[0])

    def backward(gradient: Tensor, coc: Tensor, *levels: Tensor) -> list[Tensor]:
        return native.look_behind_gradient(levels, rules, coc[0], gradient)

    result: Tensor = _Step.apply(forward, backward, lambda coc, *levels: plain(levels, coc), coc_px, *values)
    return result


def finest_level(
    maps: Sequence[Tensor], threshold: Tensor, valid: Tensor | None, size: tuple[int, int], plain: Callable[..., Tensor]
) -> Tensor | None:
    """The finest level of a pyramid of an image's farthest surfaces, ``[B, C + 2, h, w]``, with its gradient.

    Args:
        maps: Light and coc of each pixel's own surface, the same of its other surface, and the weight of that one,
            ``[B, C or 1, H, W]``.
        threshold: Light above which a pixel is a highlight, ``[B, 1, H, W]``, constant to autograd.
        valid: ``[B, 1, H, W]``, 0 where a pixel is left out; None means all count.
        size: Height and width of the level, h and w.
        plain: The same computation by PyTorch, from ``maps``.

    Returns:
        None if the compiled engine cannot compute it, as in :func:`blended`.
    """
    constant = [threshold, *([] if valid is None else [valid])]
    if not _supported([*maps, *constant]) or maps[0].shape[1] > native.MOST_PLANES:
        return None

    def forward(*given: Tensor) -> Tensor:
        return native.farthest(given, size)

    def backward(gradient: Tensor, *given: Tensor) -> list[Tensor | None]:
        return [*native.farthest_gradient(given, size, gradient), *[None] * len(constant)]

    result: Tensor = _Step.apply(forward, backward, lambda *given: plain(*given[:5]), *maps, *constant)
    return result


def matted(
    light: Tensor, coc_px: Tensor, valid: Tensor | None, plain: Callable[[Tensor, Tensor], Tensor]
) -> Tensor | None:
    """Both surfaces of each pixel, ``[B, 2 C + 2, H, W]``: their light, coc and weight of the other one, with gradient.

    Arguments are those of :func:`torchdof.render.matting.matte`; ``plain`` is the same computation by PyTorch, from
    light and coc. None if the compiled engine cannot compute it, as in :func:`blended`.
    """
    constant = [] if valid is None else [valid]
    if not _supported([light, coc_px, *constant]):
        return None

    def backward(gradient: Tensor, *given: Tensor) -> list[Tensor | None]:
        return [*native.matte_gradient(given, gradient), *[None] * len(constant)]

    result: Tensor = _Step.apply(
        lambda *given: native.matte(given), backward, lambda *given: plain(*given[:2]), light, coc_px, *constant
    )
    return result


def _supported(tensors: Sequence[Tensor]) -> bool:
    """Whether the compiled engine is in use and can read tensors that may need gradients."""
    if is_traced() or not native.chosen():
        return False
    return all(t.dtype == torch.float32 and is_in_memory(t, backward=True) for t in tensors)


def _surfaces(counts: Sequence[int], tensors: Sequence[Tensor]) -> list[PaddedSurface]:
    """The surfaces of a flat list of tensors, with ``counts`` tensors each."""
    left = iter(tensors)
    return [PaddedSurface(*(next(left) for _ in range(count))) for count in counts]


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, padded: native.FrameLayers, counts: list[int], plain: Any, *tensors: Tensor) -> Tensor:
        ctx.padded, ctx.counts, ctx.plain = padded, counts, plain
        ctx.save_for_backward(*tensors)
        return torch.stack([native.blend(item, padded) for item in _items(counts, tensors)])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,), tensors = gradients, ctx.saved_tensors
        if torch.is_grad_enabled():
            return None, None, None, *_differentiable(ctx.plain(_surfaces(ctx.counts, tensors)), tensors, gradient)
        items = zip(_items(ctx.counts, tensors), gradient, strict=True)
        found = zip(*(native.blend_gradient(item, ctx.padded, of_item) for item, of_item in items), strict=True)
        return None, None, None, *(torch.stack(each).view_as(t) for each, t in zip(found, tensors, strict=True))


def _items(counts: Sequence[int], tensors: Sequence[Tensor]) -> list[list[tuple[Tensor, Tensor, Tensor | None]]]:
    """Light, position and weight of each surface, for each item of a batch."""
    surfaces = _surfaces(counts, [t.detach() for t in tensors])
    return [
        [(s.light[i], s.x[i, 0], None if s.weight is None else s.weight[i, 0]) for s in surfaces]
        for i in range(len(tensors[0]))
    ]


class _Step(torch.autograd.Function):
    """A step that the compiled engine computes for one item of a batch after the other.

    ``forward(*tensors)`` and ``backward(gradient, *tensors)`` compute it and its gradients by each tensor, None for
    constants, from the tensors of one item; ``plain(*tensors)`` is the same computation by PyTorch for all items.
    """

    @staticmethod
    def forward(ctx: Any, forward: Any, backward: Any, plain: Any, *tensors: Tensor) -> Tensor:
        ctx.backward_of_item, ctx.plain = backward, plain
        ctx.save_for_backward(*tensors)
        return torch.stack([forward(*item) for item in zip(*(t.detach() for t in tensors), strict=True)])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,), tensors = gradients, ctx.saved_tensors
        if torch.is_grad_enabled():
            return None, None, None, *_differentiable(ctx.plain(*tensors), tensors, gradient)
        items = zip(gradient, *(t.detach() for t in tensors), strict=True)
        found = zip(*(ctx.backward_of_item(*item) for item in items), strict=True)
        pairs = zip(found, tensors, strict=True)
        return None, None, None, *(None if each[0] is None else torch.stack(each).view_as(t) for each, t in pairs)


def _differentiable(result: Tensor, inputs: Sequence[Tensor], gradient: Tensor) -> list[Tensor | None]:
    """The gradients by those inputs that need one, to be differentiated again."""
    wanted = [t for t in inputs if t.requires_grad]
    found = iter(torch.autograd.grad(result, wanted, gradient, create_graph=True))
    return [next(found) if t.requires_grad else None for t in inputs]
