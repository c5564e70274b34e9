"""Runs the small PyTorch operations of a differentiated rendering on one thread, so that none waits for another.

A step with gradients consists of compiled passes and of hundreds of PyTorch operations between them. PyTorch divides an
operation from about 32,768 numbers on among its OpenMP threads, and a thread without work spins for milliseconds. On a
machine that others use too, spinning threads take the time of those that have work: a step takes ten times as long.
"""

import contextlib
import ctypes
import functools
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from ... import native
from ...tensors import is_in_memory, is_traced

_MOST_PIXELS = 2**18  # of an image; larger ones gain more from several threads than they lose by waiting ones


def on_one_thread(render: Callable[..., Tensor], *tensors: Tensor) -> Tensor:
    """``render(*tensors)``, forward and backward with PyTorch's operations on one thread, if the image is small.

    The first tensor is the image. The compiled passes use all threads. All leaves of the gradient are tensors given.
    """
    if not _is_wanted(tensors):
        return render(*tensors)
    result: Tensor = _OneThread.apply(render, *tensors)
    return result


def _is_wanted(tensors: tuple[Tensor, ...]) -> bool:
    if is_traced() or not torch.is_grad_enabled() or not any(t.requires_grad for t in tensors):
        return False
    height, width = tensors[0].shape[-2:]
    is_small = int(height * width) <= _MOST_PIXELS
    return is_small and torch.get_num_threads() > 1 and all(is_in_memory(t, backward=True) for t in tensors)


class _OneThread(torch.autograd.Function):
    """A graph inside a node: its backward pass runs while PyTorch has one thread."""

    @staticmethod
    def forward(ctx: Any, render: Callable[..., Tensor], *tensors: Tensor) -> Tensor:
        ctx.render = render
        ctx.save_for_backward(*tensors)
        ctx.inputs = [t.detach().requires_grad_(t.requires_grad) for t in tensors]
        with torch.enable_grad(), _one_thread():
            ctx.out = render(*ctx.inputs)
        return ctx.out.detach()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        tensors, again = ctx.saved_tensors, torch.is_grad_enabled()
        with _one_thread():
            if again:  # the gradients will be differentiated again
                inputs = [
                    t.view_as(t) for t in tensors
                ]  # one may be computed from another: gradients stop at the views
                out = ctx.render(*inputs)
            else:
                inputs, out = ctx.inputs, ctx.out
            wanted = [t for t in inputs if t.requires_grad]
            keep = again or torch._C._autograd._get_current_graph_task_keep_graph()
            # of a sum: PyTorch imports sympy, which takes 0.3 s, to check gradients that it is given
            with torch.enable_grad():
                product = (out * gradients[0]).sum()
            found = iter(torch.autograd.grad(product, wanted, retain_graph=keep, create_graph=again, allow_unused=True))
        if not keep:
            ctx.inputs = ctx.out = None
        return None, *(next(found) if t.requires_grad else None for t in inputs)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """PyTorch's operations of this thread on one thread; the compiled engine keeps its number.

    ``torch.set_num_threads`` would also set the number of threads that begin at the same time.
    """
    count, set_count = torch.get_num_threads(), _openmp_setter()
    if count == 1 or set_count is None:
        yield
        return
    try:
        set_count(1)
        with native.threads_are(count):
            yield
    finally:
        set_count(count)


@functools.cache
def _openmp_setter() -> Callable[[int], None] | None:
    """OpenMP's function that sets the number of threads of the calling thread; None where PyTorch does not show it."""
    try:
        setter = ctypes.CDLL(None).omp_set_num_threads
    except (OSError, AttributeError, TypeError):  # TypeError: on Windows a library has a name
        return None
    setter.restype, setter.argtypes = None, [ctypes.c_int]
    return setter
