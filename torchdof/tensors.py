"""Properties of tensors, functions that keep no intermediate ones, and PyTorch's threads after a fork."""

import os
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.autograd.graph import saved_tensors_hooks

TRACEABLE = tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 13)
"""Whether this PyTorch, 2.13 or newer, can compile and export the renderer, and transform it with torch.func."""

_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
"""Floating-point dtypes with arithmetic; PyTorch only stores smaller ones."""


def is_exporting() -> bool:
    """Whether this code is being exported; False before PyTorch 2.7, which cannot export it."""
    return hasattr(torch.compiler, "is_exporting") and torch.compiler.is_exporting()


def is_traced() -> bool:
    """Whether this code is being compiled or exported, so that the values of tensors cannot be read."""
    return torch.compiler.is_compiling() or is_exporting()


def refuse_old_compiler() -> None:
    """Raise an error if a PyTorch that is too old compiles this code.

    Raises:
        RuntimeError: With the remedy in its message; the compiler wraps it in an error of its own.
    """
    if not TRACEABLE and is_traced():
        _refuse_compiler()


def _refuse_compiler() -> None:
    needed = f"torchdof needs PyTorch 2.13 or newer to be compiled, this is {torch.__version__}"
    raise RuntimeError(f"{needed}; leave it out of compiled code, with torch.compiler.disable(dof)")


# With this flag the compiler calls the function, so that its message is seen; at a plain exception it would only stop
# tracing. It is the flag of torch.compiler.assume_constant_result, set without importing the whole compiler.
_refuse_compiler._dynamo_marked_constant = True  # type: ignore[attr-defined]


def is_empty(values: Tensor) -> bool:
    """Whether a list of pixels is empty; False in traced code, where its length cannot be read."""
    return not is_traced() and len(values) == 0


def is_fake() -> bool:
    """Whether new tensors have no memory, as under ``FakeTensorMode``."""
    return torch._C._get_dispatch_mode(torch._C._TorchDispatchModeKey.FAKE) is not None


def is_differentiated(values: Tensor) -> bool:
    """Whether derivatives are taken with respect to a tensor: in reverse mode, in forward mode, or by torch.func."""
    if is_traced():
        return torch.is_grad_enabled() and values.requires_grad
    while True:
        if (torch.is_grad_enabled() and values.requires_grad) or forward_ad.unpack_dual(values).tangent is not None:
            return True
        if not torch._C._functorch.is_functorch_wrapped_tensor(values):
            return False
        values = torch._C._functorch.get_unwrapped(values)


def without_autocast(device: str) -> AbstractContextManager[Any]:
    """A context in which operations on a type of device keep their dtype, also inside an autocast region."""
    return torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext()


def recomputed(compute: Callable[[], Tensor]) -> Tensor:
    """The result of ``compute()``, which the backward pass computes again instead of keeping all intermediate tensors.

    With several such functions, a step with gradients takes the memory of one of them, and the time of a second forward
    pass. Traced code and torch.func keep the intermediate tensors. ``torch.utils.checkpoint`` does the same, but
    imports PyTorch's compiler, which takes seconds.
    """
    if is_traced() or not torch.is_grad_enabled() or torch._C._functorch.peek_interpreter_stack() is not None:
        return compute()
    saved = 0
    again: dict[int, Tensor] = {}

    def pack(values: Tensor) -> tuple[int, str]:
        nonlocal saved
        saved += 1
        return saved - 1, values.device.type

    def repack(values: Tensor) -> None:
        again[len(again)] = values.detach()  # autograd attaches it to the first graph

    def unpack(packed: tuple[int, str]) -> Tensor:
        index, device = packed
        if index not in again:
            again.clear()
            with torch.enable_grad(), without_autocast(device), saved_tensors_hooks(repack, unpack):
                compute()
        return again.pop(index)

    with saved_tensors_hooks(pack, unpack):
        return compute()


def is_in_memory(values: Tensor, backward: bool = False, device: str = "cpu") -> bool:
    """Whether compiled code can use a tensor: dense memory of a device with its values, no gradients, not fake.

    The memory of a negated view, such as ``z.conj().imag`` of a complex ``z``, holds its values with the other sign.

    ``backward`` allows gradients in reverse mode, which some of its steps have.
    """
    if values.device.type != device or torch._C._functorch.is_functorch_wrapped_tensor(values):
        return False
    if is_fake() or values.is_neg() or not has_storage(values):
        return False
    return forward_ad.unpack_dual(values).tangent is None if backward else not is_differentiated(values)


def has_storage(values: Tensor) -> bool:
    """Whether a tensor has memory of its own; False for fake, masked and other wrappers, and for a freed storage."""
    try:
        storage = values.untyped_storage()
        last_index = values.storage_offset() + sum(
            (n - 1) * step for n, step in zip(values.shape, values.stride(), strict=True)
        )
        fits = storage.device == values.device and storage.nbytes() >= (last_index + 1) * values.element_size()
        return values.numel() == 0 or (fits and storage.data_ptr() != 0)
    except (RuntimeError, NotImplementedError):  # wrappers refuse access to their storage
        return False


def floating(value: Any) -> bool:
    """Whether a value is a tensor of floating-point numbers of at least 16 bits; False for a nested tensor."""
    return isinstance(value, Tensor) and value.dtype in _FLOATS and not value.is_nested


def _after_fork() -> None:
    """In a forked child, use one thread: OpenMP's threads do not survive a fork, and waiting for them would hang."""
    # whatever the parent has done: importing the default table and reading a file have already started them
    if torch.get_num_threads() > 1:
        torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
