import dataclasses
import inspect
import json
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.testing import assert_close

from tests.refused import refuses
from tests.scenes import CAMERA, EVERY_WAY, HEIGHT, WAYS, WIDTH, disc, slope, texture
from tests.traced import TRACED
from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc, depth_of_field, tensors, validation
from torchdof.augmentation import RandomDepthOfField
from torchdof.options import OptionArguments, Options
from torchdof.reference import metrics
from torchdof.render.layers.plan import Plan

TYPES = [torch.float16, torch.bfloat16, torch.float32, torch.float64]
TABLES = {
    "disc": BlurTable.disc(),
    "gaussian": BlurTable.gaussian(),
    "sato_j15": BlurTable.load("sato_j15"),
    "fraction": BlurTable("disc", [-0.1, 0.2], {"radius": [0.12, 0.1]}, unit="fraction"),
    "colours": BlurTable("disc", [1.0], {"radius": [[1.0], [1.1], [1.25]]}),
}


def constant_map(value: float, image: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.full((1, 1, *image.shape[-2:]), value, dtype=dtype)


def rms(first: Tensor, second: Tensor) -> float:
    """Of display-encoded values."""
    return float((metrics.display(first) - metrics.display(second)).square().mean().sqrt())


@EVERY_WAY
@pytest.mark.parametrize("name", TABLES)
def test_a_plane_is_the_convolution_with_the_kernel_of_its_table(name: str, way: dict[str, Any]) -> None:
    image = 10 * torch.rand(1, 3, 14, 19) ** 4
    for coc in (0.501, -0.7, -2.6, 3.999, *([12.75] if name == "disc" else [])):  # others have larger kernels
        values = constant_map(coc, image)
        out = blur_by_coc(image, values, table=TABLES[name], **way)
        assert_close(out.double(), disc(image, values, TABLES[name]), rtol=1e-5, atol=1e-6)


@EVERY_WAY
@pytest.mark.parametrize("dtype", TYPES)
def test_in_focus_plane_is_returned_bit_exact(way: dict[str, Any], dtype: torch.dtype) -> None:
    image = (torch.rand(2, 3, 7, 9) * 1000).to(dtype)
    depth = torch.full((1, 1, 7, 9), 2.0, dtype=dtype)
    out = DepthOfField(Camera(focus_m=2.0), **way)(image, depth)
    assert torch.equal(out, image) and out.data_ptr() != image.data_ptr()
    below_a_hundredth = 0.02 * torch.rand(1, 1, 7, 9) - 0.01
    assert torch.equal(blur_by_coc(image, below_a_hundredth, **way), image)


def test_the_functional_form_equals_the_module() -> None:
    image, depth = torch.rand(1, 3, 9, 12), 0.6 + 4 * torch.rand(1, 1, 9, 12)
    camera, table = Camera(sensor_width_mm=1.0), BlurTable.gaussian()
    expected = DepthOfField(camera, table, method="fold", occlusion=False)(image, depth, 1.2, 1.7)
    out = depth_of_field(image, depth, camera, table=table, focus_m=1.2, f_number=1.7, method="fold", occlusion=False)
    assert torch.equal(out, expected)
    coc = camera.replace(focus_m=1.2, f_number=1.7).coc_px(depth, 12)
    assert torch.equal(blur_by_coc(image, coc, table=table, method="fold", occlusion=False), expected)


LAYOUTS: list[Callable[[Tensor], Tensor]] = [
    lambda t: t,
    lambda t: t.contiguous(memory_format=torch.channels_last),
    lambda t: t.mT.contiguous().mT,
    lambda t: t.repeat_interleave(2, -1)[..., ::2],
    lambda t: t[:, :1].expand_as(t),
]


@settings(max_examples=25)
@given(
    st.sampled_from([(1, 1), (1, 7), (8, 1), (3, 5), (6, 9), (2, 2)]),
    st.tuples(st.integers(1, 2), st.integers(1, 5)),
    st.sampled_from(TYPES),
    st.sampled_from([0.0, 0.6, 2.0, 5.0]),
    st.sampled_from(list(WAYS.values())),
    st.sampled_from(LAYOUTS),
)
def test_any_shape_type_and_stride_gives_the_picture_of_a_plain_tensor(
    size: tuple[int, int], items: tuple[int, int], dtype: torch.dtype, reach: float, way: Any, layout: Any
) -> None:
    image, coc = layout(torch.rand(*items, *size).to(dtype)), layout(reach * torch.randn(items[0], 1, *size))
    out = blur_by_coc(image, coc, **way)
    assert out.shape == image.shape and out.dtype == dtype
    assert torch.equal(out, blur_by_coc(image.clone(memory_format=torch.contiguous_format), coc.contiguous(), **way))
    assert torch.isfinite(out).all()
    low, high = (float(f(image.double())) for f in (torch.min, torch.max))
    assert low * 0.99 - 1e-6 <= float(out.double().min()) and float(out.double().max()) <= high * 1.01 + 1e-6


# The module as a module


CONFIGURED: dict[str, tuple[Camera, BlurTable | None, dict[str, Any]]] = {
    "defaults": (Camera(), None, {}),
    "numbers for each item": (
        Camera(85.0, torch.tensor([1.4, 2.1]), 1.2, 24.0, focus_breathing=False),
        BlurTable.load("sato_j15"),
        {"tolerance": 1 / 100, "occlusion": False, "normalize": False, "max_coc_px": 20.0, "check": False},
    ),
    "range": (
        Camera(focus_range_m=(torch.tensor([1.0, 1.5]), math.inf), swing_deg=3.0),
        BlurTable.polygon(7, 15.0),
        {"method": "fold"},
    ),
    "infinity": (Camera(focus_m=math.inf, tilt_deg=1.0), BlurTable.load("double_gauss_50mm_f2"), {}),
    "opening": (Camera(focus_m=torch.tensor([1.0, math.inf])), BlurTable.from_aperture(torch.rand(9, 9)), {}),
}


@pytest.mark.parametrize("name", CONFIGURED)
def test_the_configuration_survives_strict_json(name: str) -> None:
    camera, table, options = CONFIGURED[name]
    dof = DepthOfField(camera, table, **options)
    other = DepthOfField.from_dict(json.loads(json.dumps(dof.to_dict(), allow_nan=False)))
    assert repr(other) == repr(dof) and other.to_dict() == dof.to_dict()
    image, depth = torch.rand(2, 3, 9, 12), 0.6 + 4 * torch.rand(2, 1, 9, 12)
    assert torch.equal(other(image, depth), dof(image, depth))


def test_a_short_configuration_written_by_hand_takes_the_defaults() -> None:
    dof = DepthOfField.from_dict({"camera": {"focus_m": 1.5}, "tolerance": "draft"})
    assert repr(dof) == repr(DepthOfField(Camera(focus_m=1.5), tolerance="draft"))


def test_a_model_with_the_module_has_the_checkpoints_of_one_without() -> None:
    dof = DepthOfField(Camera(focus_m=3.0), BlurTable.load("sato_j15"), tolerance=0.1)
    model = nn.ModuleDict({"net": nn.Conv2d(1, 1, 1), "dof": dof})
    before, state = repr(dof), model.state_dict()
    assert [*state] == ["net.weight", "net.bias"]
    model.load_state_dict(nn.ModuleDict({"net": nn.Conv2d(1, 1, 1)}).state_dict())
    model.load_state_dict(state)
    assert repr(dof) == before


def test_checkpoints_with_the_configuration_of_earlier_versions_load_and_leave_the_module_as_it_is() -> None:
    camera = Camera(focus_m=3.0, f_number=torch.tensor([1.0, 2.0]))
    table = BlurTable.load("sato_j15")
    dof = DepthOfField(camera, table, tolerance=0.1)
    numbers = {name: getattr(dof.camera, name) for name in Camera.__dataclass_fields__}  # tensors, as it was stored
    old = {"camera": numbers, **dof.options.arguments(), "table": table.to_dict()}
    other = DepthOfField(Camera(focus_m=1.0))
    model = nn.ModuleDict({"net": nn.Conv2d(1, 1, 1), "dof": other})
    state = {**model.state_dict(), "dof._extra_state": old}
    assert not any(model.load_state_dict(state))
    assert other.camera.focus_m == 1.0
    assert repr(DepthOfField.from_dict(state["dof._extra_state"])) == repr(dof)


def test_repr_shows_camera_table_and_options() -> None:
    text = repr(DepthOfField(Camera(35.0, 1.4, 0.8), BlurTable.load("sato_j15"), method="fold"))
    assert text.startswith("DepthOfField(")
    for part in ("35 mm, f/1.4, focus 0.8 m", "'sato_j15', ring", "tolerance=0.0039", "method='fold'", "occlusion=T"):
        assert part in text


# Signatures, help and type hints have the options of the dataclass ``Options``

DEFAULTS = {field.name: field.default for field in dataclasses.fields(Options)}


@pytest.mark.parametrize("function", [DepthOfField, depth_of_field, blur_by_coc, RandomDepthOfField])
def test_the_signature_has_every_option_with_its_default_and_help_names_their_class(function: object) -> None:
    assert ["table", *OptionArguments.__annotations__] == list(DEFAULTS)  # type hints
    parameters = inspect.signature(function).parameters  # type: ignore[arg-type]
    different = {"check": False} if function is RandomDepthOfField else {}
    assert {name: parameters[name].default for name in DEFAULTS} == {**DEFAULTS, "table": None, **different}
    assert RandomDepthOfField().renderings[0].check is False
    assert "**options: As in :class:`torchdof.options.Options`" in (function.__doc__ or "")


# Compiled

COMPILED: dict[str, Any] = {"max_coc_px": 3.0, "tolerance": 1 / 60}
FEW: dict[str, Any] = {"max_coc_px": 3.0, "tolerance": 1 / 16}  # few layers: compiling takes long


def compiled_case() -> tuple[Camera, Tensor, Tensor]:
    torch.manual_seed(3)
    camera = Camera(focus_m=1.5, f_number=2.0, sensor_width_mm=1.0)
    return camera, torch.rand(1, 3, 10, 14), 1.0 + 2 * torch.rand(1, 1, 10, 14)


@TRACED
@pytest.mark.parametrize(("backend", "way"), [
    *(("eager", WAYS[way]) for way in ("over", "sum", "fold-sum")),
    pytest.param("inductor", WAYS["sum"], marks=pytest.mark.hard),
    pytest.param("inductor", WAYS["over"], marks=pytest.mark.sweep),  # takes minutes
])  # fmt: skip
@pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")  # raised inside inductor
def test_the_module_compiles_without_graph_breaks_and_equals_eager(backend: str, way: dict[str, Any]) -> None:
    torch.compiler.reset()
    camera, image, depth = compiled_case()
    dof = DepthOfField(camera, **COMPILED, **way)
    torch._dynamo.utils.counters.clear()
    fast = torch.compile(dof, backend=backend)(image, depth)  # fullgraph=True would read the values of constant tensors
    assert not torch._dynamo.utils.counters["graph_break"] and not torch.equal(fast, image)
    still = dof(image, depth, plan=Plan.static(COMPILED["max_coc_px"], COMPILED["tolerance"]))
    assert_close(fast, still, rtol=1e-5, atol=1e-6)
    assert rms(fast, dof(image, depth)) <= 2 * COMPILED["tolerance"]


@TRACED
def test_a_compiled_module_takes_a_matte() -> None:
    torch.compiler.reset()
    camera, image, _ = compiled_case()
    depth, matte = torch.full((1, 1, 10, 14), 3.0), torch.zeros(1, 1, 10, 14)
    depth[..., :6], matte[..., :7], matte[..., 7] = 1.5, 1.0, 0.5
    dof = DepthOfField(camera, **FEW)
    plan = Plan.static(FEW["max_coc_px"], FEW["tolerance"])
    compiled = torch.compile(dof, backend="eager")
    for cover in (matte, matte.flip(-1)):
        eager = dof(image, depth, plan=plan, matte=cover)
        assert_close(compiled(image, depth, matte=cover), eager, rtol=1e-5, atol=1e-6)
        assert rms(eager, dof(image, depth, plan=plan)) > 1e-3


@TRACED
def test_a_plan_can_be_compiled_and_renders_without_rays() -> None:
    torch.compiler.reset()
    camera, image, depth = compiled_case()
    image[..., 4, 5] = 50.0
    dof = DepthOfField(camera, tolerance=FEW["tolerance"])
    plan = dof.plan(image, depth)
    fast = torch.compile(dof, fullgraph=True, backend="eager")(image, depth, plan=plan)
    assert_close(fast, dof(image, depth, plan=dataclasses.replace(plan, rays=False)), rtol=1e-5, atol=1e-6)


@TRACED
def test_modules_with_other_options_and_cameras_compile_one_after_the_other() -> None:
    torch.compiler.reset()
    camera, image, depth = compiled_case()
    for f_number, reach, tolerance in ((2.0, 3.0, 1 / 16), (2.2, 2.0, 1 / 8)):
        lens = camera.replace(focal_length_mm=25.0 * f_number, sensor_width_mm=0.5 * f_number, f_number=f_number)
        dof = DepthOfField(lens, max_coc_px=reach, tolerance=tolerance, occlusion=False)
        focus_m = torch.tensor([2.0])
        fast = torch.compile(dof, fullgraph=True, backend="eager")(image, depth, focus_m=focus_m)
        plan = Plan.static(reach, tolerance)
        assert_close(fast, dof(image, depth, focus_m=focus_m, plan=plan), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("fullgraph", [True, False])
def test_the_compiler_of_an_old_pytorch_is_refused_by_name(fullgraph: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tensors, "TRACEABLE", False)
    torch.compiler.reset()
    image, depth = torch.rand(1, 3, 8, 9), torch.full((1, 1, 8, 9), 3.0)
    dof = DepthOfField(Camera(focus_m=1.0))
    for call in (dof, lambda image, depth: blur_by_coc(image, depth)):
        with pytest.raises(Exception, match=r"torchdof needs PyTorch 2\.13 or newer to be compiled.*compiler\.disable"):
            torch.compile(call, fullgraph=fullgraph, backend="eager")(image, depth)
    torch.compiler.reset()
    left_out = torch.compiler.disable(dof)
    around = torch.compile(lambda image, depth: 2.0 * left_out(image, depth), backend="eager")
    assert_close(around(image, depth), 2.0 * dof(image, depth))
    torch.compiler.reset()


# Errors


def test_an_image_and_its_maps_are_checked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each look at the values is a pass over memory, and each check of the shapes takes the time of a small frame."""
    looked_at: list[str] = []

    def noted(name: str) -> None:
        check = getattr(validation, name)

        def checked(*arguments: Any, **more: Any) -> Any:
            looked_at.append(name)
            return check(*arguments, **more)

        monkeypatch.setattr(validation, name, checked)

    for name in ("image_and_map", "ends"):
        noted(name)
    image = texture()
    DepthOfField(CAMERA)(image, slope(1.0, 9.0))
    assert sorted(looked_at) == ["ends"] * 3 + ["image_and_map"]  # depth, image, circle of confusion
    looked_at.clear()
    blur_by_coc(image, slope(-2.0, 3.0), background=image, background_coc_px=slope(1.0, 4.0))
    assert sorted(looked_at) == ["ends"] * 4 + ["image_and_map"] * 2


IMAGE, DEPTH, COC = torch.rand(1, 3, 4, 5), torch.ones(1, 1, 4, 5), torch.zeros(1, 1, 4, 5)


def module(**options: Any) -> Callable[[], Any]:
    return lambda: DepthOfField(**{"camera": Camera(), **options})


def called(**arguments: Any) -> Callable[[], Any]:
    return lambda: DepthOfField(Camera())(**{"image": IMAGE, "depth": DEPTH, **arguments})


def several(camera: Camera | None = None, **numbers: Any) -> Tensor:
    return depth_of_field(IMAGE.expand(2, -1, -1, -1), DEPTH, camera or Camera(), **numbers)


test_a_wrong_argument_is_refused_in_one_sentence = refuses(
    (called(image=IMAGE.byte()), "image must be a tensor .* floating point .*got a torch.uint8"),
    (called(image=[[1.0]]), r"image must be a tensor .*got \[\[1.0\]\]"),
    (called(image=IMAGE[0].numpy()), r"image must be a tensor .*got a float32 array .*; use torch.from_numpy"),
    (called(image=IMAGE.movedim(1, -1)), r"got \[1, 1, 4, 5\]; channels come before .*image.movedim\(-1, -3\)"),
    (called(depth=DEPTH[0]), r"depth must be \[1, 1, 4, 5\].*did you forget the channel dimension"),
    *((called(depth=torch.ones(size)), r"depth must be \[1, 1, 4, 5\].* got \[{}, {}, {}, {}\]".format(*size))
      for size in ((2, 1, 4, 5), (1, 3, 4, 5))),
    (called(depth=torch.ones(1, 1, 5, 4)), "depth is 4 x 5 pixels and the image 5 x 4: turned by 90 degrees it fits"),
    (called(depth=DEPTH.long()), "depth must be .*floating point .*got a torch.int64"),
    (called(depth=2.0), "depth must be .*got 2.0"),
    (called(depth=DEPTH.to("meta")), "depth must be a tensor .* got one on the meta device"),
    (called(depth=0.0 * DEPTH), "depth must be > 0 .* 20 of 20 pixels .*; check its unit"),
    (called(focus_m=0.01), "focus_m must be longer than the focal length"),
    (called(f_number=-1.0), "f_number must be positive"),
    (called(focus_m=torch.tensor([1.0, 2.0])), r"focus_m must be a number or \[1\], for one image, got \[2\]"),
    (lambda: several(focus_m=[1.0, 2.0, 3.0]), r"focus_m must be a number or \[2\], for 2 images, got \[3\]"),
    (lambda: several(Camera(focus_range_m=(1.0, torch.ones(3)))), r"focus_range_m must be .*\[2\].* got \[3\]"),
    (called(image=[IMAGE[0], IMAGE[0]]), r"got a list of 2 tensors of shape \[3, 4, 5\]; torch.stack"),
    (called(image=[IMAGE[0], IMAGE[0, :, 1:]]), r"of shape \[3, 4, 5\], \[3, 3, 5\]; render them one by one"),
    (called(depth=torch.ones(3)), r"depth must be \[1, 1, 4, 5\] in metres"),
    (module(camera=50.0), "^camera must be a torchdof.Camera, got float"),
    (module(table="disc"), "^table must be a torchdof.BlurTable, got str; read a file with BlurTable.load"),
    *((module(tolerance=value), r"^tolerance must be a number in \[0, 1\)") for value in (-0.1, 1.0, math.nan, True)),
    *((module(depth_edges=value), "must be one of auto, repair, as given, got") for value in ("Auto", None, True)),
    (module(method="scatter"), "^method must be one of layered, fold, got 'scatter'"),
    (module(normalize=False), "^normalize=False is the plain sum of occlusion=False"),
    *((module(max_coc_px=value), "^max_coc_px must be a number of pixels > 0.5") for value in (0.5, math.inf)),
    (lambda: blur_by_coc(IMAGE, COC[0, 0]), r"coc_px must be \[1, 1, 4, 5\].* in pixels"),
    (lambda: blur_by_coc(IMAGE[:, :1], COC, table=TABLES["colours"]), "the table blurs 3 channels, the image has 1"),
    (called(plan=3), r"plan must be a Plan from.* got "),
    (lambda: depth_of_field(IMAGE, DEPTH, Camera(), plan="plan"), r"plan must be a Plan from"),  # type: ignore[arg-type]
    (lambda: blur_by_coc(IMAGE, COC, plan=(0.0, 1.0)), r"plan must be a Plan from"),  # type: ignore[arg-type]
)  # fmt: skip


@pytest.mark.parametrize("name", ["depth", "image", "coc_px", "rgba"])
@pytest.mark.parametrize("bad", [0.0, -0.0, -1.0, math.nan, math.inf, -math.inf])
def test_bad_numbers_are_refused_and_counted(name: str, bad: float) -> None:
    image, depth, rgba = texture(), slope(1.2, 6.0), torch.ones(1, 2, 4, HEIGHT, WIDTH)
    {"depth": depth, "image": image, "coc_px": depth, "rgba": rgba}[name].flatten()[7:9] = bad
    calls: dict[str, Any] = {
        "depth": lambda: DepthOfField(CAMERA)(image, depth),
        "image": lambda: DepthOfField(CAMERA)(image, depth),
        "coc_px": lambda: blur_by_coc(image, depth),
        "rgba": lambda: DepthOfField(CAMERA).layers(rgba, torch.tensor([1.0, 4.0])),
    }
    message = {"depth": "depth must be > 0 .*got 2 of 768 pixels"}.get(name, f"{name} must be finite, got 2 of ")
    if bad != math.inf if name == "depth" else not math.isfinite(bad):
        with pytest.raises(ValueError, match=message):
            calls[name]()
    elif name != "rgba":
        calls[name]()


BAD_CONFIGURATIONS: list[tuple[Any, str]] = [
    (None, "the configuration of a DepthOfField must be a dict, got None"),
    (5, "the configuration of a DepthOfField must"),
    ({}, "the configuration of a DepthOfField must have the fields .*; camera is missing"),
    ({"camera": None}, "camera of the configuration must be a dict, got None"),
    ({"camera": {"f_numer": 2.0}}, "camera of the configuration must have the fields .*'f_numer' is not one"),
    ({"camera": {"f_number": -1.0}}, "camera of the configuration: f_number must be"),
    ({"camera": {"f_number": "2"}}, "camera of the configuration: f_number must be"),
    ({"camera": {"f_number": ["2"]}}, "camera of the configuration: f_number must be"),
    ({"camera": {"focus_range_m": [1.0]}}, "camera of the configuration: focus_range_m must be"),
    ({"table": {"schema": "other"}}, "table of the configuration: schema must be"),
    ({"tolerance": "fine"}, "the configuration of a DepthOfField: tolerance must be a number"),
    ({"forward": print}, "must have the fields .*'forward' is not one of them"),
]


@pytest.mark.parametrize(("change", "message"), BAD_CONFIGURATIONS)
def test_a_bad_configuration_is_refused_by_field(change: Any, message: str) -> None:
    config = {**DepthOfField(Camera()).to_dict(), **change} if isinstance(change, dict) and change else change
    with pytest.raises(ValueError, match=message):
        DepthOfField.from_dict(config)


def test_operators_of_compiled_graphs_have_no_default_arguments() -> None:
    """The default compiler refuses them, because the operator of the gradient has an argument after them."""
    for name in ("surfaces", "surfaces_gradients"):
        arguments = getattr(torch.ops.torchdof, name).default._schema.arguments
        assert not any(argument.has_default_value() for argument in arguments)
