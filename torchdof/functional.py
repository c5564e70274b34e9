"""Blur each pixel with the kernel of its own radius, which the caller computes.

It is the paper's scatter without layers; training code calls it a PSF layer.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import torch
import torch.nn.functional as functional
from torch import Tensor

from .batch import flattened, leading_axes, restored
from .optics.blur_table import BlurTable
from .optics.kernel_bank import bank_of
from .optics.kernel_cache import KernelCache
from .tensors import is_traced
from .validation import ends, image_and_coc, image_and_map, show

__all__ = ["splat"]

_PER_PX = 128  # kernels per px of radius, up to _EVEN_PX; more take longer and hardly change the picture
_EVEN_PX = 2.0  # px of radius: above, kernels are 1/256 of the radius apart; larger is finer
_AT_ONCE = 64  # kernels of similar radius made together, each as wide as the widest; more take more memory
_LEAST = 1e-6  # scattered weight, of 1: pixels with less are unknown and become 0
_DISC = BlurTable.disc()
_GAUSSIAN = BlurTable.gaussian(1.0)
_kernels = KernelCache(128 * 2**20)


def splat(
    image: Tensor,
    coc_px: Tensor | None = None,
    table: BlurTable | None = None,
    *,
    sigma_px: Tensor | None = None,
    normalize: bool = True,
) -> Tensor:
    """Scatter each pixel's light with the kernel of its own blur: no layers, no occlusion, no tolerance.

    With ``K_q`` the kernel of pixel q and ``I`` its light, the picture at p is
    ``sum_q K_q(p - q) I(q) / sum_q K_q(p - q)``; without ``normalize`` it is the numerator alone.

    Kernels are interpolated linearly between radii 1/128 px apart, above 2 px 1/256 of the radius apart. On average, at
    most 2e-4 of a kernel's light differs from :meth:`torchdof.BlurTable.kernels`. Time grows with the number of pixels
    times the square of the largest blur; memory grows with the number of pixels alone, with gradients too. For blurs of
    more than a few pixels :func:`torchdof.blur_by_coc` is many times faster.

    Args:
        image: ``[B, C, H, W]``, linear light, floating point; also ``[C, H, W]`` or ``[B, T, C, H, W]``, with maps of
            the same rank.
        coc_px: Signed radius of the circle of confusion ``[B, 1, H, W]`` or ``[1, 1, H, W]``, in pixels; negative in
            front of the focus plane.
        table: Blur of a lens, the same across the frame; None takes the ideal disc.
        sigma_px: In place of ``coc_px`` and ``table``: standard deviation of a Gaussian, in pixels, >= 0, of the same
            shapes.
        normalize: Divide by the sum of the kernels that reach a pixel. False gives the plain sum, which is darker at
            the border, because some light leaves the frame.

    Returns:
        The image's shape and dtype. Differentiable with respect to the image and to ``coc_px`` or ``sigma_px``, any
        number of times, in reverse mode (not by ``torch.func.jvp``).

    Raises:
        ValueError: If an argument is not as described or not finite, both or neither of ``coc_px`` and ``sigma_px``
            are given, ``sigma_px`` comes with a table, the table's blur depends on the place in the frame or has a
            gradient to its aperture, a tensor comes from ``torch.vmap``, or the call is compiled or exported.

    Reference:
        Sato, Dobashi, Yamamoto, section 3 (the scatter). Gur, Wolf, "Single image depth estimation trained via depth
        from defocus cues", CVPR 2019 (normalised; their layer ``GaussPSF``). Yang et al., "Aberration-aware
        depth-from-focus", IEEE TPAMI 2023 (the plain sum; ``splat_psf_per_pixel`` of DeepLens).

    Example:
        >>> image, coc_px = torch.rand(1, 3, 8, 12), torch.linspace(-2, 2, 12).expand(1, 1, 8, 12)
        >>> splat(image, coc_px).shape
        torch.Size([1, 3, 8, 12])
        >>> torch.equal(splat(image, sigma_px=torch.zeros(1, 1, 8, 12)), image)
        True
    """
    if is_traced():
        raise ValueError(
            "splat makes kernels of the radii that occur, which a compiled or exported graph cannot; call it outside, "
            "as torch.compiler.disable(splat), or use blur_by_coc(..., occlusion=False)"
        )
    axes = leading_axes(image)
    image, coc_px = flattened(axes, "image", image, "C"), flattened(axes, "coc_px", coc_px)
    sigma_px = flattened(axes, "sigma_px", sigma_px)
    if (coc_px is None) == (sigma_px is None):
        got = "neither" if coc_px is None else "both"
        raise ValueError(f"splat takes coc_px, with a table, or sigma_px, of Gaussians; got {got}")
    if sigma_px is not None:
        if table is not None:
            raise ValueError("sigma_px is that of Gaussians and takes no table; give coc_px beside a table")
        image_and_map(image, "sigma_px", sigma_px, "in pixels")
        if not 0.0 <= ends(sigma_px)[0]:
            raise ValueError("sigma_px must be >= 0 and finite, got a number that is negative or NaN")
        coc_px, table = sigma_px, _GAUSSIAN
    table = _DISC if table is None else table
    if not isinstance(table, BlurTable):
        raise ValueError(f"table must be a torchdof.BlurTable, got {show(table)}; read a file with BlurTable.load()")
    image_and_coc(image, coc_px, table.channels, values=True)
    if table.depends_on_place:
        raise ValueError(
            "splat takes one kernel a radius, not a table with a field or vignetting; leave these out, or use "
            "blur_by_coc(..., occlusion=False)"
        )
    if table.is_differentiated:
        raise ValueError(
            "splat gives no gradient to the aperture; detach its rotation and squeeze, or use "
            "blur_by_coc(..., occlusion=False)"
        )
    return restored(axes, _splatted(image, coc_px, table, normalize))


def _splatted(image: Tensor, coc_px: Tensor, table: BlurTable, normalize: bool) -> Tensor:
    """The same for a checked batch ``[B, C, H, W]``."""
    batch, channels, height, width = image.shape
    wide = torch.float64 if torch.float64 in (image.dtype, coc_px.dtype) else torch.float32
    light, coc = image.to(wide), coc_px.to(wide).expand(batch, -1, -1, -1)
    if normalize:  # weights are scattered beside the light, with as many channels as there are kernels
        light = torch.cat([light, torch.ones_like(light[:, : table.channels])], 1)
    light = light.unflatten(1, (-1, table.channels))  # [B, n, 1 or C, H, W]

    # the two kernels around each radius, and the fraction of the way from the first to the second
    radius, sign = coc.abs(), torch.where(coc.detach() < 0, -1.0, 1.0)
    low = _place(radius.detach()).floor()
    below, above = _radius(low), _radius(low + 1.0)
    part = (radius - below) / (above - below)
    places, which = torch.unique((sign * torch.stack([low, low + 1.0])).long(), return_inverse=True)
    kernels = _kernels_at(places.tolist(), table, width, max(height, width)).to(image.device, wide)
    half = kernels.shape[-1] // 2
    lit = (kernels != 0).flatten(0, 1).any(0).nonzero() - half
    steps = [(down, right) for down, right in lit.tolist() if abs(down) < height and abs(right) < width]
    taps = torch.stack([kernels[..., half + down, half + right].t() for down, right in steps])  # [steps, 1 or C, n]

    # on the CPU one image at a time, which fits into the caches
    count = 1 if light.device.type == "cpu" else batch
    parts = zip(light.split(count), part.split(count), which.split(count, 1), strict=True)
    out = torch.cat([_Scatter.apply(*each, taps, steps) for each in parts]).flatten(1, 2)
    if normalize:
        out, weight = out[:, :channels], out[:, channels:]
        out = out / torch.where(weight > _LEAST, weight, torch.inf)
    return out.to(image.dtype)


class _Scatter(torch.autograd.Function):
    """Scatter light with each pixel's own kernel: for each offset within the kernels, multiply, shift and add.

    Only the inputs are saved for the backward pass.
    """

    @staticmethod
    def forward(light: Tensor, part: Tensor, which: Tensor, taps: Tensor, steps: list[tuple[int, int]]) -> Tensor:
        """Scatter light.

        Args:
            light: ``[B, n, 1 or C, H, W]``.
            part: Weight of the second of each pixel's two kernels, 0 to 1: ``[B, 1, H, W]``.
            which: Indices of the two kernels of each pixel, ``[2, B, 1, H, W]``.
            taps: Values of all kernels at each offset, ``[steps, 1 or C, kernels]``.
            steps: The offsets: rows down and columns to the right by which light moves.
        """
        out = torch.zeros_like(light)
        for tap, _, source, target in _moves(part, which, taps, steps):
            out[target].addcmul_(light[source], tap)
        return out

    @staticmethod
    def setup_context(context: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        """Save the inputs."""
        *tensors, context.steps = inputs
        context.save_for_backward(*tensors)

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of ``light`` and ``part``: the same shifts in the opposite direction."""
        light, part, which, taps = context.saved_tensors
        to_light = torch.zeros_like(light) if context.needs_input_grad[0] else None
        to_part = torch.zeros_like(part) if context.needs_input_grad[1] else None
        for tap, slope, source, target in _moves(part, which, taps, context.steps):
            if to_light is not None:
                to_light[source].addcmul_(gradients[0][target], tap)
            if to_part is not None:
                to_part[source] += (gradients[0][target] * light[source] * slope).sum((1, 2)).unsqueeze(1)
        return to_light, to_part, None, None, None


def _moves(
    part: Tensor, which: Tensor, taps: Tensor, steps: list[tuple[int, int]]
) -> Iterator[tuple[Tensor, Tensor, tuple[Any, ...], tuple[Any, ...]]]:
    """For each offset: kernel values, their derivative by ``part``, source pixels and target pixels of the light.

    The first two are ``[B, 1, 1 or C, rows, columns]``, for the source pixels.
    """
    height, width = part.shape[-2:]
    first, second = (each.flatten() for each in which)
    for (down, right), values in zip(steps, taps, strict=True):
        low, high = (values.index_select(1, each).unflatten(1, part.shape) for each in (first, second))
        slope = (high - low).permute(1, 2, 0, 3, 4)  # [1 or C, B, 1, H, W] to [B, 1, 1 or C, H, W]
        tap = torch.addcmul(low.permute(1, 2, 0, 3, 4), slope, part.unsqueeze(2))
        rows, columns = (slice(max(-n, 0), size - max(n, 0)) for n, size in ((down, height), (right, width)))
        source = (..., rows, columns)
        target = (..., slice(rows.start + down, rows.stop + down), slice(columns.start + right, columns.stop + right))
        yield tap[source], slope[source], source, target


def _kernels_at(places: list[int], table: BlurTable, width: int, longest: int) -> Tensor:
    """Kernels ``[n, 1 or C, k, k]``, float64, at ``places`` (:func:`_place`) with the sign of the coc.

    They are cut to the offsets within a frame whose longer side is ``longest`` pixels.
    """

    def make(keys: Sequence[tuple[Any, ...]]) -> list[Tensor]:
        made: dict[int, Tensor] = {}
        by_radius = sorted((key[-1] for key in keys), key=abs)
        for start in range(0, len(by_radius), _AT_ONCE):
            some = torch.tensor(by_radius[start : start + _AT_ONCE])
            coc = some.sign() * _radius(some.abs().to(torch.float64))
            together = bank_of(table).kernels(coc, width, longest=[longest] * len(coc))
            spare = max(0, together.shape[-1] // 2 - (longest - 1))
            inside = slice(spare, together.shape[-1] - spare)
            made |= {
                place: each[:, inside, inside].clone() for place, each in zip(some.tolist(), together, strict=True)
            }
        return [made[key[-1]] for key in keys]

    # the kernels of a table without lengths are the same for images of any width
    lens = (table.fingerprint(), 1 if table.unit == "relative" else width, longest)
    made = _kernels.get_all([(*lens, place) for place in places], make)
    half = max(kernel.shape[-1] for kernel in made) // 2
    return torch.stack([functional.pad(kernel, (half - kernel.shape[-1] // 2,) * 4) for kernel in made])


def _place(radius: Tensor) -> Tensor:
    """Place of a radius in pixels on a scale on which kernels are made for the whole numbers."""
    even = _PER_PX * radius.clamp(max=_EVEN_PX)
    return even + _PER_PX * _EVEN_PX * (radius / _EVEN_PX).clamp_min(1.0).log()


def _radius(place: Tensor) -> Tensor:
    """Radius in pixels at a place: the inverse of :func:`_place`."""
    even = _PER_PX * _EVEN_PX
    return place.clamp(max=even) / _PER_PX * ((place - even).clamp_min(0.0) / even).exp()
