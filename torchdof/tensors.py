"""What a tensor is: traced, differentiated or in memory."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

__all__ = ["floating", "has_storage", "is_differentiated", "is_fake", "is_in_memory", "is_traced"]

_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
"""Types of number that PyTorch computes with; of smaller ones it only stores."""


def is_traced() -> bool:
    """Whether this code is being compiled or exported: tensors then have no numbers that could be looked at."""
    return torch.compiler.is_compiling() or torch.compiler.is_exporting()


def is_fake() -> bool:
    """Whether new tensors have no memory, as under ``FakeTensorMode``."""
    return torch._C._get_dispatch_mode(torch._C._TorchDispatchModeKey.FAKE) is not None


def is_differentiated(values: Tensor) -> bool:
    """Whether derivatives are taken with respect to some numbers: backwards, forwards, or by torch.func."""
    if is_traced():
        return torch.is_grad_enabled() and values.requires_grad
    while True:
        if (torch.is_grad_enabled() and values.requires_grad) or forward_ad.unpack_dual(values).tangent is not None:
            return True
        if not torch._C._functorch.is_functorch_wrapped_tensor(values):
            return False
        values = torch._C._functorch.get_unwrapped(values)


def is_in_memory(values: Tensor) -> bool:
    """Whether the compiled engine can read some numbers, and nobody asks for more than numbers.

    It cannot under ``FakeTensorMode``, where a new tensor has no memory.
    """
    if values.device.type != "cpu" or torch._C._functorch.is_functorch_wrapped_tensor(values):
        return False
    return not is_fake() and has_storage(values) and not is_differentiated(values)


def has_storage(values: Tensor) -> bool:
    """Whether a tensor's numbers lie in memory: not those of a fake, masked or other wrapper, or of a freed storage."""
    try:
        storage = values.untyped_storage()
        last = values.storage_offset() + sum(
            (n - 1) * step for n, step in zip(values.shape, values.stride(), strict=True)
        )
        whole = storage.device == values.device and storage.nbytes() >= (last + 1) * values.element_size()
        return values.numel() == 0 or (whole and storage.data_ptr() != 0)
    except (RuntimeError, NotImplementedError):  # a wrapper's storage may not be asked
        return False


def floating(value: Any) -> bool:
    """Whether something is a tensor of floating-point numbers that can be computed with: not of 8 bits or fewer."""
    return isinstance(value, Tensor) and value.dtype in _FLOATS
