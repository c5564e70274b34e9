"""Steps of a differentiated rendering that compiled code computes, forward and backward."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ...validation import engine_reads


def compiled_step(
    forward: Callable[..., Tensor],
    backward: Callable[..., Sequence[Tensor]],
    plain: Callable[..., Tensor],
    *tensors: Tensor,
) -> Tensor | None:
    """A step that the compiled engine computes for one item of a batch after the other.

    Args:
        forward: ``forward(*tensors)`` computes the step for one item, whose tensors lack the axis of the batch.
        backward: ``backward(gradient, *tensors)`` computes its gradients by the first tensors; the others are constant.
        plain: ``plain(*tensors)`` is the same step by PyTorch, for all items: for the gradients of gradients.
        *tensors: Input of the step, ``[B, ...]``.

    Returns:
        None if the compiled engine is not in use or cannot read the tensors: it needs float32 on the CPU, and eager
        code without function transforms.
    """
    if not engine_reads(*tensors, backward=True):
        return None

    def of_batch(*tensors: Tensor) -> Tensor:
        return _stacked([forward(*item) for item in zip(*tensors, strict=True)])

    def gradients_of_batch(*tensors: Tensor) -> list[Tensor]:
        of_items = [backward(*item) for item in zip(*tensors, strict=True)]
        return [_stacked(of_tensor) for of_tensor in zip(*of_items, strict=True)]

    return differentiable(of_batch, gradients_of_batch, plain, *tensors)


def by_items(compute: Callable[..., tuple[Tensor, float]], maps: Tensor, *others: Tensor) -> tuple[Tensor, Tensor]:
    """Maps ``[B, 1, H, W]`` and a number of each item, ``[B, 1, 1, 1]``, item by item.

    ``compute(other, map, *others)`` returns the map of an item and its number; if it returns the given map for each
    item, so does this function. ``others`` have at least one tensor, ``[B, ...]``.
    """
    items = [of_item[0] for of_item in maps]
    results, numbers = zip(*map(compute, others[0], items, *others[1:]), strict=True)
    is_new = any(new is not old for new, old in zip(results, items, strict=True))
    return _stacked(results)[:, None] if is_new else maps, maps.new_tensor(numbers).view(-1, 1, 1, 1)


def differentiable(
    forward: Callable[..., Tensor],
    backward: Callable[..., Sequence[Tensor]],
    plain: Callable[..., Tensor],
    *tensors: Tensor,
) -> Tensor:
    """``forward(*tensors)`` of compiled code, whose gradients are those of ``backward``.

    The arguments are those of :func:`compiled_step`, but the functions take whole batches.
    """
    result: Tensor = _Step.apply(forward, backward, plain, *tensors)
    return result


def _plain_gradients(plain: Callable[..., Tensor], tensors: Sequence[Tensor], gradient: Tensor) -> list[Tensor | None]:
    """The gradients of ``plain(*tensors)`` by its tensors, which can be differentiated again."""
    tensors = [t.view_as(t) for t in tensors]  # one may be computed from another: gradients stop at the views
    wanted = [t for t in tensors if t.requires_grad]
    of_wanted = iter(torch.autograd.grad(plain(*tensors), wanted, gradient, create_graph=True))
    return [next(of_wanted) if t.requires_grad else None for t in tensors]


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, forward: Any, backward: Any, plain: Any, *tensors: Tensor) -> Tensor:
        ctx.gradients, ctx.plain = backward, plain
        ctx.save_for_backward(*tensors)
        result: Tensor = forward(*(t.detach() for t in tensors))
        return result

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,), tensors = gradients, ctx.saved_tensors
        found: list[Tensor | None]
        if torch.is_grad_enabled():  # the gradients will be differentiated again
            found = _plain_gradients(ctx.plain, tensors, gradient)
        else:
            found = [*ctx.gradients(gradient, *(t.detach() for t in tensors))]
        return None, None, None, *found, *[None] * (len(tensors) - len(found))


def _stacked(items: Sequence[Tensor]) -> Tensor:
    return torch.stack([*items]) if len(items) > 1 else items[0][None]  # without a copy
