"""Depth of field as a module and as functions: configuration, checks, then one call of the pipeline."""

import contextlib
import os
import threading
import warnings
from collections.abc import Sequence
from typing import Any, Unpack

import torch
from torch import Tensor, nn

from . import validation
from .batch import flattened, leading_axes, numbers, restored
from .optics.blur_table import BlurTable
from .optics.camera import CAMERA_NUMBERS, Camera
from .options import OPTION_NAMES, OptionArguments, Options, read_state, spells_options
from .render import edges, pipeline
from .render.attention import Attention
from .render.ops import EAGER, Ops
from .render.plan import Plan
from .render.resample import at_size_of
from .tensors import is_traced

__all__ = ["DepthOfField", "blur_by_coc", "depth_of_field"]

Number = float | Sequence[float] | Tensor


@spells_options
class DepthOfField(nn.Module):
    """The photograph a real lens would have taken, from an all-in-focus image and its depth.

    Args:
        camera: The camera; its focus and f-number can be overridden in each call.
        table: Blur measured from a lens; None takes the ideal disc.
        **options: As in :class:`torchdof.options.Options`.

    Raises:
        ValueError: If an option is not as described.

    Reference:
        Sato, Dobashi, Yamamoto, section 3; Ikoma et al. 2021 for the composite.

    Example:
        >>> dof = DepthOfField(Camera(focus_m=1.0), BlurTable.disc())
        >>> image, depth = torch.rand(1, 3, 8, 12), torch.full((1, 1, 8, 12), 1.0)
        >>> bool(torch.equal(dof(image, depth), image))
        True
    """

    def __init__(self, camera: Camera, table: BlurTable | None = None, **options: Unpack[OptionArguments]) -> None:
        super().__init__()
        if not isinstance(camera, Camera):
            raise ValueError(f"camera must be a torchdof.Camera, got {type(camera).__name__}")
        self.camera = camera
        self.options = Options.of(table, **options)

    @property
    def options(self) -> Options:
        """The options of the next rendering; each is an attribute of the module too, and may be set."""
        values: Any = {name: getattr(self, name) for name in OPTION_NAMES}
        return Options.of(**values)

    @options.setter
    def options(self, options: Options) -> None:
        for name, value in options.arguments().items():
            setattr(self, name, value)

    def forward(
        self,
        image: Tensor,
        depth: Tensor,
        focus_m: Number | None = None,
        f_number: Number | None = None,
        plan: Plan | None = None,
        background: Tensor | None = None,
        background_depth: Tensor | None = None,
        attention: Attention | None = None,
    ) -> Tensor:
        """Render.

        One image ``[C, H, W]`` and clips ``[B, T, C, H, W]`` are taken as well; all maps then have the image's rank,
        such as a depth of ``[1, H, W]`` or ``[B, T, 1, H, W]``.

        Args:
            image: ``[B, C, H, W]``, linear light, floating point.
            depth: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres along the optical axis, > 0, ``inf`` allowed. A map of
                another size with the same aspect ratio is resampled, guided by the image
                (:func:`torchdof.depth.at_size_of`); a compiled or exported graph takes the image's size only.
            focus_m: Focus distance in metres for this call: a number, or one for each image as a list, ``[B]`` or
                ``[B, 1]`` (of clips ``[B]`` or ``[B, T]``); None takes the camera's.
            f_number: F-number for this call, in the same forms; None takes the camera's.
            plan: Layers to render with, from :meth:`plan`; None plans for this image. Where the image is blurred more
                than the plan reaches, layers are added; compiled code takes a plan as it is.
            background: What is seen where the nearer surfaces of the image are taken away, ``[B, C, H, W]``, where it
                is known; it takes the place of the guess that fills what a blurred foreground uncovers.
            background_depth: Its depth in metres, ``[B, 1, H, W]`` or ``[1, 1, H, W]``; nowhere nearer than the image's
                own, or it counts as that.
            attention: Where the viewer looks: ``(x, y, radius)`` in pixels, or a map ``[B, 1, H, W]`` of 0 to 1. There
                the tolerance is kept; elsewhere a draft's is enough.

        Returns:
            The image's shape and dtype. Differentiable with respect to image, depth, focus and f-number.
            While gradients with respect to the circle of confusion are recorded, the layers stand still (they do not
            follow the scene), so that the picture is a continuous, piecewise linear function of it.

        Raises:
            ValueError: If shapes, types or values are not as described, or a tensor comes from ``torch.vmap``.
        """
        options, axes = self.options, leading_axes(image)
        lens = (numbers(axes, "focus_m", focus_m), numbers(axes, "f_number", f_number))
        image, depth = flattened(axes, "image", image, "C"), flattened(axes, "depth", depth)
        background = flattened(axes, "background", background, "C")
        background_depth = flattened(axes, "background_depth", background_depth)
        coc = self.coc_as_given(image, depth, *lens)
        validation.background(image, background, "background_depth", background_depth, "in metres")
        behind = None
        if background is not None and background_depth is not None:
            behind = self.coc_as_given(background, background_depth, *lens, name="background_depth")
        attention = flattened(axes, "attention", attention)
        return restored(axes, blur(image, coc, options, plan, background, behind, attention))

    def layers(
        self,
        rgba: Tensor,
        depth_m: Tensor,
        focus_m: float | Tensor | None = None,
        f_number: float | Tensor | None = None,
    ) -> Tensor:
        """Render a stack of layers, such as a multi-plane image, in which nothing is hidden.

        Args:
            rgba: ``[B, N, C + 1, H, W]``: light premultiplied with coverage, then coverage in [0, 1], of N layers in
                any order. Where nothing covers a pixel the picture stays transparent.
            depth_m: Their depths in metres, ``[N]``, ``[B, N]`` or a map ``[B, N, 1, H, W]``, > 0, ``inf`` allowed.
            focus_m: As in :meth:`forward`.
            f_number: As in :meth:`forward`.

        Returns:
            ``[B, C + 1, H, W]``: premultiplied light and coverage. Differentiable as :meth:`forward` is.

        Raises:
            ValueError: If shapes, types or values are not as described, or ``occlusion=False``.

        Example:
            >>> dof = DepthOfField(Camera(focus_m=1.0))
            >>> rgba = torch.rand(1, 2, 4, 8, 12)
            >>> dof.layers(rgba, torch.tensor([1.0, 4.0])).shape
            torch.Size([1, 4, 8, 12])
        """
        options = self.options
        depth = validation.stack(rgba, depth_m, options.check)
        batch, count, _, height, width = rgba.shape
        maps = depth.expand(batch, -1, 1, height, width)
        if not options.occlusion:
            raise ValueError("layers hide each other: they need occlusion=True")
        frame = rgba.new_empty(batch, 1, height, width)
        cocs = [self.coc_as_given(frame, layer, focus_m, f_number, name="depth_m") for layer in maps.unbind(1)]
        with _engine(rgba):
            return pipeline.blur_stack(rgba, torch.stack(cocs, 1), options)

    def coc_px(
        self,
        image: Tensor,
        depth: Tensor,
        focus_m: Number | None = None,
        f_number: Number | None = None,
    ) -> Tensor:
        """Signed circle of confusion of the call :meth:`forward` with the same arguments: ``[B, 1, H, W]``, pixels.

        Of one image it is ``[1, H, W]``, of clips ``[B, T, 1, H, W]``.

        Raises:
            ValueError: As :meth:`forward`; so does a lens that blurs beyond what numbers hold.
        """
        axes = leading_axes(image)
        lens = (numbers(axes, "focus_m", focus_m), numbers(axes, "f_number", f_number))
        image, depth = flattened(axes, "image", image, "C"), flattened(axes, "depth", depth)
        coc = self.coc_as_given(image, depth, *lens)
        validation.image_and_map(image, "coc_px", coc, "in pixels")  # as many items as the image, whatever the lens has
        return restored(axes, edges.mended(image, coc, self.options.depth_edges))

    def coc_as_given(
        self,
        image: Tensor,
        depth: Tensor,
        focus_m: float | Tensor | None,
        f_number: float | Tensor | None,
        name: str = "depth",
    ) -> Tensor:
        """The circle of confusion of a depth whose edges are as they are given.

        Args:
            image: ``[B, C, H, W]``.
            depth: ``[B or 1, 1, H, W]``, of the image's size or one that may be resampled to it.
            focus_m: A number or ``[B]``; None takes the camera's.
            f_number: The same.
            name: Of the depth, in messages.
        """
        check = self.options.check
        if not is_traced() and validation.is_resizable(image, depth):
            if stretch := validation.stretch(image, depth):
                warnings.warn(f"{name} is stretched by {stretch:.1%} to the shape of the image", stacklevel=3)
            depth = at_size_of(image, depth)
        validation.image_and_depth(image, depth, values=check, name=name)
        changes = {"focus_m": focus_m, "f_number": f_number}
        camera = self.camera.replace(**{k: v for k, v in changes.items() if v is not None})
        # as a tensor: an exported graph would take Python's arithmetic with the width to be in float32
        width: Any = torch.scalar_tensor(image.shape[-1], dtype=torch.float64, device="cpu")
        coc = camera.coc_px(depth, width)
        if not check:
            return torch.where(depth > 0, coc, torch.nan)
        validation.coc_of_lens(coc, depth, {name: getattr(camera, name) for name in CAMERA_NUMBERS})
        return coc

    def plan(
        self,
        image: Tensor,
        depth: Tensor,
        focus_m: Number | None = None,
        f_number: Number | None = None,
    ) -> Plan:
        """The layers this scene needs; one plan can serve a whole shot. Arguments as in :meth:`forward`.

        Plan for the frame that is blurred most: what other frames need beyond it is added anew in each.

        ``print`` tells which layers there are, of which radius, at which resolution, and which share of the pixels
        each carries.

        Example:
            >>> dof = DepthOfField(Camera(focus_m=1.0, f_number=1.0))
            >>> depth = torch.linspace(1, 9, 96).expand(1, 1, 64, 96)
            >>> print(dof.plan(torch.rand(1, 3, 64, 96), depth))  # doctest: +ELLIPSIS
            7 layers, near to far, tolerance 1/255
              coc px  radius    at  pixels
            ...
        """
        coc = flattened(leading_axes(image), "coc_px", self.coc_px(image, depth, focus_m, f_number))
        return Plan.of_frame(coc, self.options.tolerance).of_pixels(coc)

    def get_extra_state(self) -> dict[str, Any]:
        """Camera, table and options: the whole configuration travels with ``state_dict``."""
        camera = {k: getattr(self.camera, k) for k in Camera.__dataclass_fields__}
        options = self.options
        return {"camera": camera, **options.arguments(), "table": options.table.to_dict()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_extra_state` gave, all of it or nothing.

        Raises:
            ValueError: Naming the field that is missing, unknown or makes no sense.
        """
        self.camera, self.options = read_state(state)

    def extra_repr(self) -> str:
        """Camera, table and options, as ``repr`` shows them."""
        options: dict[str, Any] = {**self.options.arguments()}
        table = options.pop("table")
        return f"{self.camera!r},\n{table!r},\n" + ", ".join(f"{k}={v!r}" for k, v in options.items())


@spells_options
def depth_of_field(
    image: Tensor,
    depth: Tensor,
    camera: Camera,
    *,
    table: BlurTable | None = None,
    focus_m: Number | None = None,
    f_number: Number | None = None,
    plan: Plan | None = None,
    attention: Attention | None = None,
    **options: Unpack[OptionArguments],
) -> Tensor:
    """Functional form of :class:`DepthOfField`.

    Args:
        image: ``[B, C, H, W]``, linear light; also ``[C, H, W]`` or ``[B, T, C, H, W]``.
        depth: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres; of the image's rank.
        camera: The camera.
        table: Blur measured from a lens; None takes the ideal disc.
        focus_m: Overrides the camera's focus distance: a number, or one for each image, as in
            :meth:`DepthOfField.forward`.
        f_number: Overrides the camera's f-number, in the same forms.
        plan: Layers to render with; None plans for this image.
        attention: Where the viewer looks, as in :meth:`DepthOfField.forward`.
        **options: As in :class:`torchdof.options.Options`.

    Returns:
        The image's shape and dtype.

    Raises:
        ValueError: If an argument is not as described, or a tensor comes from ``torch.vmap``.

    Example:
        >>> image, depth = torch.rand(1, 3, 8, 12), torch.full((1, 1, 8, 12), 3.0)
        >>> depth_of_field(image, depth, Camera(focus_m=1.0)).shape
        torch.Size([1, 3, 8, 12])
    """
    return DepthOfField(camera, table, **options)(image, depth, focus_m, f_number, plan, attention=attention)


@spells_options
def blur_by_coc(
    image: Tensor,
    coc_px: Tensor,
    *,
    table: BlurTable | None = None,
    plan: Plan | None = None,
    background: Tensor | None = None,
    background_coc_px: Tensor | None = None,
    attention: Attention | None = None,
    **options: Unpack[OptionArguments],
) -> Tensor:
    """Depth of field for pipelines that hold a map of the circle of confusion already.

    Args:
        image: ``[B, C, H, W]``, linear light; also ``[C, H, W]`` or ``[B, T, C, H, W]``, all maps then of that rank.
        coc_px: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, signed radius in pixels: negative in front of the focus plane,
            NaN where it is unknown and ``check=False``.
        table: Blur measured from a lens; None takes the ideal disc.
        plan: Layers to render with; None plans for this image.
        background: As in :meth:`DepthOfField.forward`.
        background_coc_px: Its signed radius in pixels.
        attention: As in :meth:`DepthOfField.forward`.
        **options: As in :class:`torchdof.options.Options`.

    Returns:
        The image's shape and dtype.

    Raises:
        ValueError: If an argument is not as described, or a tensor comes from ``torch.vmap``.

    Example:
        >>> image = torch.rand(1, 3, 8, 12)
        >>> blur_by_coc(image, torch.linspace(-2, 2, 12).expand(1, 1, 8, 12)).shape
        torch.Size([1, 3, 8, 12])
    """
    axes = leading_axes(image)
    rendered = blur(
        flattened(axes, "image", image, "C"),
        flattened(axes, "coc_px", coc_px),
        Options.of(table, **options),
        plan,
        flattened(axes, "background", background, "C"),
        flattened(axes, "background_coc_px", background_coc_px),
        flattened(axes, "attention", attention),
    )
    return restored(axes, rendered)


def blur(
    image: Tensor,
    coc_px: Tensor,
    options: Options,
    plan: Plan | None,
    background: Tensor | None = None,
    background_coc_px: Tensor | None = None,
    attention: Attention | None = None,
    ops: Ops = EAGER,
) -> Tensor:
    """Check the arguments of a rendering, then render: what all of the names above come to.

    Arguments are those of :func:`blur_by_coc`, of four axes, and the operations that the pipeline is made of.
    """
    channels = options.table.channels
    validation.image_and_coc(image, coc_px, channels, values=options.check)
    _check_plan(plan)
    validation.background(image, background, "background_coc_px", background_coc_px, "in pixels")
    if options.check:
        validation.finite_background(background, background_coc_px)
    hidden = None if background is None or background_coc_px is None else (background, background_coc_px)
    if hidden is not None and not options.occlusion:
        raise ValueError("without occlusion nothing is hidden: a background needs occlusion=True")
    _check_attention(attention, plan, options)
    with _engine(image):
        return pipeline.blur(image, coc_px, plan, options, hidden, attention, ops)


def _engine(light: Tensor) -> contextlib.AbstractContextManager[Any]:
    """What the pipeline runs in: with autocast off, for it would convolve in half precision."""
    if not is_traced():
        _has_rendered.set()
    device = light.device.type
    return torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else contextlib.nullcontext()


_has_rendered = threading.Event()


def _after_fork() -> None:
    """In a forked child: PyTorch's threads (OpenMP) do not outlive a fork, and waiting for them would last for ever."""
    if _has_rendered.is_set() and torch.get_num_threads() > 1:
        torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def _check_plan(plan: Plan | None) -> None:
    """Refuse what is not a plan."""
    if plan is not None and not isinstance(plan, Plan):
        raise ValueError(
            f"plan must be a Plan, as DepthOfField.plan(image, depth) gives, or None, got {validation.show(plan)}; "
            "leave it out to plan for this image"
        )


def _check_attention(attention: Attention | None, plan: Plan | None, options: Options) -> None:
    """Refuse attention where it cannot be paid: beside a plan, which holds one tolerance, and where code is traced."""
    if attention is None:
        return
    if plan is not None:
        raise ValueError("attention plans for two tolerances; leave plan out, or attention")
    if is_traced():
        raise ValueError("attention chooses its work by where the viewer looks; a compiled or exported graph cannot")
