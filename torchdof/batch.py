"""Converts single images ``[C, H, W]`` and clips ``[B, T, C, H, W]`` to batches ``[B, C, H, W]``, and back."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .tensors import is_traced
from .validation import show


def leading_axes(image: Any) -> tuple[int, ...]:
    """The axes of an image before its channels: ``()`` for one image, ``(B,)`` for a batch, ``(B, T)`` for clips.

    Any other value counts as a batch; the checks of a batch then refuse it.
    """
    if isinstance(image, Tensor) and image.ndim in (3, 5):
        return tuple(image.shape[:-3])
    return (1,)


def flattened(axes: tuple[int, ...], **values: Any) -> list[Any]:
    """Tensors of images and maps, by argument name, as contiguous batches ``[B, ..., H, W]``; one for all stays one.

    ``axes`` are the :func:`leading_axes` of the image. Only ``image`` and ``background`` may have several channels.
    A value that is no tensor is returned unchanged.

    Raises:
        ValueError: If its leading axes do not fit, or it comes from ``torch.vmap``.

    Example:
        >>> flattened((2, 5), depth=torch.ones(2, 1, 1, 8, 12))[0].shape
        torch.Size([10, 1, 8, 12])
    """
    batches = []
    for name, value in values.items():
        if isinstance(value, Tensor) and value.layout == torch.strided:  # the checks of the batch refuse others
            _refuse_vmap(name, value)
            channels = "C" if name in ("image", "background") else "1"
            if len(axes) != 1:
                fits = value.ndim == len(axes) + 3 and (channels == "C" or value.shape[-3] == 1)
                if not fits or not all(n in (1, m) for n, m in zip(value.shape, axes, strict=False)):
                    start = ", ".join(map(str, axes)) + ", " * bool(axes)
                    expected = f"[{start}{channels}, H, W] beside an image [{start}C, H, W]"
                    raise ValueError(f"{name} must be {expected}, got {list(value.shape)}")
                is_shared = all(n == 1 for n in value.shape[: len(axes)])
                value = value if is_shared else value.expand(*axes, -1, -1, -1)
                value = value.flatten(0, 1) if axes else value[None]
            value = value.contiguous()
        batches.append(value)
    return batches


def numbers(axes: tuple[int, ...], name: str, value: Any) -> Any:
    """A number of the camera: a float, or a tensor with one value for each image of the batch.

    ``value`` is a number, a list, or a tensor ``[B]``, ``[B, 1]``, or ``[B, T]`` for clips; None stays None. The other
    arguments are those of :func:`flattened`.

    Raises:
        ValueError: If a list does not hold numbers, a tensor has another shape, or it comes from ``torch.vmap``.

    Example:
        >>> numbers((2,), "focus_m", [1.0, 2.5]).tolist(), numbers((2, 3), "focus_m", torch.ones(2)).shape
        ([1.0, 2.5], torch.Size([6]))
    """
    if isinstance(value, Sequence) and not isinstance(value, str):
        try:
            value = torch.tensor(value, dtype=torch.float64, device="cpu")
        except (TypeError, ValueError, RuntimeError, OverflowError):
            raise ValueError(f"{name} must be a number, a list of numbers or a tensor [B], got {show(value)}") from None
    if not isinstance(value, Tensor):
        return value
    _refuse_vmap(name, value)
    if value.ndim == 0 or value.layout != torch.strided:  # the checks of the camera refuse other layouts
        return value
    if len(axes) < 2:
        return value[:, 0] if value.ndim == 2 and value.shape[1] == 1 else value
    batch, frames = axes
    per_clip = value.reshape(-1, 1) if value.ndim == 1 else value
    if per_clip.ndim != 2 or per_clip.shape[0] not in (1, batch) or per_clip.shape[1] not in (1, frames):
        raise ValueError(f"{name} must be a number, [{batch}] or [{batch}, {frames}] for clips, got {show(value)}")
    return per_clip.expand(batch, frames).flatten()


def restored(axes: tuple[int, ...], batch: Tensor) -> Tensor:
    """A rendered batch with the leading axes of the input image."""
    if not axes:
        return batch[0]
    return batch if len(axes) == 1 else batch.unflatten(0, axes)


def _refuse_vmap(name: str, value: Tensor) -> None:
    """Refuse a tensor inside ``torch.vmap``, because planning layers reads its values."""
    while not is_traced() and torch._C._functorch.is_functorch_wrapped_tensor(value):
        if torch._C._functorch.is_batchedtensor(value):
            raise ValueError(f"{name} comes from torch.vmap, in which no values can be read; pass the whole batch")
        value = torch._C._functorch.get_unwrapped(value)  # torch.func.grad inside of torch.vmap wraps it once more
