"""Code that ``torch.compile`` does not trace: functions whose work depends on values, and the kernels of a table.

A compiled graph calls each of these functions as one operator, and holds the kernels as constants.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ...tensors import is_exporting

_KEPT = 4  # cached lists of constants; a compiled graph asks for each of its lists twice


def is_compiled() -> bool:
    """Whether this code is being compiled, but not exported."""
    return torch.compiler.is_compiling() and not is_exporting()


def one_operator(
    name: str, empty: Callable[..., Any], differentiable: int = 0
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Make functions of tensors, None and numbers that return new contiguous tensors operators of PyTorch.

    A compiled graph calls an operator as a whole.

    Args:
        name: Name of the operator.
        empty: Function of the same arguments that returns empty tensors like the results.
        differentiable: Number of leading arguments that get gradients; the backward pass runs the function again.
    """

    def decorated(function: Callable[..., Any]) -> Callable[..., Any]:
        operator = torch.library.custom_op(name, function, mutates_args=())
        operator.register_fake(empty)
        if differentiable:
            _differentiate(operator, name, function, differentiable)
        return operator

    return decorated


def _differentiate(operator: Any, name: str, function: Callable[..., Any], differentiable: int) -> None:
    """Give an operator a backward pass that is an operator too: the compiler would trace all of it otherwise."""

    def gradients(*arguments: Any) -> list[Tensor]:
        *inputs, of_outputs = arguments
        with torch.enable_grad(), _autograd():
            moving = [value.detach().requires_grad_() for value in inputs[:differentiable]]
            outputs = function(*moving, *inputs[differentiable:])
            wanted = [(o, g) for o, g in zip(outputs, of_outputs, strict=True) if o.requires_grad]
            back = torch.autograd.grad([o for o, _ in wanted], moving, [g for _, g in wanted], allow_unused=True)
        return [torch.zeros_like(v) if g is None else g.contiguous() for v, g in zip(moving, back, strict=True)]

    arguments = operator._schema.split(") ->")[0]
    schema = f"{arguments}, Tensor[] of_outputs) -> Tensor[]"
    of_inputs = torch.library.custom_op(f"{name}_gradients", gradients, mutates_args=(), schema=schema)
    of_inputs.register_fake(lambda *inputs: [value.new_empty(value.shape) for value in inputs[:differentiable]])

    def remember(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:  # PyTorch passes these arguments by name
        ctx.others = [None if isinstance(value, Tensor) else value for value in inputs]
        ctx.save_for_backward(*(value if isinstance(value, Tensor) else None for value in inputs))

    def backward(context: Any, *of_outputs: Tensor) -> tuple[Tensor | None, ...]:
        saved = zip(context.saved_tensors, context.others, strict=True)
        inputs = [other if tensor is None else tensor for tensor, other in saved]
        return (*of_inputs(*inputs, list(of_outputs)), *[None] * (len(inputs) - differentiable))

    operator.register_autograd(backward, setup_context=remember)


def _autograd() -> Any:
    """A context in which autograd records operations; PyTorch leaves it out within an operator."""
    left_out = torch._C._dispatch_tls_local_exclude_set()
    for key in ("AutogradFunctionality", "AutogradOther", "AutogradNestedTensor", "ADInplaceOrView"):
        left_out = left_out.remove(getattr(torch._C.DispatchKey, key))
    return torch._C._ForceDispatchKeyGuard(torch._C._dispatch_tls_local_include_set(), left_out)


def constants(make: Callable[..., Sequence[Tensor]], *arguments: Any) -> list[Tensor]:
    """The tensors of ``make(*arguments)`` as constants of a compiled graph, in which ``arguments`` never change."""
    shapes = _shapes(make, *arguments)
    parts = _numbers(make, *arguments).split([math.prod(shape) for shape in shapes])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


@functools.lru_cache(_KEPT)
def _made(make: Callable[..., Sequence[Tensor]], *arguments: Any) -> list[Tensor]:
    return list(make(*arguments))


def _shapes(make: Callable[..., Sequence[Tensor]], *arguments: Any) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(tensor.shape) for tensor in _made(make, *arguments))


def _numbers(make: Callable[..., Sequence[Tensor]], *arguments: Any) -> Tensor:
    return torch.cat([tensor.flatten() for tensor in _made(make, *arguments)])


for _constant in (_shapes, _numbers):  # two functions: a compiled graph holds one constant for each
    # sets the flag of torch.compiler.assume_constant_result, without importing the whole compiler
    _constant._dynamo_marked_constant = True  # type: ignore[union-attr]
