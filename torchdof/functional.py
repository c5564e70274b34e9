"""Blur each pixel with the kernel of its own radius, which the caller computes.

This is the paper's scatter without layers; training code calls it a PSF layer.
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
from .options import Options
from .render import routes
from .validation import ends, image_and_map, scene

__all__ = ["splat"]

_STEPS_PER_PX = 128  # kernels per px of radius, up to _LINEAR_UP_TO_PX; more take longer and hardly change the picture
_LINEAR_UP_TO_PX = 2.0  # px; above this radius kernels are 1/256 of the radius apart; a larger limit: more kernels
_KERNELS_AT_ONCE = 64  # kernels of similar radius made together, each as wide as the widest; more take more memory
_MIN_WEIGHT = 1e-6  # scattered weight, of 1: pixels with less are unknown and become 0
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
    blur = Options(table, occlusion=False)  # type: ignore[arg-type]
    routes.refuse(blur, "splat")
    axes = leading_axes(image)
    image, coc_px, sigma_px = flattened(axes, image=image, coc_px=coc_px, sigma_px=sigma_px)
    if (coc_px is None) == (sigma_px is None):
        got = "neither" if coc_px is None else "both"
        raise ValueError(f"splat takes coc_px, with a table, or sigma_px, of Gaussians; got {got}")
    if sigma_px is not None:
        if table is not None:
            raise ValueError("sigma_px is that of Gaussians and takes no table; give coc_px beside a table")
        image_and_map(image, "sigma_px", sigma_px, "in pixels")
        if not 0.0 <= ends(sigma_px)[0]:
            raise ValueError("sigma_px must be >= 0 and finite, got a number that is negative or NaN")
        coc_px = sigma_px
    table = blur.table if sigma_px is None else _GAUSSIAN
    scene(image, "coc_px", coc_px, channels=table.channels)
    return restored(axes, _splatted(image, coc_px, table, normalize))


def _splatted(image: Tensor, coc_px: Tensor, table: BlurTable, normalize: bool) -> Tensor:
    """Scatter a checked batch ``[B, C, H, W]``."""
    batch, channels, height, width = image.shape
    dtype = torch.float64 if torch.float64 in (image.dtype, coc_px.dtype) else torch.float32
    light, coc = image.to(dtype), coc_px.to(dtype).expand(batch, -1, -1, -1)
    if normalize:  # weights are scattered beside the light, with as many channels as there are kernels
        light = torch.cat([light, torch.ones_like(light[:, : table.channels])], 1)
    light = light.unflatten(1, (-1, table.channels))  # [B, n, 1 or C, H, W]

    # the kernels at the radii below and above that of each pixel, and the weight of the second
    radius, sign = coc.abs(), torch.where(coc.detach() < 0, -1.0, 1.0)
    low = _position_of(radius.detach()).floor()
    low_radius, high_radius = _radius_at(low), _radius_at(low + 1.0)
    fraction = (radius - low_radius) / (high_radius - low_radius)
    positions, indices = torch.unique((sign * torch.stack([low, low + 1.0])).long(), return_inverse=True)
    kernels = _kernels_at(positions.tolist(), table, width, max(height, width)).to(image.device, dtype)
    half = kernels.shape[-1] // 2
    taps_used = (kernels != 0).flatten(0, 1).any(0).nonzero() - half
    steps = [(down, right) for down, right in taps_used.tolist() if abs(down) < height and abs(right) < width]
    taps = torch.stack([kernels[..., half + down, half + right].t() for down, right in steps])  # [steps, 1 or C, n]

    # on the CPU one image at a time, which fits into the caches
    count = 1 if light.device.type == "cpu" else batch
    parts = zip(light.split(count), fraction.split(count), indices.split(count, 1), strict=True)
    out = torch.cat([_Scatter.apply(*tensors, taps, steps) for tensors in parts]).flatten(1, 2)
    if normalize:
        out, weight = out[:, :channels], out[:, channels:]
        out = out / torch.where(weight > _MIN_WEIGHT, weight, torch.inf)
    return out.to(image.dtype)


class _Scatter(torch.autograd.Function):
    """Scatter light with each pixel's own kernel: for each offset within the kernels, multiply, shift and add.

    Only the inputs are saved for the backward pass.
    """

    @staticmethod
    def forward(light: Tensor, fraction: Tensor, indices: Tensor, taps: Tensor, steps: list[tuple[int, int]]) -> Tensor:
        """Scatter light ``[B, n, 1 or C, H, W]``.

        ``indices`` ``[2, B, 1, H, W]`` are those of each pixel's two kernels, ``fraction`` ``[B, 1, H, W]`` weighs the
        second. ``taps`` ``[steps, 1 or C, kernels]`` are all kernels at the offsets ``steps``, down and right.
        """
        out = torch.zeros_like(light)
        for tap, _, source, target in _moves(fraction, indices, taps, steps):
            out[target].addcmul_(light[source], tap)
        return out

    @staticmethod
    def setup_context(context: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        *tensors, context.steps = inputs
        context.save_for_backward(*tensors)

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of ``light`` and ``fraction``: the same shifts in the opposite direction."""
        light, fraction, indices, taps = context.saved_tensors
        to_light = torch.zeros_like(light) if context.needs_input_grad[0] else None
        to_fraction = torch.zeros_like(fraction) if context.needs_input_grad[1] else None
        for tap, slope, source, target in _moves(fraction, indices, taps, context.steps):
            if to_light is not None:
                to_light[source].addcmul_(gradients[0][target], tap)
            if to_fraction is not None:
                to_fraction[source] += (gradients[0][target] * light[source] * slope).sum((1, 2)).unsqueeze(1)
        return to_light, to_fraction, None, None, None


def _moves(
    fraction: Tensor, indices: Tensor, taps: Tensor, steps: list[tuple[int, int]]
) -> Iterator[tuple[Tensor, Tensor, tuple[Any, ...], tuple[Any, ...]]]:
    """For each offset: kernel values, their derivative by ``fraction``, source pixels and target pixels of the light.

    The first two are ``[B, 1, 1 or C, rows, columns]``, for the source pixels.
    """
    height, width = fraction.shape[-2:]
    first, second = (index.flatten() for index in indices)
    for (down, right), values in zip(steps, taps, strict=True):
        low, high = (values.index_select(1, index).unflatten(1, fraction.shape) for index in (first, second))
        slope = (high - low).permute(1, 2, 0, 3, 4)  # [1 or C, B, 1, H, W] to [B, 1, 1 or C, H, W]
        tap = torch.addcmul(low.permute(1, 2, 0, 3, 4), slope, fraction.unsqueeze(2))
        rows, columns = (slice(max(-n, 0), size - max(n, 0)) for n, size in ((down, height), (right, width)))
        source = (..., rows, columns)
        target = (..., slice(rows.start + down, rows.stop + down), slice(columns.start + right, columns.stop + right))
        yield tap[source], slope[source], source, target


def _kernels_at(positions: list[int], table: BlurTable, width: int, longest: int) -> Tensor:
    """Kernels ``[n, 1 or C, k, k]``, float64, at ``positions`` (:func:`_position_of`) with the sign of the coc.

    They are cut to the offsets within a frame whose longer side is ``longest`` pixels.
    """

    def make(keys: Sequence[tuple[Any, ...]]) -> list[Tensor]:
        kernels: dict[int, Tensor] = {}
        by_radius = sorted((key[-1] for key in keys), key=abs)
        for start in range(0, len(by_radius), _KERNELS_AT_ONCE):
            chunk = torch.tensor(by_radius[start : start + _KERNELS_AT_ONCE])
            coc = chunk.sign() * _radius_at(chunk.abs().to(torch.float64))
            batch = bank_of(table).kernels(coc, width, longest=[longest] * len(coc))
            margin = max(0, batch.shape[-1] // 2 - (longest - 1))
            inside = slice(margin, batch.shape[-1] - margin)
            kernels |= {k: kernel[:, inside, inside].clone() for k, kernel in zip(chunk.tolist(), batch, strict=True)}
        return [kernels[key[-1]] for key in keys]

    # the kernels of a table without lengths are the same for images of any width
    key_prefix = (table.fingerprint(), 1 if table.unit == "relative" else width, longest)
    kernels = _kernels.get_all([(*key_prefix, position) for position in positions], make)
    half = max(kernel.shape[-1] for kernel in kernels) // 2
    return torch.stack([functional.pad(kernel, (half - kernel.shape[-1] // 2,) * 4) for kernel in kernels])


def _position_of(radius: Tensor) -> Tensor:
    """Position of a radius in pixels on the scale whose whole numbers are the radii of the kernels."""
    linear = _STEPS_PER_PX * radius.clamp(max=_LINEAR_UP_TO_PX)
    return linear + _STEPS_PER_PX * _LINEAR_UP_TO_PX * (radius / _LINEAR_UP_TO_PX).clamp_min(1.0).log()


def _radius_at(position: Tensor) -> Tensor:
    """Radius in pixels at a position: the inverse of :func:`_position_of`."""
    linear = _STEPS_PER_PX * _LINEAR_UP_TO_PX
    return position.clamp(max=linear) / _STEPS_PER_PX * ((position - linear).clamp_min(0.0) / linear).exp()
