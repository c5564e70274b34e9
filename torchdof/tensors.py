"""What a tensor is: traced, differentiated or in memory."""

from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

__all__ = [
    "TRACEABLE",
    "floating",
    "has_storage",
    "is_differentiated",
    "is_exporting",
    "is_in_memory",
    "is_traced",
    "refuse_old_compiler",
]

TRACEABLE = tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 13)
"""Whether this PyTorch can compile and export the renderer, and transform it with torch.func: older ones give up."""

_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
"""Types of number that PyTorch computes with; of smaller ones it only stores."""


def is_exporting() -> bool:
    """Whether this code is being exported; PyTorch before 2.7 cannot tell, nor export it."""
    return hasattr(torch.compiler, "is_exporting") and torch.compiler.is_exporting()


def is_traced() -> bool:
    """Whether this code is being compiled or exported: tensors then have no numbers that could be looked at."""
    return torch.compiler.is_compiling() or is_exporting()


def refuse_old_compiler() -> None:
    """Refuse to be compiled by a PyTorch that cannot follow.

    Raises:
        RuntimeError: With what to do; wrapped by the compiler in an error of its own.
    """
    if not TRACEABLE and is_traced():
        _refuse_compiler()


def _refuse_compiler() -> None:
    raise RuntimeError(
        f"torchdof needs PyTorch 2.13 or newer to be compiled, this is {torch.__version__}; leave it out of compiled "
        "code, with torch.compiler.disable(dof)"
    )


# The compiler then calls it, where it would only stop at an exception. What torch.compiler.assume_constant_result does,
# without importing the whole compiler for it.
_refuse_compiler._dynamo_marked_constant = True  # type: ignore[attr-defined]


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
    is_fake = torch._C._get_dispatch_mode(torch._C._TorchDispatchModeKey.FAKE) is not None
    return not is_fake and has_storage(values) and not is_differentiated(values)


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
