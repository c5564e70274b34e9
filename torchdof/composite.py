"""Layers, far to near, to one image: each layer is scattered with its kernel and laid over what is behind it."""

from collections.abc import Callable, Iterator, Sequence

import torch
import torch.nn.functional as functional
from torch import Tensor

from .layers import share_at_or_behind

__all__ = ["Sample", "accumulate", "over"]

Sample = tuple[Tensor, Tensor, Tensor | None]
"""Light ``[B, C, H, W]`` of one surface a pixel, its place on the blur axis and its weight ``[B, 1, H, W]`` (None: 1)."""

Spread = Callable[[Tensor, Tensor], Tensor]


def over(samples: Sequence[Sample], nodes: Sequence[float], bank: Sequence[Tensor], spread: Spread) -> Tensor:
    """Normalised "over" of soft layers.

    With ``m_k`` the share of layer k, ``M_k`` the share at or behind it and ``K_k`` its kernel:
    ``colour = K_k * (m_k I) / K_k * M_k``, coverage ``a = K_k * m_k / K_k * M_k``, ``out = colour + (1 - a) out``.
    Dividing by ``K_k * M_k`` keeps a surface that spans several layers closed and lets the background reach under the
    blurred edge of what is in front. What no layer reaches weighs nothing: the sum is divided by its coverage.

    Args:
        samples: Surfaces seen in each pixel.
        nodes: Places of the layers, near to far.
        bank: Kernel of each layer, ``[1 or C, k, k]``.
        spread: ``(light [B, C, H, W], kernels [C, k, k]) -> [B, C, H, W]``.

    Returns:
        ``[B, C, H, W]``.

    Reference:
        Ikoma, Nguyen, Metzler, Peng, Wetzstein, "Depth from defocus with learned optics", ICCP 2021.
    """
    light = samples[0][0]
    out, covered = torch.zeros_like(light), light.new_zeros(())
    for light, share, room in _spread_layers(samples, nodes, bank, spread, room=True):
        room = room.clamp_min(torch.finfo(room.dtype).tiny ** 0.5)
        left = 1.0 - (share / room).clamp(0.0, 1.0)
        out = light / room + left * out
        covered = 1.0 - left + left * covered
    return torch.where(covered > 0, out / torch.where(covered > 0, covered, 1.0), 0.0)


def accumulate(
    samples: Sequence[Sample], nodes: Sequence[float], bank: Sequence[Tensor], spread: Spread, normalize: bool
) -> Tensor:
    """The paper's scatter: every pixel's light accumulates, whatever lies in front; then divided by the weights' sum.

    Args:
        samples: Surfaces seen in each pixel.
        nodes: Places of the layers, near to far.
        bank: Kernel of each layer, ``[1 or C, k, k]``.
        spread: As in :func:`over`.
        normalize: False leaves the plain sum, which is dark at the frame's border and uneven at depth edges.

    Returns:
        ``[B, C, H, W]``.
    """
    light = samples[0][0]
    total, weight = torch.zeros_like(light), light.new_zeros(())
    for light, share in _spread_layers(samples, nodes, bank, spread, room=False):
        total, weight = total + light, weight + share
    return torch.where(weight > 0, total / torch.where(weight > 0, weight, 1.0), 0.0) if normalize else total


def _spread_layers(
    samples: Sequence[Sample], nodes: Sequence[float], bank: Sequence[Tensor], spread: Spread, room: bool
) -> Iterator[tuple[Tensor, ...]]:
    """Scattered light, share and (with ``room``) share at or behind of every occupied layer, far to near."""
    pending: list[tuple[list[Tensor], Tensor]] = []
    behind = _behind(samples, nodes, len(nodes))
    for k in reversed(range(len(nodes))):
        here = _behind(samples, nodes, k)
        share, behind_before = here - behind, behind
        behind = here
        if not _traced() and not bool((here != behind_before).any()):
            continue
        parts = [_light(samples, nodes, k), share, *([here] if room else [])]
        if bank[k].shape[0] > 1:
            parts = [parts[0], *(p.expand_as(parts[0]) for p in parts[1:])]
        if pending and not _packs(pending, parts, bank[k]):
            yield from _flush(pending, spread)
            pending = []
        pending.append((parts, bank[k]))
    yield from _flush(pending, spread)


def _packs(pending: Sequence[tuple[list[Tensor], Tensor]], parts: list[Tensor], kernels: Tensor) -> bool:
    """Whether one more layer is worth spreading together with those that wait: 16 channels go as fast as 4."""
    channels = sum(p.shape[1] for p in parts)
    sizes = [k.shape[-1] for _, k in pending] + [kernels.shape[-1]]
    return channels * len(sizes) <= 16 and max(sizes) ** 2 <= 2 * min(sizes) ** 2


def _flush(pending: Sequence[tuple[list[Tensor], Tensor]], spread: Spread) -> Iterator[tuple[Tensor, ...]]:
    if not pending:
        return
    size = max(k.shape[-1] for _, k in pending)
    light, kernels, lengths = [], [], []
    for parts, kernel in pending:
        margin = (size - kernel.shape[-1]) // 2
        kernel = functional.pad(kernel, (margin,) * 4)
        light += parts
        kernels += [kernel.expand(p.shape[1], -1, -1) for p in parts]
        lengths += [p.shape[1] for p in parts]
    spreaded = spread(torch.cat(light, 1), torch.cat(kernels)).split(lengths, 1)
    each = len(pending[0][0])
    for i in range(0, len(spreaded), each):
        yield spreaded[i : i + each]


def _traced() -> bool:
    return torch.compiler.is_compiling() or torch.compiler.is_exporting()


def _behind(samples: Sequence[Sample], nodes: Sequence[float], k: int) -> Tensor:
    total = None
    for _, x, weight in samples:
        share = share_at_or_behind(x, nodes, k)
        share = share if weight is None else share * weight
        total = share if total is None else total + share
    return total


def _light(samples: Sequence[Sample], nodes: Sequence[float], k: int) -> Tensor:
    total = None
    for light, x, weight in samples:
        share = share_at_or_behind(x, nodes, k) - share_at_or_behind(x, nodes, k + 1)
        light = light * (share if weight is None else share * weight)
        total = light if total is None else total + light
    return total
