"""Depth of field as a module and as functions: the chain of the other rooms and nothing else."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from . import background, composite, highlights, layers
from . import check as checks
from .camera import Camera
from .check import Border, Method, Options
from .frame import Frame, Sample
from .loop import side, tile_by_tile
from .plan import Blur, Plan
from .spread import layers_by_conv, layers_by_fold
from .table import BlurTable

__all__ = ["DepthOfField", "blur_by_coc", "depth_of_field"]


class DepthOfField(nn.Module):
    """The photograph a real lens would have taken, from an all-in-focus image and its depth.

    Args:
        camera: The camera; its focus and f-number can be overridden in each call.
        table: Blur measured from a lens; None takes the ideal disc.
        tolerance: Accepted RMS difference, display-encoded, from the same rendering with exact kernels, dense layers
            and full resolution. 0 asks for that rendering itself.
        occlusion: True composites layers far to near, so that blurred foregrounds cover what is behind and sharp ones
            are not bled upon. False is the paper's own algorithm: every pixel's light accumulates.
        normalize: With ``occlusion=False`` only: False leaves the plain sum that the paper accumulates.
        method: ``"layered"`` spreads layers by convolution (fast); ``"fold"`` by the paper's literal scatter.
        border: ``"normalize"`` counts only light that was seen: what is outside the frame is unknown and weighs
            nothing. ``"extend"`` continues the light at the frame's border outwards, as if it were known.
        max_coc_px: Largest radius that a static plan (compiled, exported) covers; larger ones are rendered with it.
        check: Look for NaN and non-positive depths and non-finite light before rendering, and refuse them. False skips
            that (and its cost); a pixel with a bad depth then passes through sharp and touches nothing else.

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

    def __init__(
        self,
        camera: Camera,
        table: BlurTable | None = None,
        tolerance: float = 1 / 255,
        occlusion: bool = True,
        normalize: bool = True,
        method: Method = "layered",
        border: Border = "normalize",
        max_coc_px: float = 64.0,
        check: bool = True,
    ) -> None:
        super().__init__()
        if not isinstance(camera, Camera):
            raise ValueError(f"camera must be a torchdof.Camera, got {type(camera).__name__}")
        table = BlurTable.disc() if table is None else table
        Options(table, tolerance, occlusion, normalize, method, border, max_coc_px, check)  # says what is wrong
        self.camera, self.table = camera, table
        self.tolerance, self.occlusion, self.normalize = float(tolerance), bool(occlusion), bool(normalize)
        self.method, self.border, self.max_coc_px, self.check = method, border, float(max_coc_px), bool(check)

    def forward(
        self,
        image: Tensor,
        depth: Tensor,
        focus_m: float | Tensor | None = None,
        f_number: float | Tensor | None = None,
        plan: Plan | None = None,
    ) -> Tensor:
        """Render.

        Args:
            image: ``[B, C, H, W]``, linear light, floating point.
            depth: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres along the optical axis, > 0, ``inf`` allowed.
            focus_m: Focus distance in metres for this call, float or ``[B]``; None takes the camera's.
            f_number: F-number for this call, float or ``[B]``; None takes the camera's.
            plan: Layers to render with, from :meth:`plan`; None plans for this image.

        Returns:
            ``[B, C, H, W]`` in the image's dtype. Differentiable with respect to image, depth, focus and f-number.
            While gradients with respect to the circle of confusion are recorded, the layers stand still (they do not
            follow the scene), so that the picture is a continuous, piecewise linear function of it.

        Raises:
            ValueError: If shapes, types or values are not as described.
        """
        return blur_by_coc(image, self.coc_px(image, depth, focus_m, f_number), plan=plan, **self._options())

    def coc_px(
        self,
        image: Tensor,
        depth: Tensor,
        focus_m: float | Tensor | None = None,
        f_number: float | Tensor | None = None,
    ) -> Tensor:
        """Signed circle of confusion of the call :meth:`forward` with the same arguments: ``[B, 1, H, W]``, pixels."""
        checks.image_and_depth(image, depth, values=self.check)
        changes = {"focus_m": focus_m, "f_number": f_number}
        camera = self.camera.replace(**{k: v for k, v in changes.items() if v is not None})
        # as a tensor: an exported graph would take Python's arithmetic with the width to be in float32
        width: Any = torch.scalar_tensor(image.shape[-1], dtype=torch.float64)
        coc = camera.coc_px(depth, width)
        return coc if self.check else torch.where(depth > 0, coc, torch.nan)

    def plan(
        self,
        image: Tensor,
        depth: Tensor,
        focus_m: float | Tensor | None = None,
        f_number: float | Tensor | None = None,
    ) -> Plan:
        """The layers this scene needs; one plan can serve a whole shot. Arguments as in :meth:`forward`."""
        coc = self.coc_px(image, depth, focus_m, f_number)
        return Plan.of_scene(coc, self.tolerance)

    def get_extra_state(self) -> dict[str, Any]:
        """Camera, table and options: the whole configuration travels with ``state_dict``."""
        camera = {k: getattr(self.camera, k) for k in Camera.__dataclass_fields__}
        return {"camera": camera, "table": self.table.to_dict(), **self._options(table=False)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_extra_state` gave."""
        state = dict(state)
        self.camera, self.table = Camera(**state.pop("camera")), BlurTable.from_dict(state.pop("table"))
        for name, value in state.items():
            setattr(self, name, value)

    def extra_repr(self) -> str:
        """Camera, table and options, as ``repr`` shows them."""
        options = ", ".join(f"{k}={v!r}" for k, v in self._options(table=False).items())
        return f"{self.camera!r},\n{self.table!r},\n{options}"

    def _options(self, table: bool = True) -> dict[str, Any]:
        names = ("table", "tolerance", "occlusion", "normalize", "method", "border", "max_coc_px", "check")
        return {name: getattr(self, name) for name in names[0 if table else 1 :]}


def depth_of_field(
    image: Tensor,
    depth: Tensor,
    camera: Camera,
    *,
    table: BlurTable | None = None,
    focus_m: float | Tensor | None = None,
    f_number: float | Tensor | None = None,
    plan: Plan | None = None,
    **options: Any,
) -> Tensor:
    """Functional form of :class:`DepthOfField`; the options are those of its constructor.

    Args:
        image: ``[B, C, H, W]``, linear light.
        depth: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres.
        camera: The camera.
        table: Blur measured from a lens; None takes the ideal disc.
        focus_m: Overrides the camera's focus distance, float or ``[B]``.
        f_number: Overrides the camera's f-number, float or ``[B]``.
        plan: Layers to render with; None plans for this image.
        **options: Of :class:`DepthOfField`.

    Returns:
        ``[B, C, H, W]`` in the image's dtype.

    Raises:
        ValueError: If an argument is not as described.

    Example:
        >>> image, depth = torch.rand(1, 3, 8, 12), torch.full((1, 1, 8, 12), 3.0)
        >>> depth_of_field(image, depth, Camera(focus_m=1.0)).shape
        torch.Size([1, 3, 8, 12])
    """
    return DepthOfField(camera, table, **options)(image, depth, focus_m, f_number, plan)


def blur_by_coc(
    image: Tensor,
    coc_px: Tensor,
    *,
    table: BlurTable | None = None,
    tolerance: float = 1 / 255,
    occlusion: bool = True,
    normalize: bool = True,
    method: Method = "layered",
    border: Border = "normalize",
    max_coc_px: float = 64.0,
    check: bool = True,
    plan: Plan | None = None,
) -> Tensor:
    """Depth of field for pipelines that hold a map of the circle of confusion already.

    Args:
        image: ``[B, C, H, W]``, linear light.
        coc_px: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, signed radius in pixels: negative in front of the focus plane.
        table: Blur measured from a lens; None takes the ideal disc.
        tolerance: As in :class:`DepthOfField`.
        occlusion: As in :class:`DepthOfField`.
        normalize: As in :class:`DepthOfField`.
        method: As in :class:`DepthOfField`.
        border: As in :class:`DepthOfField`.
        max_coc_px: As in :class:`DepthOfField`.
        check: As in :class:`DepthOfField`; a bad coc is NaN.
        plan: Layers to render with; None plans for this image.

    Returns:
        ``[B, C, H, W]`` in the image's dtype.

    Raises:
        ValueError: If an argument is not as described.

    Example:
        >>> image = torch.rand(1, 3, 8, 12)
        >>> blur_by_coc(image, torch.linspace(-2, 2, 12).expand(1, 1, 8, 12)).shape
        torch.Size([1, 3, 8, 12])
    """
    table = BlurTable.disc() if table is None else table
    options = Options(table, tolerance, occlusion, normalize, method, border, max_coc_px, check)
    checks.image_and_coc(image, coc_px, table, values=check)
    if torch.is_autocast_enabled(image.device.type):  # it would run the convolutions in half precision
        with torch.autocast(image.device.type, enabled=False):
            return _blur(image, coc_px, plan, options)
    return _blur(image, coc_px, plan, options)


def _blur(image: Tensor, coc_px: Tensor, plan: Plan | None, options: Options) -> Tensor:
    wide = torch.float64 if torch.float64 in (image.dtype, coc_px.dtype) else torch.float32
    light, coc = image.to(wide), coc_px.to(wide).expand(image.shape[0], -1, -1, -1)
    if plan is None and _traced():
        plan = Plan.all(options.max_coc_px, options.tolerance)
    elif plan is None and torch.is_grad_enabled() and coc_px.requires_grad:
        plan = Plan.still(coc, options.tolerance)
    if plan is not None:
        return _render(light, coc, plan, options).to(image.dtype)
    # each item has its own layers, as it would have alone
    pairs = zip(light.split(1), coc.split(1), strict=True)
    items = [_render(one, its_coc, Plan.of_scene(its_coc, options.tolerance), options) for one, its_coc in pairs]
    return (items[0] if len(items) == 1 else torch.cat(items)).to(image.dtype)


def _render(light: Tensor, coc: Tensor, plan: Plan, options: Options) -> Tensor:
    if plan.nodes == (0.0,):
        # in focus: nothing changes, but whoever asks for the gradient of the coc is told that it is 0
        return light + 0.0 * torch.nan_to_num(coc) if torch.is_grad_enabled() and coc.requires_grad else light.clone()
    image, valid = light, None
    if not options.check:
        valid = torch.isfinite(coc) & torch.isfinite(light).all(1, keepdim=True)
        coc, light = torch.where(valid, coc, 0.0), torch.where(valid, light, 0.0)
    coc = coc.clamp(plan.coc_px[0], plan.coc_px[-1])  # beyond, blurs are alike; differences of huge ones would cancel
    weight = None if valid is None else valid.to(light.dtype)
    layered = options.method == "layered"
    blurs = plan.blurs(options.table, (light.shape[-2], light.shape[-1]), light.dtype, light.device, coarse=layered)
    surfaces = [(light, coc, weight)]
    if options.occlusion and len(plan.nodes) > 1:
        levels = math.ceil(math.log2(max(1.0, *(abs(c) for c in plan.coc_px)))) + 1
        own, seen, other, other_coc, share = background.surfaces(light, coc, weight, min(levels, 7))
        surfaces = [(own, coc, seen), (other, other_coc, share)]
    rays = []
    if options.occlusion and plan.rays and len(plan.nodes) > 1:
        limit = highlights.ordinary(light, valid)
        for i, (colour, c, w) in enumerate(surfaces):
            left, some = highlights.take(colour, c, w, limit, coc, plan.crisp_px if layered else math.inf)
            surfaces[i] = (left, c, w)
            rays += [] if some is None else [some]
    first, last = plan.nodes[0], plan.nodes[-1]
    samples = [Sample(colour, layers.blur_axis(c).clamp(first, last), w) for colour, c, w in surfaces]
    moves = torch.is_grad_enabled() and (light.requires_grad or coc.requires_grad)
    exporting = torch.compiler.is_exporting()
    margin, align = max(blur.halo for blur in blurs), max(blur.scale for blur in blurs)
    frame = Frame(
        samples,
        margin=margin,
        align=side(margin) if exporting else align,
        tiled=layered and not _traced() and not moves and light.shape[0] == 1,
        extend=options.border == "extend",
    )

    def rendered(frame: Frame, blurs: list[Blur]) -> Tensor:
        if options.occlusion:
            return composite.over(frame, plan, blurs, layers_by_conv if layered else layers_by_fold)
        if not layered:
            return composite.accumulate_once(frame, plan, blurs, options.normalize)
        return composite.accumulate(frame, plan, blurs, layers_by_conv, options.normalize)

    out = tile_by_tile(frame, blurs, rendered) if exporting else rendered(frame, blurs)
    if rays:
        out = out + highlights.trace(rays, coc, options.table, light.shape[1])
    return out if valid is None else torch.where(valid, out, image)


def _traced() -> bool:
    return torch.compiler.is_compiling() or torch.compiler.is_exporting()
