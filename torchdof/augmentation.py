"""Random depth of field as a Kornia augmentation, with Kornia's parameters, containers and repeated calls.

``RandomDepthOfField`` works in Kornia's ``ImageSequential`` and ``AugmentationSequential`` with the depth as the last
channel of the image, in ``DepthAugmentationSequential`` with the depth as a mask, resampled as masks are, and in
``torchvision.transforms.v2.Compose`` with samples that are dicts.
"""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from kornia.augmentation import AugmentationSequential, IntensityAugmentationBase2D
from kornia.augmentation import random_generator as rg
from kornia.augmentation.container.ops import AugmentationSequentialOps
from kornia.augmentation.container.params import ParamItem
from kornia.constants import DataKey
from torch import Tensor, nn
from typing_extensions import Unpack

from .io.transfer import Transfer, decode, encode
from .module import DepthOfField, depth_of_field
from .optics.blur_table import BlurTable
from .optics.camera import Camera
from .options import OptionArguments, Options, spells_options
from .tensors import floating
from .validation import choice, image_and_map, number, real_tensor, show, whole

__all__ = ["DepthAugmentationSequential", "RandomDepthOfField"]

_ENCODED_RANGE = (-0.5, 1.5)  # accepted values of encoded images: [0, 1], and the overshoot of earlier resampling
_IMAGE_NAMES = ("image", "input", "img")


@functools.partial(spells_options, check=False)
class RandomDepthOfField(IntensityAugmentationBase2D):
    """Blurs images by their depth with a random focus, f-number and lens.

    Focus is drawn uniformly in dioptres (1 / metres), in which blur is linear, and the f-number uniformly in stops,
    each of which halves the light. Both, and the lens, are kept in ``_params``;
    ``aug(image, depth, params=aug._params)`` repeats them. Images that ``p`` leaves out are returned unchanged, and
    cost nothing.

    The depth comes in one of three ways: as the second argument, as the last channel of an image of two or four
    channels (which is returned with it, unchanged), or under the key ``"depth"`` of a dict. The coverage by a subject,
    in [0, 1], is the argument ``matte``, or the key ``"matte"``; it decides where hair ends, as in
    :meth:`torchdof.DepthOfField.forward`, and needs occlusion.

    Where the depth is not > 0, for example in the corners after a rotation, pixels stay sharp, because ``check`` is
    False by default. A crop narrows the field of view, as a smaller ``sensor_width_mm`` does: ``camera`` must describe
    the cropped image.

    Args:
        focus_m: Nearest and farthest focus distance in metres, > 0, ``inf`` allowed.
        f_number: Smallest and largest f-number, > 0.
        camera: Focal length, sensor width and focus breathing; its own focus and f-number are not used.
        table: Blur of a lens, or several, of which one is drawn for each image; None takes the ideal disc.
        transfer: Encoding of the images: ``"srgb"``, as in files and data sets (in [0, 1]; normalise after this
            step), or ``"linear"`` light.
        same_on_batch: Draw once for the whole batch.
        p: Probability that an image is blurred.
        keepdim: Return one image ``[C, H, W]`` as such, not as a batch of one.
        return_label: Also return the result of :meth:`label`: ``(images, label)``, or its entries in a dict. Kornia's
            containers pass on images alone; call :meth:`label` after them.
        **options: As in :class:`torchdof.options.Options`.

    Raises:
        ValueError: If an argument is not as described.

    Example:
        >>> aug = RandomDepthOfField(focus_m=(0.5, 5.0), f_number=(1.4, 8.0), p=1.0)
        >>> image, depth = torch.rand(2, 3, 8, 12), 1 + torch.rand(2, 1, 8, 12)
        >>> blurred = aug(image, depth)
        >>> torch.equal(blurred, aug(image, depth, params=aug._params))
        True
        >>> label = aug.label(image, depth)
        >>> label["coc_px"].shape, label["focus_m"].shape
        (torch.Size([2, 1, 8, 12]), torch.Size([2]))
    """

    def __init__(
        self,
        focus_m: tuple[float, float] = (0.5, 5.0),
        f_number: tuple[float, float] = (1.4, 8.0),
        camera: Camera | None = None,
        table: BlurTable | Sequence[BlurTable] | None = None,
        transfer: Transfer = "srgb",
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
        return_label: bool = False,
        **options: Unpack[OptionArguments],
    ) -> None:
        if isinstance(p, bool) or not isinstance(p, int | float) or not 0.0 <= p <= 1.0:
            raise ValueError(f"p must be a probability from 0 to 1, got {show(p)}")
        super().__init__(p=p, same_on_batch=same_on_batch, keepdim=keepdim)
        near_m, far_m = _range("focus_m", focus_m, math.inf)
        smallest_f, largest_f = _range("f_number", f_number, 1e300)
        self.camera = Camera() if camera is None else camera
        if not isinstance(self.camera, Camera):
            raise ValueError(f"camera must be a torchdof.Camera, got {show(camera)}")
        self.camera.replace(focus_m=near_m, f_number=smallest_f)
        tables = [*table] if isinstance(table, Sequence) and not isinstance(table, str) else [table]
        if not tables:
            raise ValueError("table must be a torchdof.BlurTable, several, or None, got an empty list")
        choice("transfer", transfer, ("linear", "srgb"))
        if not isinstance(return_label, bool):
            raise ValueError(f"return_label must be True or False, got {show(return_label)}")
        self.return_label = return_label
        options.setdefault("check", False)  # as the signature shows
        self.focus_m, self.f_number = (near_m, far_m), (smallest_f, largest_f)
        self.renderings = [Options(table, **options) for table in tables]  # type: ignore[arg-type]
        self.flags = {"transfer": transfer}
        self._ranges = (
            ((1.0 / far_m, 1.0 / near_m), "focus", None, None),  # dioptres
            ((2 * math.log2(smallest_f), 2 * math.log2(largest_f)), "f_number", None, None),  # stops
            ((0.0, float(len(tables))), "table", None, None),
        )
        self._param_generator = rg.PlainUniformGenerator(*self._ranges)

    def generate_parameters(self, batch_shape: tuple[int, ...]) -> dict[str, Tensor]:
        """Draw ``focus_m`` in metres, ``f_number`` and ``table`` (index of a table), each ``[B]``."""
        return self._in_units(super().generate_parameters(batch_shape))

    def forward_parameters(self, batch_shape: tuple[int, ...]) -> dict[str, Tensor]:
        """Draw parameters for every image, and which are blurred; Kornia 0.8 would draw for the blurred ones alone."""
        is_blurred = self.__batch_prob_generator__(batch_shape, self.p, self.p_batch, self.same_on_batch)
        shape = torch.tensor(batch_shape, dtype=torch.long)
        return {**self.generate_parameters(batch_shape), "batch_prob": is_blurred, "forward_input_shape": shape}

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw the parameters of one image, each ``[1]``, from ``generator``; the global generator is not used."""
        if not isinstance(generator, torch.Generator):
            raise ValueError(f"generator must be a torch.Generator, got {show(generator)}")
        ranges = {name: low_and_high for low_and_high, name, _, _ in self._ranges}
        uniform = functools.partial(torch.rand, 1, generator=generator, device=generator.device)
        return self._in_units({name: low + (high - low) * uniform() for name, (low, high) in ranges.items()})

    def _in_units(self, drawn: dict[str, Tensor]) -> dict[str, Tensor]:
        """Convert the uniformly drawn numbers to metres, f-numbers and indices of tables."""
        return {
            "focus_m": (1.0 / drawn["focus"]).clamp(*self.focus_m),
            "f_number": torch.exp2(drawn["f_number"] / 2).clamp(*self.f_number),
            "table": drawn["table"].long().clamp_max(len(self.renderings) - 1),
        }

    def __repr__(self) -> str:
        names = ("focus_m", "f_number", "camera", "same_on_batch", "p", "keepdim", "return_label")
        tables = [rendering.table for rendering in self.renderings]
        table = tables if len(tables) > 1 else tables[0]
        shown = {name: getattr(self, name) for name in names}
        shown |= {**self.flags, **self.renderings[0].arguments(), "table": table}
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in shown.items())})"

    def __call__(self, input: Any, *arguments: Any, **kwargs: Any) -> Any:
        """Kornia's call, which converts images; skipped for dicts and labels, which Kornia would take for images."""
        if isinstance(input, list | tuple):
            kind = type(input).__name__
            raise ValueError(f"RandomDepthOfField takes a dict, or image and depth as two arguments, got a {kind}")
        if isinstance(input, Mapping) or self.return_label:
            return nn.Module.__call__(self, input, *arguments, **kwargs)
        return super().__call__(input, *arguments, **kwargs)

    def forward(  # type: ignore[override]  # the depth comes second, where Kornia has the parameters
        self,
        input: Any,
        depth: Tensor | None = None,
        params: dict[str, Tensor] | None = None,
        matte: Tensor | None = None,
        **kwargs: Any,
    ) -> Any:
        """Blur images.

        Args:
            input: ``[B, C, H, W]``, B may be 0, or ``[C, H, W]``; without ``depth``, its last channel is the depth. Or
                a dict with ``"image"`` (or ``"input"``, ``"img"``), ``"depth"`` and perhaps ``"matte"``, which is
                returned with the image replaced.
            depth: Metres, ``[B, 1, H, W]``, ``[B, H, W]`` or ``[1, 1, H, W]``; of one image ``[1, H, W]`` or
                ``[H, W]``.
            params: Parameters of an earlier call, to repeat it; None draws new ones.
            matte: Coverage by a subject in [0, 1], in a shape of ``depth``, or None.
            **kwargs: Arguments from Kornia's containers.

        Returns:
            Images of the shape of ``input`` (a batch unless ``keepdim``), in its dtype, or the dict; with
            ``return_label`` also the label.

        Raises:
            ValueError: If there is no depth, or shapes or values are not as described.
        """
        if isinstance(input, Mapping):
            return self._forward_dict(input, params, **kwargs)
        shape = _batch_shape(input)
        maps = {name: value for name, value in (("depth", depth), ("matte", matte)) if value is not None}
        if maps:
            params = dict(self.forward_parameters(shape) if params is None else params) | maps
        try:
            images = super().forward(input, params, **kwargs)
            return (images, self.label(input, depth, params)) if self.return_label else images
        finally:
            for drawn in (params, self._params):  # maps are inputs, not parameters that a call keeps
                if drawn is not None:
                    for name in maps:
                        drawn.pop(name, None)

    def _forward_dict(self, sample: Mapping[str, Any], params: Any, **kwargs: Any) -> dict[str, Any]:
        """Blur a sample that is a dict, as in torchvision's transforms."""
        key = next((name for name in _IMAGE_NAMES if name in sample), "image")
        if key not in sample or "depth" not in sample:
            raise ValueError(f"a dict must have 'image' and 'depth', got the keys {', '.join(map(str, sample))}")
        image, depth = (_as_plain_tensor(sample[name]) for name in (key, "depth"))
        blurred = self.forward(image, depth, params, _as_plain_tensor(sample.get("matte")), **kwargs)
        blurred, label = blurred if self.return_label else (blurred, {})
        return {**sample, key: _as_type_of(sample[key], blurred.reshape(image.shape)), **label}

    def label(
        self, input: Tensor, depth: Tensor | None = None, params: Mapping[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """Blur and drawn parameters of the images of a call, as training labels by name.

        Args:
            input: Images of the call, before the blur, with or without the depth as their last channel.
            depth: Depth of the call, as in :meth:`forward`.
            params: Parameters of the call; None takes those of the last call.

        Returns:
            ``coc_px``: signed radius of the circle of confusion ``[B, 1, H, W]``, in pixels, negative in front of the
            focus plane, 0 where a pixel is unchanged; ``focus_m`` in metres, ``f_number`` and ``table`` (index of the
            table), each ``[B]``, also for images that were not blurred; ``blurred``, bool ``[B]``. For one image
            ``[C, H, W]`` all are without the axis B.

        Raises:
            ValueError: As :meth:`forward`; also if the parameters were drawn for another number of images.
        """
        shape = _batch_shape(input)
        image, depth, _ = _image_and_depth(_as_plain_tensor(input).reshape(shape), _as_plain_tensor(depth))
        drawn, batch = self._params if params is None else params, len(image)
        if not drawn or len(drawn["focus_m"]) != batch:
            got = f"those of {len(drawn['focus_m'])}" if drawn else "none; call it before, or give them"
            raise ValueError(f"params must be those of {batch} images, got {got}")
        items = self._chosen(drawn, batch).to(image.device)
        blurred = torch.zeros(batch, dtype=torch.bool, device=image.device).index_fill(0, items, True)
        coc = depth.new_zeros(depth.shape)
        if len(items):
            options: Any = self.renderings[0].arguments()
            camera_numbers = (drawn[name].to(image.device)[items] for name in ("focus_m", "f_number"))
            light = self._light(image[items], self.flags["transfer"])
            blur_px = DepthOfField(self._camera_of(items), **options).coc_px(light, depth[items], *camera_numbers)
            coc = coc.index_copy(0, items, torch.nan_to_num(blur_px, nan=0.0).to(coc.dtype))
        numbers = {name: drawn[name].to(image.device) for name in ("focus_m", "f_number", "table")}
        label = {"coc_px": coc, **numbers, "blurred": blurred}
        return label if input.ndim == 4 else {name: value[0] for name, value in label.items()}

    def transform_inputs(
        self,
        input: Tensor,
        params: dict[str, Tensor],
        flags: dict[str, Any],
        transform: Tensor | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """As in Kornia, but pass on all images: :meth:`apply_transform` selects those to blur, with their depth."""
        params, flags = self._process_kwargs_to_params_and_flags(
            self._params if params is None else params, flags, **kwargs
        )
        images = self.transform_tensor(input)
        self.validate_tensor(images)
        output = self.apply_transform(images, params, flags, transform)
        return output.reshape(input.shape) if self.keepdim else output

    def apply_transform(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """Blur the images ``[B, C, H, W]`` that ``params`` select."""
        image, depth, passed_on = _image_and_depth(input, params.get("depth"))
        matte = None if "matte" not in params else _as_map("matte", params["matte"], image, "in [0, 1]")
        blurred = self._chosen(params, len(input))
        for index in params["table"][blurred].unique().tolist():
            items = blurred[params["table"][blurred] == index].to(input.device)
            options: Any = self.renderings[int(index)].arguments()
            lens: Any = {name: params[name].to(items.device)[items] for name in ("focus_m", "f_number")}
            light = self._light(image[items], flags["transfer"])
            covered = None if matte is None else matte[items]
            rendered = depth_of_field(light, depth[items], self._camera_of(items), **lens, matte=covered, **options)
            if flags["transfer"] == "srgb":
                rendered = encode(rendered, "srgb", has_alpha=False, straight=False)
            image = image.index_copy(0, items, rendered)
        return torch.cat([image, passed_on], dim=1) if passed_on.shape[1] else image

    def _chosen(self, params: Mapping[str, Tensor], count: int) -> Tensor:
        """Indices of the items to blur: all if the probability is 1, as in Kornia, else those with an open gate."""
        if (self.p == 1.0 and self.p_batch == 1.0) or "batch_prob" not in params:
            return torch.arange(count, device="cpu")
        return torch.atleast_1d(params["batch_prob"] > 0.5).expand(count).nonzero()[:, 0].cpu()

    def _camera_of(self, items: Tensor) -> Camera:
        """The camera, with the numbers of these items where it has one for each image."""
        values = {name: getattr(self.camera, name) for name in Camera.__dataclass_fields__}
        own = {name: v[items.to(v.device)] for name, v in values.items() if isinstance(v, Tensor) and v.numel() > 1}
        return self.camera.replace(**own) if own else self.camera

    @staticmethod
    def _light(image: Tensor, transfer: Transfer) -> Tensor:
        """Decode images to linear light."""
        if transfer == "linear":
            return image
        low, high = (float(value) for value in image.detach().aminmax())
        if not _ENCODED_RANGE[0] <= low <= high <= _ENCODED_RANGE[1]:
            got = f"{low:.4g} to {high:.4g}; normalize after RandomDepthOfField, or say transfer='linear'"
            raise ValueError(f"images with transfer='srgb' must lie in [0, 1], got {got}")
        return decode(image, "srgb", has_alpha=False, straight=False)


class DepthAugmentationSequential(AugmentationSequential):
    """Kornia's ``AugmentationSequential``, in which the first mask is the depth of the image, in metres.

    Geometric steps transform image, depth and masks alike, depth and masks by nearest neighbour, so that no depth
    between two surfaces appears. :class:`RandomDepthOfField` receives the depth as the steps before left it.

    Kornia converts masks to the dtype of the images, which rounds a depth to 11 bits for float16 and to 8 for bfloat16.
    Beside a wider depth, images of half precision are therefore transformed in float32; the results have the dtypes of
    the arguments.

    Args:
        *args: Augmentations; :class:`RandomDepthOfField` must be a direct member, not inside another container.
        matte_mask: Index of the mask that is the coverage by a subject, in [0, 1]: 1 is the mask after the depth. None
            blurs without a matte.
        **kwargs: As Kornia's; ``data_keys`` are ``"input"``, ``"mask"`` for the depth, and any others. With
            ``data_keys=None`` the input is a dict, in which the first key that begins with ``"mask"`` is the depth.

    Raises:
        ValueError: If ``matte_mask`` is not from 1; when called, if a member needs a mask that is missing.

    Example:
        >>> from kornia.augmentation import RandomHorizontalFlip
        >>> seq = DepthAugmentationSequential(
        ...     RandomHorizontalFlip(p=1.0), RandomDepthOfField(p=1.0), data_keys=["input", "mask", "mask"]
        ... )
        >>> image, depth, labels = torch.rand(2, 3, 8, 12), 1 + torch.rand(2, 1, 8, 12), torch.ones(2, 1, 8, 12)
        >>> image, depth, labels = seq(image, depth, labels)
        >>> image.shape, depth.shape, labels.shape
        (torch.Size([2, 3, 8, 12]), torch.Size([2, 1, 8, 12]), torch.Size([2, 1, 8, 12]))
    """

    def __init__(self, *args: Any, matte_mask: int | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.transform_op = _DepthOps(self.data_keys)
        self.transform_op.matte_mask = None if matte_mask is None else whole("matte_mask", matte_mask, 1, 1000)

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """As Kornia's, without rounding of the depth."""
        return _in_single_precision(super().forward, args, kwargs)

    def inverse(self, *args: Any, **kwargs: Any) -> Any:
        """As Kornia's, without rounding of the depth."""
        return _in_single_precision(super().inverse, args, kwargs)


def _in_single_precision(call: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """The result of ``call`` on tensors, one of which may be a dict of them; half precision beside wider is widened."""
    is_dict = len(args) == 1 and isinstance(args[0], dict)
    given: dict[Any, Any] = args[0] if is_dict else dict(enumerate(args))
    half = {k: v.dtype for k, v in given.items() if isinstance(v, Tensor) and v.dtype in (torch.half, torch.bfloat16)}
    if not half or all(k in half or v is None for k, v in given.items()):
        return call(*args, **kwargs)
    widened = {k: v.float() if k in half else v for k, v in given.items()}
    results = call(widened, **kwargs) if is_dict else call(*widened.values(), **kwargs)
    named = results if is_dict else dict(enumerate(results))
    restored = {k: v.to(half[k]) if k in half else v for k, v in named.items()}
    return restored if is_dict else [*restored.values()]


class _DepthOps(AugmentationSequentialOps):
    """Passes depth and matte to the steps that need them; Kornia's class passes each tensor separately."""

    matte_mask: int | None = None

    def transform(
        self,
        *arg: Any,
        module: nn.Module,
        param: ParamItem,
        extra_args: dict[DataKey, dict[str, Any]],
        data_keys: list[Any] | None = None,
    ) -> Any:
        keys = self.preproc_datakeys(data_keys)
        if isinstance(module, RandomDepthOfField) and DataKey.MASK in keys and isinstance(param.data, dict):
            masks = [value for key, value in zip(keys, arg, strict=True) if key == DataKey.MASK]
            maps = {"depth": masks[0]}
            if self.matte_mask is not None:
                if self.matte_mask >= len(masks):
                    raise ValueError(f"matte_mask is {self.matte_mask}, but there are {len(masks)} masks, from 0 on")
                maps["matte"] = masks[self.matte_mask]
            param = ParamItem(param.name, {**param.data, **maps})
        return super().transform(*arg, module=module, param=param, extra_args=extra_args, data_keys=data_keys)


def _image_and_depth(input: Tensor, depth: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Split an input ``[B, C, H, W]`` into images, depth ``[B, 1, H, W]`` and channels to return unchanged."""
    image, passed_on = input, input[:, :0]
    if depth is None:
        if input.shape[1] not in (2, 4):
            raise ValueError(
                "RandomDepthOfField needs a depth: the second argument, the last of 2 or 4 channels, or the first mask "
                f"of DepthAugmentationSequential; got an image of {input.shape[1]} channels alone"
            )
        image, depth, passed_on = input[:, :-1], input[:, -1:], input[:, -1:]
    return image, _as_map("depth", depth, image, "in metres"), passed_on


def _as_map(name: str, values: Tensor, image: Tensor, unit: str) -> Tensor:
    """A map of images ``[B, C, H, W]`` in any accepted shape as ``[B, 1, H, W]``."""
    real_tensor(name, values, f"[B, 1, H, W] {unit}")
    if values.ndim in (2, 3):
        values = values.unsqueeze(-3) if values.ndim == 2 or len(values) == len(image) else values
        values = values if values.ndim == 4 else values[None]
    # an empty batch passes, as through Kornia's own steps; its other axes are checked
    checked_image, checked_map = (t if len(t) else t.new_empty(1, *t.shape[1:]) for t in (image, values))
    image_and_map(checked_image, name, checked_map, unit)
    return values.expand(len(image), -1, -1, -1)


def _range(name: str, value: Any, largest: float) -> tuple[float, float]:
    """Check a pair of numbers > 0, the smaller first."""
    if not isinstance(value, Sequence) or len(value) != 2:
        raise ValueError(f"{name} must be two numbers, the smallest and the largest, got {show(value)}")
    low, high = (number(name, item, low=0.0, infinite=largest == math.inf) for item in value)
    if low > high:
        raise ValueError(f"{name} must be two numbers, the smallest first, got {show(value)}")
    return low, high


def _batch_shape(image: Any) -> tuple[int, ...]:
    """Shape ``[B, C, H, W]`` of one image or a batch."""
    if not floating(image) or image.ndim not in (3, 4):
        expected = "floating point [B, C, H, W] or [C, H, W] (bytes: image.float() / 255; clips: flatten(0, 1))"
        raise ValueError(f"image must be {expected}, got {show(image)}")
    return tuple(image.shape) if image.ndim == 4 else (1, *image.shape)


def _as_plain_tensor(value: Any) -> Any:
    """Convert a tensor of a subclass, such as torchvision's, to a plain one."""
    return value.as_subclass(Tensor) if isinstance(value, Tensor) else value


def _as_type_of(like: Any, value: Tensor) -> Tensor:
    """Convert a tensor to the subclass of ``like``, with torchvision's metadata."""
    if type(like) is Tensor:
        return value
    from torchvision.tv_tensors import TVTensor, wrap

    return wrap(value, like=like) if isinstance(like, TVTensor) else value.as_subclass(type(like))
