"""Depth of field as a module and as functions: they check their arguments and call the pipeline."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from typing_extensions import Unpack

from . import validation
from .batch import flattened, leading_axes, numbers, restored
from .optics.blur_table import BlurTable
from .optics.camera import Camera
from .options import OPTION_NAMES, OptionArguments, Options, from_config, spells_options, to_config
from .render import pipeline, routes
from .render.attention import Attention
from .render.engines.one_thread import on_one_thread
from .render.engines.ops import EAGER, Ops
from .render.layers.plan import Plan
from .render.surfaces import edges
from .render.surfaces.resample import at_size_of
from .tensors import is_traced, refuse_old_compiler, without_autocast

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
        self.options = Options(table, **options)  # type: ignore[arg-type]

    @property
    def options(self) -> Options:
        """The options of the next rendering; each is also an attribute of the module, which may be set."""
        values: Any = {name: getattr(self, name) for name in OPTION_NAMES}
        return Options(**values)

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
        matte: Tensor | None = None,
    ) -> Tensor:
        """Render a batch of images.

        A single image ``[C, H, W]`` and clips ``[B, T, C, H, W]`` are accepted too. All maps then have the image's
        rank: a depth is ``[1, H, W]`` or ``[B, T, 1, H, W]``.

        Args:
            image: ``[B, C, H, W]``, linear light, floating point.
            depth: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres along the optical axis, > 0, ``inf`` allowed. A map of
                another size is resampled, guided by the image (:func:`torchdof.depth.at_size_of`); a compiled or
                exported graph takes only the image's size.
            focus_m: Focus distance in metres for this call: a number, or one for each image as a list, ``[B]`` or
                ``[B, 1]`` (for clips ``[B]`` or ``[B, T]``); None uses the camera's.
            f_number: F-number for this call, in the same forms; None uses the camera's.
            plan: Layers to render with, from :meth:`plan`; None plans for this image. Layers are added if the image has
                larger radii than the plan; compiled code uses a plan unchanged.
            background: Image ``[B, C, H, W]`` of the scene behind the nearer surfaces, if it is known. It replaces the
                estimate that fills the areas uncovered by a blurred foreground.
            background_depth: Its depth in metres, ``[B, 1, H, W]`` or ``[1, 1, H, W]``; values nearer than ``depth``
                are replaced by it.
            attention: Where the viewer looks: ``(x, y, radius)`` in pixels, or a map ``[B, 1, H, W]`` in [0, 1]. There
                the tolerance applies; elsewhere that of ``"draft"``.
            matte: Coverage of each pixel by a subject, ``[B, 1, H, W]`` or ``[1, 1, H, W]`` in [0, 1], such as the
                mask of a person. Where its edges are within a few pixels of an edge of the depth, it decides which
                surface a pixel shows and how much of it; elsewhere it changes nothing. The subject need not be the
                nearest surface.

        Returns:
            The image's shape and dtype. Differentiable with respect to image, depth, focus, f-number and matte.
            While gradients with respect to the circle of confusion are recorded, the layers are fixed instead of
            following the scene, so that the picture is a continuous, piecewise linear function of it.

        Raises:
            ValueError: If shapes, types or values are not as described, or a tensor comes from ``torch.vmap``.
        """
        refuse_old_compiler()
        options, axes = self.options, leading_axes(image)
        lens = (numbers(axes, "focus_m", focus_m), numbers(axes, "f_number", f_number))
        image, depth, background, background_depth, attention, matte = flattened(
            axes,
            image=image,
            depth=depth,
            background=background,
            background_depth=background_depth,
            attention=attention,
            matte=matte,
        )
        depth, channels = self._sized(image, depth), options.table.channels
        validation.scene(image, "depth", depth, background, background_depth, channels=channels, values=options.check)
        coc, behind = self._coc(depth, image, *lens, options.check), None
        if background is not None and background_depth is not None:
            behind = (background, self._coc(background_depth, image, *lens, options.check))
        return restored(axes, render(image, coc, options, plan, behind, attention, matte=matte))

    def layers(
        self,
        rgba: Tensor,
        depth_m: Tensor,
        focus_m: float | Tensor | None = None,
        f_number: float | Tensor | None = None,
    ) -> Tensor:
        """Render a stack of complete layers, such as a multi-plane image.

        Args:
            rgba: ``[B, N, C + 1, H, W]``: N layers in any order; light premultiplied by coverage, then coverage in
                [0, 1]. Pixels that no layer covers stay transparent.
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
        routes.refuse(options, "stack")
        validation.real_tensor("rgba", rgba, "[B, N, C + 1, H, W]")
        validation.real_tensor("depth_m", depth_m, "in metres")
        if rgba.ndim != 5 or rgba.shape[2] < 2 or 0 in rgba.shape:
            raise ValueError(f"rgba must be [B, N, C + 1, H, W], premultiplied, got {list(rgba.shape)}")
        batch, count, _, height, width = rgba.shape
        maps = depth_m[..., None, None, None] if depth_m.ndim in (1, 2) else depth_m
        try:
            maps = maps.expand(batch, count, 1, height, width)
        except RuntimeError:
            expected = f"[{count}], [{batch}, {count}] or [{batch}, {count}, 1, {height}, {width}]"
            raise ValueError(f"depth_m must be {expected} in metres, got {list(depth_m.shape)}") from None
        if options.check:
            validation.finite("rgba", rgba)
            cover = rgba[:, :, -1]
            if not validation.holds(cover, lambda low, high: 0.0 <= low <= high <= 1.0):
                low, high = validation.ends(cover)
                raise ValueError(f"coverage, the last channel of rgba, must lie in [0, 1], got {low:g} to {high:g}")
        frame = rgba.new_empty(batch, 1, height, width)
        cocs = [self.coc_as_given(frame, layer, focus_m, f_number, name="depth_m") for layer in maps.unbind(1)]
        with without_autocast(rgba.device.type):
            return pipeline.blur_stack(rgba, torch.stack(cocs, 1), options)

    def coc_px(
        self, image: Tensor, depth: Tensor, focus_m: Number | None = None, f_number: Number | None = None
    ) -> Tensor:
        """Signed circle of confusion that :meth:`forward` uses without a matte: ``[B, 1, H, W]``, pixels.

        For one image it is ``[1, H, W]``, for clips ``[B, T, 1, H, W]``.

        Raises:
            ValueError: As :meth:`forward`; also if the circle of confusion is not finite.
        """
        axes = leading_axes(image)
        lens = (numbers(axes, "focus_m", focus_m), numbers(axes, "f_number", f_number))
        image, depth = flattened(axes, image=image, depth=depth)
        coc = self.coc_as_given(image, depth, *lens)
        validation.image_and_map(image, "coc_px", coc, "in pixels")  # a lens of another batch size changes its shape
        return restored(axes, edges.mended(image, coc, self.options.depth_edges))

    def coc_as_given(
        self,
        image: Tensor,
        depth: Tensor,
        focus_m: float | Tensor | None,
        f_number: float | Tensor | None,
        name: str = "depth",
    ) -> Tensor:
        """The circle of confusion of a depth map without repair of its edges, for images ``[B, C, H, W]``.

        The depth ``[B or 1, 1, H, W]`` may have a size that can be resampled to the image's.
        """
        depth, check = self._sized(image, depth), self.options.check
        validation.image_and_depth(image, depth, values=check, name=name)
        return self._coc(depth, image, focus_m, f_number, check)

    def _sized(self, image: Tensor, depth: Tensor) -> Tensor:
        """A depth map resampled to the size of its image, if it has another one that fits; unchecked."""
        is_sized = is_traced() or validation.stretch(image, depth) is None or image.shape[-2:] == depth.shape[-2:]
        return depth if is_sized else at_size_of(image, depth)

    def _coc(
        self,
        depth: Tensor,
        image: Tensor,
        focus_m: float | Tensor | None,
        f_number: float | Tensor | None,
        check: bool,
    ) -> Tensor:
        """The circle of confusion of a checked depth map of an image; finite, or with ``check=False`` NaN at holes."""
        changes = {"focus_m": focus_m, "f_number": f_number}
        camera = self.camera.replace(**{k: v for k, v in changes.items() if v is not None})
        camera.refuse_other_batch(image.shape[0])
        # a tensor, because an exported graph would do Python's arithmetic with the width in float32
        width: Any = torch.scalar_tensor(image.shape[-1], dtype=torch.float64, device="cpu")
        coc = camera.coc_px(depth, width)
        if not check:
            return torch.where(depth > 0, coc, torch.nan)
        camera.refuse_overflow(coc, depth)
        return coc

    def plan(self, image: Tensor, depth: Tensor, focus_m: Number | None = None, f_number: Number | None = None) -> Plan:
        """The layers for a scene; one plan can be used for a whole shot. Arguments as in :meth:`forward`.

        Plan for the frame with the largest blur: a frame with larger radii adds layers in every call.

        ``print`` shows the layers: radius, resolution, and the share of the pixels in each.

        Example:
            >>> dof = DepthOfField(Camera(focus_m=1.0, f_number=1.0))
            >>> depth = torch.linspace(1, 9, 96).expand(1, 1, 64, 96)
            >>> print(dof.plan(torch.rand(1, 3, 64, 96), depth))  # doctest: +ELLIPSIS
            7 layers, near to far, tolerance 1/255
              coc px  radius    at  pixels
            ...
        """
        (coc,) = flattened(leading_axes(image), coc_px=self.coc_px(image, depth, focus_m, f_number))
        return Plan.for_scene(coc, self.options.tolerance).with_pixels(coc)

    def to_dict(self) -> dict[str, Any]:
        """The configuration, camera, table and options, as plain JSON types: the inverse of :meth:`from_dict`.

        A module without parameters has an empty ``state_dict``; the configuration belongs beside a checkpoint.

        Example:
            >>> import json
            >>> config = json.dumps(DepthOfField(Camera(focus_m=1.5), BlurTable.gaussian()).to_dict())
            >>> DepthOfField.from_dict(json.loads(config)).camera
            Camera(50 mm, f/2.8, focus 1.5 m, sensor 36 mm)
        """
        return to_config(self.camera, self.options)

    @classmethod
    def from_dict(cls, config: Any) -> "DepthOfField":
        """Build a module from :meth:`to_dict`'s data; options and numbers of the camera that are missing are defaults.

        Raises:
            ValueError: If a field is unknown or wrong; the message names it.
        """
        camera, options = from_config(config)
        return cls(camera, **options.arguments())

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *arguments: Any) -> None:
        """As PyTorch's; the configuration that checkpoints of earlier versions have is left out, not an error."""
        state_dict.pop(f"{prefix}_extra_state", None)
        super()._load_from_state_dict(state_dict, prefix, *arguments)

    def extra_repr(self) -> str:
        """Camera, table and options, as ``repr`` shows them."""
        options = self.options.arguments()
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
    matte: Tensor | None = None,
    **options: Unpack[OptionArguments],
) -> Tensor:
    """Functional form of :class:`DepthOfField`, whose arguments and those of :meth:`DepthOfField.forward` it takes.

    Args:
        image: ``[B, C, H, W]``, linear light; also ``[C, H, W]`` or ``[B, T, C, H, W]``.
        depth: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres; of the image's rank.
        camera: The camera.
        table: Blur measured from a lens; None takes the ideal disc.
        focus_m: Overrides the camera's focus distance.
        f_number: Overrides the camera's f-number.
        plan: Layers to render with; None plans for this image.
        attention: Where the viewer looks.
        matte: Coverage by a subject, as in :meth:`DepthOfField.forward`.
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
    refuse_old_compiler()
    return DepthOfField(camera, table, **options)(
        image, depth, focus_m, f_number, plan, attention=attention, matte=matte
    )


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
    matte: Tensor | None = None,
    **options: Unpack[OptionArguments],
) -> Tensor:
    """Depth of field from a map of the circle of confusion.

    Args:
        image: ``[B, C, H, W]``, linear light; also ``[C, H, W]`` or ``[B, T, C, H, W]``, all maps then of that rank.
        coc_px: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, signed radius in pixels: negative in front of the focus plane.
            With ``check=False`` it may be NaN where it is unknown.
        table: Blur measured from a lens; None takes the ideal disc.
        plan: Layers to render with; None plans for this image.
        background: As in :meth:`DepthOfField.forward`.
        background_coc_px: Its signed radius in pixels.
        attention: As in :meth:`DepthOfField.forward`.
        matte: As in :meth:`DepthOfField.forward`.
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
    refuse_old_compiler()
    axes, hidden_coc = leading_axes(image), background_coc_px
    image, coc_px, background, hidden_coc, attention, matte = flattened(
        axes,
        image=image,
        coc_px=coc_px,
        background=background,
        background_coc_px=hidden_coc,
        attention=attention,
        matte=matte,
    )
    given = Options(table, **options)  # type: ignore[arg-type]
    validation.scene(image, "coc_px", coc_px, background, hidden_coc, channels=given.table.channels, values=given.check)
    behind = None if background is None or hidden_coc is None else (background, hidden_coc)
    return restored(axes, render(image, coc_px, given, plan, behind, attention, matte=matte))


def render(
    image: Tensor,
    coc_px: Tensor,
    options: Options,
    plan: Plan | None,
    behind: tuple[Tensor, Tensor] | None = None,
    attention: Attention | None = None,
    ops: Ops = EAGER,
    matte: Tensor | None = None,
) -> Tensor:
    """Call the pipeline with a checked scene and a matte, if an engine renders them; all functions above end here.

    Arguments as in :func:`blur_by_coc`, with four axes; ``behind`` is the background and its circle of confusion, and
    ``ops`` are the operations (an exported graph has its own).
    """
    if plan is not None and not isinstance(plan, Plan):
        got = validation.show(plan)
        raise ValueError(f"plan must be a Plan from DepthOfField.plan(image, depth), or left out, got {got}")
    has_matte = matte is not None
    has_plan, has_background = plan is not None, behind is not None
    routes.refuse(options, background=has_background, attention=attention is not None, plan=has_plan, matte=has_matte)
    if matte is not None:
        validation.coverage(image, matte, values=options.check)

    def rendered(image: Tensor, coc_px: Tensor, *others: Tensor) -> Tensor:
        hidden = others[has_matte:]
        behind, matte = (hidden[0], hidden[1]) if hidden else None, others[0] if has_matte else None
        with without_autocast(image.device.type):  # it would convolve in half precision
            return pipeline.blur(image, coc_px, plan, options, behind, attention, ops, matte)

    tensors = (image, coc_px, *(() if matte is None else (matte,)), *(behind or ()))
    has_others = options.table.is_differentiated or isinstance(attention, Tensor)
    return rendered(*tensors) if has_others else on_one_thread(rendered, *tensors)
