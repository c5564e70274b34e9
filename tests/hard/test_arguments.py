"""Any argument gives a valid result or a ValueError that states the expected and the received value."""

import functools
import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc, depth_of_field
from torchdof.cli.command import Parsed, command_of
from torchdof.cli.render import Render
from torchdof.depth.holes import fill_holes
from torchdof.depth.inspect import tint_focus
from torchdof.depth.kinds import depth_from_values
from torchdof.io.metadata import camera_settings
from torchdof.io.sequence import FramePattern, focus_at_frame
from torchdof.optics import psf

pytestmark = pytest.mark.hard

FEW = settings(max_examples=max(50, settings().max_examples // 5), suppress_health_check=list(HealthCheck))

# no numbers from 300 to 1e7: as a blur radius they rightly need gigabytes
NUMBERS = st.one_of(
    st.floats(max_value=300.0),
    st.floats(min_value=1e7),
    st.integers(-3, 300),
    st.sampled_from([0, -1, 10**400, -(10**400), math.nan, math.inf, -math.inf, 5e-324, 1.7e308]),
)
SHAPES = st.one_of(
    st.sampled_from([(1, 3, 4, 5), (1, 1, 4, 5), (2, 1, 4, 5), (3, 4, 5), (4, 5), (1,), (2,), (), (0,), (1, 3, 0, 5)]),
    st.lists(st.integers(0, 5), max_size=5).map(tuple),
)
TYPES = [torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.uint8, torch.bool]


@st.composite
def tensors(draw: st.DrawFn) -> Tensor:
    """Tensors of any shape and type, with bad values, sparse, on the meta device or with gradients."""
    shape, dtype = draw(SHAPES), draw(st.sampled_from([torch.float32, *TYPES, torch.complex64]))
    fill = draw(st.sampled_from([0.0, 1.0, 0.5, 2.5, -1.0, math.nan, math.inf, 1e30]))
    plain = dtype.is_floating_point or dtype == torch.complex64 or math.isfinite(fill) and abs(fill) < 100
    made = torch.full(shape, fill if plain else 1.0).to(dtype)
    kind = draw(st.sampled_from(["dense", "dense", "dense", "meta", "sparse", "gradient"]))
    if kind == "gradient":
        return made.requires_grad_(made.is_floating_point())
    return made.to("meta") if kind == "meta" else made.to_sparse() if kind == "sparse" else made


JUNK = st.one_of(
    st.none(), st.text(max_size=4), st.booleans(), st.binary(max_size=2), st.just(object()), st.complex_numbers(),
    st.lists(NUMBERS, max_size=3), st.dictionaries(st.sampled_from(["sigma", "radius"]), NUMBERS, max_size=2),
)  # fmt: skip
ANYTHING = st.one_of(NUMBERS, tensors(), JUNK)

IMAGE, DEPTH, COC = torch.rand(1, 3, 4, 5), torch.full((1, 1, 4, 5), 3.0), torch.full((1, 1, 4, 5), 1.3)
RING = BlurTable("ring", [0.1], {"sigma": [0.1], "r_c": [0.1]}, unit="fraction")
VALUES = torch.tensor([[[[1.0, math.nan, 3.0]]]])
TAGS = ("Exif:FocalLength", "FNumber", "Exif:SubjectDistance", "Exif:FocalLengthIn35mmFilm",
        "Exif:FocalPlaneXResolution", "Exif:FocalPlaneResolutionUnit", "Exif:PixelXDimension")  # fmt: skip


def kernels_of_fields(**fields: Any) -> None:
    kernels = BlurTable.from_dict(fields).kernels(torch.tensor([-3.0, 4.0]), 36, size=5)
    assert torch.isfinite(kernels).all()


def rendered(render: Callable[..., Tensor], image: Tensor = IMAGE, **others: Any) -> None:
    out = render(image, **others)
    assert out.shape == image.shape and out.dtype == image.dtype
    assert torch.isfinite(out).all() or not others.get("check", True)


blurred, photographed = (functools.partial(rendered, render) for render in (blur_by_coc, depth_of_field))


OPTIONS: dict[str, Any] = {
    "table": RING, "tolerance": 0.01, "occlusion": True, "normalize": True, "method": "layered",
    "max_coc_px": 8.0, "check": True,
}  # fmt: skip
CALLS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "Camera": (
        Camera,
        {"focal_length_mm": 50.0, "f_number": 2.0, "focus_m": 2.0, "sensor_width_mm": 36.0, "focus_breathing": True},
    ),
    "Camera.from_fov": (Camera.from_fov, {"fov_x_deg": 40.0, "aperture_radius_m": 0.01, "focus_m": 2.0}),
    "Camera.coc_px": (Camera().coc_px, {"depth": DEPTH, "width": 5}),
    "Camera.focal_px": (Camera().focal_px, {"width": 5}),
    "Camera.replace": (Camera().replace, {"focus_m": 1.0, "f_number": 2.0}),
    "Camera.focus_at": (Camera().focus_at, {"depth": DEPTH, "x": 1.0, "y": 2.0, "patch": 5}),
    "Camera.focus_range_at": (Camera().focus_range_at, {"depth": DEPTH, "points": [(1.0, 2.0)], "patch": 5}),
    "BlurTable": (BlurTable, {"family": "disc", "coc": [1.0], "params": {"radius": [1.0]}}),
    "BlurTable, all": (
        lambda **a: BlurTable("disc", [0.1], **a),
        {"params": {"radius": [0.1]}, "unit": "mm", "sensor_width_mm": 36.0, "strength": [1.0], "name": "a",
         "provenance": {}, "residual": [0.1]},
    ),
    "BlurTable.from_dict": (
        kernels_of_fields,
        {"schema": "torchdof/blur-table", "version": 1, "family": "disc", "unit": "mm", "sensor_width_mm": 36.0,
         "coc": [1.0], "params": {"radius": [1.0]}, "strength": [1.0]},
    ),
    "BlurTable.gaussian": (BlurTable.gaussian, {"sigma_per_coc": 0.5}),
    "BlurTable.load": (BlurTable.load, {"source": "sato_j15"}),
    "BlurTable.params": (RING.params, {"coc_px": torch.ones(2), "width": 5}),
    "BlurTable.kernels": (RING.kernels, {"coc_px": torch.ones(2), "width": 5, "size": 7}),
    "BlurTable.reach_px": (RING.reach_px, {"coc_px": 1.0, "width": 5}),
    "psf.pixel_kernels": (psf.pixel_kernels, {"family": "disc", "params": {"radius": 1.0}, "size": 9}),
    "psf.profile": (psf.profile, {"family": "disc", "r": torch.ones(2), "params": {"radius": 1.0}}),
    "psf.support": (psf.support, {"family": "disc", "params": {"radius": 1.0}}),
    "DepthOfField": (DepthOfField, {"camera": Camera(), **OPTIONS}),
    "depth_of_field": (
        photographed, {"image": IMAGE, "depth": DEPTH, "camera": Camera(), "focus_m": 1.0, "f_number": 2.0}
    ),
    "depth_of_field, options": (functools.partial(photographed, depth=DEPTH, camera=Camera(focus_m=1.0)), OPTIONS),
    "blur_by_coc": (blurred, {"image": IMAGE, "coc_px": COC}),
    "blur_by_coc, unchecked": (functools.partial(blurred, check=False), {"image": IMAGE, "coc_px": COC}),
    "blur_by_coc, options": (functools.partial(blurred, coc_px=COC), OPTIONS),
    "DepthOfField.plan": (DepthOfField(Camera()).plan, {"image": IMAGE, "depth": DEPTH, "focus_m": None}),
    "DepthOfField.coc_px": (DepthOfField(Camera()).coc_px, {"image": IMAGE, "depth": DEPTH, "f_number": None}),
    "depth_from_values": (
        depth_from_values,
        {"values": VALUES, "kind": "distance", "scale": 1.0, "offset": 0.0, "unknown": 0.0, "fov_x_deg": 40.0},
    ),
    "fill_holes": (fill_holes, {"depth": VALUES, "fill": "far"}),
    "tint_focus": (tint_focus, {"image": IMAGE, "coc_px": COC}),
    "focus_at_frame": (lambda frame: focus_at_frame([(0, 1.0), (5, 2.0)], frame), {"frame": 3}),
    "camera_settings": (
        lambda **tags: camera_settings({name: (None, value) for name, value in tags.items()}, 100, 80),
        {name: 2.0 for name in TAGS},
    ),
}  # fmt: skip


def check_error(call: Callable[[], Any], *others: type[Exception]) -> None:
    """Runs a call; an error of it must be one sentence with the expected and the received value."""
    try:
        call()
    except (ValueError, *others) as error:  # type: ignore[misc]
        message = str(error)
        assert 20 < len(message) < 1000
        assert re.search(r"must|need|expect|goes with|neither|no such|missing|is not|takes|set ", message), message
        assert re.search(r"got|there|valid|has|missing|is not|neither|must lie|one place|needs|; set ", message)


# A map of another shape is taken, with this note.
@pytest.mark.filterwarnings(
    "ignore:depth of .* px stretched by .* to the shape of the image; both must show the same area"
)
@pytest.mark.parametrize("name", CALLS)
@FEW
@given(st.data())
def test_any_argument_gives_a_result_or_a_named_error(name: str, data: st.DataObject) -> None:
    function, good = CALLS[name]
    share = data.draw(st.sampled_from([1, 1, 2, 8]), label="wrong arguments")
    wrong = data.draw(st.lists(st.sampled_from(sorted(good)), max_size=share, unique=True), label="which")
    arguments = {**good, **{k: data.draw(ANYTHING, label=k) for k in wrong}}
    check_error(lambda: function(**arguments), *([FileNotFoundError] if name.endswith("load") else []))


@FEW
@given(st.text(max_size=12) | st.from_regex(r"[-0-9:.,einfa ]{0,12}", fullmatch=True))
def test_any_text_is_parsed_or_gives_a_named_error(text: str) -> None:
    check_error(functools.partial(FramePattern, text))
    for option in command_of("render", Render).params:
        if isinstance(option.type, Parsed):
            check_error(functools.partial(option.type.convert, text, option, None))
