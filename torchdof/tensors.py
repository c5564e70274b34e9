"""Properties of a tensor: traced, differentiated, in memory."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

__all__ = ["floating", "has_storage", "is_differentiated", "is_fake", "is_in_memory", "is_traced"]

_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
"""Floating-point dtypes with arithmetic; PyTorch only stores smaller ones."""


def is_traced() -> bool:
    """Whether this code is being compiled or exported, so that the values of tensors cannot be read."""
    return torch.compiler.is_compiling() or torch.compiler.is_exporting()


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


def is_in_memory(values: Tensor) -> bool:
    """Whether the compiled engine can use a tensor: dense CPU memory, no gradients, no ``FakeTensorMode``."""
    if values.device.type != "cpu" or torch._C._functorch.is_functorch_wrapped_tensor(values):
        return False
    return not is_fake() and has_storage(values) and not is_differentiated(values)


def has_storage(values: Tensor) -> bool:
    """Whether a tensor has memory of its own; fake, masked and other wrappers have none, nor has a freed storage."""
    try:
        storage = values.untyped_storage()
        last = values.storage_offset() + sum(
            (n - 1) * step for n, step in zip(values.shape, values.stride(), strict=True)
        )
        whole = storage.device == values.device and storage.nbytes() >= (last + 1) * values.element_size()
        return values.numel() == 0 or (whole and storage.data_ptr() != 0)
    except (RuntimeError, NotImplementedError):  # wrappers refuse access to their storage
        return False


def floating(value: Any) -> bool:
    """Whether a value is a tensor of floating-point numbers of at least 16 bits."""
    return isinstance(value, Tensor) and value.dtype in _FLOATS
