"""Errors of every public entry: tensors that hold no numbers, impossible plans, lenses whose blur overflows."""

import functools
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from tests.kernels import kernel_of
from tests.refused import refuses
from tests.scenes import CAMERA, slope, texture, whole
from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc
from torchdof.augmentation import RandomDepthOfField
from torchdof.depth import depth_from_values, fill_holes
from torchdof.io.images import Picture, write_image
from torchdof.render.layers.plan import Plan

pytestmark = pytest.mark.hard

DOF = DepthOfField(CAMERA)
IMAGE, MAP = torch.ones(1, 3, 4, 5), torch.ones(1, 1, 4, 5)
COLOURS, ALONE, ONE = (1, 3, 4, 5), (1, 1, 4, 5), (1,)
TAKES_TENSORS: dict[str, tuple[tuple[int, ...], Callable[[Tensor], Any]]] = {  # shape of a valid tensor, call with it
    "image": (COLOURS, lambda x: DOF(x, MAP)),
    "image ": (COLOURS, lambda x: RandomDepthOfField(p=1.0)(x, MAP)),
    "depth": (ALONE, lambda x: DOF(IMAGE, x)),
    "depth ": (ALONE, lambda x: CAMERA.coc_px(x, 10)),
    "depth  ": (ALONE, lambda x: CAMERA.focus_at(x, 1, 1)),
    "depth   ": (ALONE, lambda x: fill_holes(x, "far")),
    "depth values": (ALONE, lambda x: depth_from_values(x)),
    "coc_px": (ALONE, lambda x: blur_by_coc(IMAGE, x)),
    "background": (COLOURS, lambda x: DOF(IMAGE, MAP, background=x, background_depth=MAP)),
    "background_depth": (ALONE, lambda x: DOF(IMAGE, MAP, background=IMAGE, background_depth=x)),
    "attention": (ALONE, lambda x: DOF(IMAGE, MAP, attention=x)),
    "rgba": ((1, 2, 4, 4, 5), lambda x: DOF.layers(x, torch.ones(2))),
    "depth_m": ((2,), lambda x: DOF.layers(torch.ones(1, 2, 4, 4, 5), x)),
    "focus_m": (ONE, lambda x: DOF(IMAGE, MAP, focus_m=x)),
    "f_number": (ONE, lambda x: Camera(f_number=x)),
    "tilt_deg": (ONE, lambda x: Camera(tilt_deg=x)),
    "focus_range_m": (ONE, lambda x: Camera(focus_range_m=(x, 2.0))),
    "coc": (ONE, lambda x: BlurTable("gaussian", x, {"sigma": [1.0]})),
    "sigma": (ONE, lambda x: BlurTable("gaussian", [1.0], {"sigma": x})),
    "radius": (ONE, lambda x: kernel_of("disc", x)),
    "pixels": (COLOURS, lambda x: write_image("never.exr", Picture(x))),
}
STORED = [torch.float8_e4m3fn, torch.float8_e5m2, torch.float8_e4m3fnuz, torch.float8_e5m2fnuz]
NEWER = [getattr(torch, name) for name in ("float8_e8m0fnu", "float4_e2m1fn_x2") if hasattr(torch, name)]


class Wrapper(Tensor):
    """A wrapper subclass: it has a shape but no memory."""

    @staticmethod
    def __new__(cls, shape: tuple[int, ...]) -> "Wrapper":
        wrapper: Wrapper = torch.Tensor._make_wrapper_subclass(cls, shape, dtype=torch.float32)
        return wrapper

    @classmethod
    def __torch_dispatch__(cls, *_: object, **__: object) -> object:
        raise NotImplementedError


def stored(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    return torch.full(shape, 56, dtype=torch.uint8).view(dtype)


def fake(shape: tuple[int, ...]) -> Tensor:
    with FakeTensorMode():
        return torch.ones(shape)


def with_bytes(shape: tuple[int, ...], count: int) -> Tensor:
    values = torch.ones(shape)
    values.untyped_storage().resize_(count)
    return values


def nested(_: tuple[int, ...], layout: torch.layout) -> Tensor:
    return torch.nested.nested_tensor([torch.ones(3, 4, 5), torch.ones(3, 6, 5)], layout=layout)


Make = Callable[[tuple[int, ...]], Tensor]
STRANGE: dict[str, tuple[Make, str]] = {  # a tensor of a shape, message
    **{str(dtype): (functools.partial(stored, dtype=dtype), ".* got .*float(8|4)") for dtype in (*STORED, *NEWER)},
    "nested": (functools.partial(nested, layout=torch.strided), "must be .*got .*nested"),
    "jagged": (functools.partial(nested, layout=torch.jagged), "must be .*got .*nested"),
    "without memory": (functools.partial(with_bytes, count=0), "must be a.* that holds data, got a freed storage"),
}
PARTIAL: dict[str, Make] = {"part": functools.partial(with_bytes, count=10), "fake": fake, "wrapper": Wrapper}
STRANGE |= {kind: (make, "must be a tensor .* that holds data") for kind, make in PARTIAL.items()}
PAIRS = [(n, k) for n in TAKES_TENSORS for k in STRANGE if k not in PARTIAL or n in ("image", "depth", "coc_px")]


@pytest.mark.filterwarnings("ignore:The PyTorch API of nested tensors:UserWarning")
@pytest.mark.parametrize(("name", "kind"), PAIRS)
def test_tensors_that_hold_no_numbers_are_refused_by_name(name: str, kind: str) -> None:
    """The compiled engine would read invalid addresses."""
    (shape, call), (make, message) = TAKES_TENSORS[name], STRANGE[kind]
    with pytest.raises(ValueError, match=rf"{name.strip()} {message}"):
        call(make(shape))


def test_a_plan_with_enough_layers_is_unchanged_and_a_short_one_is_extended() -> None:
    plan = DOF.plan(texture(), slope(1.2, 6.0))
    coc = DOF.coc_px(texture(), slope(1.2, 6.0))
    assert plan.extended_to(coc) is plan and plan.extended_to(0.5 * coc) is plan
    every = Plan.static(2.0, 1 / 255)
    assert every.extended_to(coc) is every  # plan of a traced graph, which does not depend on its scene
    wider = plan.extended_to(3.0 * coc)
    assert set(plan.nodes) < set(wider.nodes)
    gaps = [high - low for low, high in zip(wider.nodes, wider.nodes[1:], strict=False)]
    assert min(gaps) > 0.05 and max(gaps) < 3.0


partial: Any = functools.partial
test_a_plan_without_layers_in_order_or_a_tolerance_is_refused = refuses(
    *((partial(Plan, nodes, 0.1), "plan must hold layers as a tuple of strictly increasing numbers below 1e9 px")
      for nodes in ((), (1.0, 0.0), (0.0, 0.0), (math.nan,), (0.0, math.inf), (1.1e9,), 5, [0.0], None, "ab")),
    *((partial(Plan, (0.0, 1.0), tolerance), r"tolerance .*must be a number in \[0, 1\), such as 1/255")
      for tolerance in (math.nan, math.inf, -1, 1, "final", "fine", None, True, 10**400)),
)  # fmt: skip


OVERFLOWING, PICTURE, DEPTH = DepthOfField(Camera(f_number=1e-42)), texture(), whole(3.0)
test_an_infinite_blur_radius_is_refused_with_lens_and_depth = refuses(
    *((partial(DepthOfField(camera), PICTURE, whole(depth)), f"this lens .*{named}") for camera, depth, named in (
        (Camera(f_number=1e-42), 3.0, "f_number 1e-42"),
        (Camera(sensor_width_mm=1e-300), 3.0, "sensor_width_mm 1e-300"),
        (Camera(focal_length_mm=1e200, focus_m=1e250), 3.0, r"focal_length_mm 1e\+200"),
        (Camera(focus_m=1e-45, focus_breathing=False), 3.0, "focus_m 1e-45"),
        (Camera(focus_m=torch.tensor([1e-45]), focus_breathing=False), 3.0, "focus_m 1.4013e-45"),
        (Camera(), 1e-45, "which starts at 1.4e-45 m"))),
    (partial(OVERFLOWING.plan, PICTURE, DEPTH), "this lens .*f_number 1e-42"),
    (partial(OVERFLOWING.coc_px, PICTURE, DEPTH), "this lens .*f_number 1e-42"),
    (partial(OVERFLOWING.layers, torch.ones(1, 2, 4, 24, 32), torch.tensor([3.0, 5.0])), "this lens .*f_number 1e-42"),
    (partial(DOF, PICTURE, DEPTH, background=PICTURE, background_depth=whole(1e-45)), "which starts at 1.4e-45 m"),
)  # fmt: skip
