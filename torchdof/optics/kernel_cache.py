"""A cache of kernels, limited by bytes instead of entries because a kernel takes from a few bytes to megabytes."""

import functools
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from ..tensors import is_fake, is_traced

__all__ = ["KernelCache", "kept"]

_ENTRY_BYTES = 384  # bytes counted for a key and its dictionary entry, besides the tensors
_TENSOR_BYTES = 640  # bytes counted for a tensor besides its values: its object, its storage, their alignment

_Arguments = ParamSpec("_Arguments")
_Key = TypeVar("_Key", bound=Hashable)
Kept = TypeVar("Kept", Tensor, tuple[Tensor, ...], float)


class KernelCache:
    """A least-recently-used cache. Thread-safe.

    Args:
        limit_bytes: Largest size of all results together; a single result that is larger is not kept.
    """

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes, self.bytes = limit_bytes, 0
        self._entries: OrderedDict[Hashable, tuple[object, int]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], Kept]) -> Kept:
        """The result stored under ``key``; computed by ``make`` if it is missing, twice if two threads miss it."""
        return self.get_all([key], lambda _: [make()])[0]

    def get_all(self, keys: Sequence[_Key], make: Callable[[list[_Key]], Sequence[Kept]]) -> list[Kept]:
        """The results of several distinct keys; one call of ``make`` computes those of all missing keys."""
        with self._lock:
            results: dict[_Key, Any] = {key: self._entries[key][0] for key in keys if key in self._entries}
            for key in results:
                self._entries.move_to_end(key)
        missing = [key for key in keys if key not in results]
        results |= zip(missing, map(_unwrapped, make(missing) if missing else ()), strict=True)
        with self._lock:
            for key in missing:
                parts = results[key] if isinstance(results[key], tuple) else (results[key],)
                sizes = [_TENSOR_BYTES + t.untyped_storage().nbytes() for t in parts if isinstance(t, Tensor)]
                size = _ENTRY_BYTES + sum(sizes)
                if key not in self._entries and size <= self.limit_bytes:
                    self._entries[key] = (results[key], size)
                    self.bytes += size
                    while self.bytes > self.limit_bytes:
                        _, (_, freed) = self._entries.popitem(last=False)
                        self.bytes -= freed
        return [results[key] for key in keys]


def _unwrapped(result: Any) -> Any:
    """Remove the wrappers of torch.func, which wraps every tensor, also one that depends on no input."""
    if isinstance(result, tuple):
        return tuple(map(_unwrapped, result))
    while isinstance(result, Tensor) and torch._C._functorch.is_functorch_wrapped_tensor(result):
        result = torch._C._functorch.get_unwrapped(result)
    return result


_CONSTANTS = KernelCache(16 * 2**20)  # the results of all functions decorated with kept


def kept(make: Callable[_Arguments, Kept]) -> Callable[_Arguments, Kept]:
    """Cache the tensors that a function makes from numbers alone, such as index tables: the same in every frame.

    In traced code, and under ``FakeTensorMode``, the function is called each time.
    """
    outside_inference = torch.inference_mode(False)(make)  # autograd will use them too, and refuses inference tensors

    @functools.wraps(make)
    def cached(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> Kept:
        if is_traced() or is_fake():
            return make(*args, **kwargs)
        key = (make.__module__, make.__qualname__, args, tuple(sorted(kwargs.items())))
        return _CONSTANTS.get(key, lambda: outside_inference(*args, **kwargs))

    return cached
