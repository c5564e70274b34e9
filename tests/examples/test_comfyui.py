"""The node for ComfyUI, loaded, checked and run in ComfyUI's way, without ComfyUI."""

import importlib.util
import inspect
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.refused import refuses
from torchdof import BlurTable, Camera, depth_of_field
from torchdof.depth import from_relative
from torchdof.io.transfer import decode, encode
from torchdof.optics.aperture import Aperture

FOLDER = Path(__file__).parents[2] / "examples" / "comfyui"
TYPES = {"IMAGE", "MASK", "INT", "FLOAT", "STRING", "BOOLEAN", "MOGE_GEOMETRY", "DA3_GEOMETRY"}


def loaded() -> ModuleType:
    """As ComfyUI's ``load_custom_node``: the folder is a package whose name is its path."""
    name = str(FOLDER).replace(".", "_x_")
    spec = importlib.util.spec_from_file_location(name, FOLDER / "__init__.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


PACKAGE = loaded()
(NODE,) = PACKAGE.NODE_CLASS_MAPPINGS.values()
INPUTS: dict[str, Any] = NODE.INPUT_TYPES()["required"]
DEFAULTS = {  # that ComfyUI's page starts with: the first of a list, or the input's default
    name: kind[0] if isinstance(kind, list) else extra[0]["default"]
    for name, (kind, *extra) in INPUTS.items()
    if isinstance(kind, list) or extra[0].get("default") is not None
}


def scene() -> tuple[Tensor, Tensor]:
    return torch.rand(2, 18, 24, 3), torch.rand(2, 18, 24, 1).expand(-1, -1, -1, 3)


def render(image: Tensor, depth: Any, **changes: Any) -> tuple[Tensor, Tensor]:
    """As ComfyUI's ``execution``: a new node, its FUNCTION by name, inputs by keyword."""
    given = {"sensor_width_mm": 4.0, **changes}
    out = getattr(NODE(), NODE.FUNCTION)(image=image, depth=depth, **{**DEFAULTS, **given})
    assert isinstance(out, tuple) and len(out) == len(NODE.RETURN_TYPES) == len(NODE.RETURN_NAMES)
    for pixels, kind in zip(out, NODE.RETURN_TYPES, strict=True):
        assert kind == "IMAGE" and pixels.ndim == 4 and pixels.dtype == torch.float32
        assert 0.0 <= float(pixels.min()) and float(pixels.max()) <= 1.0
    return out


def test_the_folder_is_a_custom_node_with_inputs_by_comfyuis_rules() -> None:
    assert set(PACKAGE.NODE_DISPLAY_NAME_MAPPINGS) == set(PACKAGE.NODE_CLASS_MAPPINGS)
    assert isinstance(NODE.CATEGORY, str) and set(NODE.INPUT_TYPES()) <= {"required", "optional", "hidden"}
    assert (FOLDER / "requirements.txt").read_text().split() == ["torchdof"]
    for kind, *extra in INPUTS.values():
        assert all(isinstance(value, str) for value in kind) if isinstance(kind, list) else {*kind.split(",")} <= TYPES
        if kind == "FLOAT":
            assert extra[0]["min"] <= extra[0]["default"] <= extra[0]["max"] and extra[0]["step"] > 0
    assert list(inspect.signature(getattr(NODE, NODE.FUNCTION)).parameters) == ["self", *INPUTS]


CHANGES: list[tuple[dict[str, Any], BlurTable]] = [
    *(({"depth_kind": kind}, BlurTable.disc()) for kind in ("white is near", "white is far")),
    *(({"lens": name}, BlurTable.load(name)) for name in INPUTS["lens"][0][2:]),
    ({"lens": "gaussian"}, BlurTable.gaussian()),
    ({"shape": "5 blades", "rotation_deg": 10.0}, BlurTable.polygon(5, 10.0)),
    ({"squeeze": 2.0}, BlurTable.disc().replace(aperture=Aperture(squeeze=2.0))),
]


@pytest.mark.parametrize(("changes", "table"), CHANGES)
def test_it_renders_the_same_picture_as_torchdof(changes: dict[str, Any], table: BlurTable) -> None:
    kind: Any = "depth" if changes.get("depth_kind") == "white is far" else "disparity"
    image, depth = scene()
    out, _ = render(image, depth, focus="metres", focus_m=1.5, **changes)
    light = decode(image.movedim(-1, 1), "srgb", False, False)
    values = depth[..., :1].movedim(-1, 1)
    metres = from_relative(values, 1.0, 10.0, kind, value_range=(float(values.min()), float(values.max())))
    blurred = depth_of_field(light, metres, Camera(50.0, 1.8, 1.5, 4.0), table=table)
    expected = encode(blurred, "srgb", False, False).clamp(0, 1)
    torch.testing.assert_close(out, expected.movedim(1, -1), rtol=1e-5, atol=1e-5)


def test_the_point_of_focus_is_sharp() -> None:
    image, depth = torch.rand(1, 18, 24, 3), torch.full((1, 18, 24, 3), 2.0)
    depth[:, :, 12:] = 5.0
    changes = {"depth_kind": "metres", "focus": "point", "focus_y": 1.0}
    left, near = render(image, depth, focus_x=0.1, **changes)
    right, far = render(image, depth, focus_x=1.0, **changes)
    torch.testing.assert_close(left[:, :, :6], image[:, :, :6], rtol=0.0, atol=1e-3)
    assert float((right[:, :, :6] - image[:, :, :6]).abs().max()) > 0.05
    assert not torch.equal(near, far)


def test_a_smaller_depth_map_a_shared_one_and_alpha_are_accepted() -> None:
    image = torch.rand(2, 18, 24, 4)
    out, focus = render(image.half(), torch.rand(1, 9, 12, 3).half())
    assert out.shape == (2, 18, 24, 4) and focus.shape == (2, 18, 24, 3)


def test_a_square_map_is_stretched_with_a_warning() -> None:
    image, depth = torch.rand(1, 18, 24, 3), torch.full((1, 18, 18, 1), 2.0)
    depth[:, :, 9:] = 5.0
    with pytest.warns(UserWarning, match=r"depth of 18 x 18 px stretched by 33\.3% to the shape of the image"):
        out, _ = render(image, depth, depth_kind="metres", focus_x=0.1)
    torch.testing.assert_close(out[:, :, :8], image[:, :, :8], rtol=0.0, atol=1e-3)
    assert float((out - image)[:, :, 16:].abs().max()) > 0.05


def near_and_far() -> tuple[Tensor, Tensor]:
    """An image, and depth in metres ``[1, 18, 24]`` of a post at 2 m before a wall at 5 m."""
    depth = torch.full((1, 18, 24), 5.0)
    depth[:, :, 8:16] = 2.0
    return torch.rand(1, 18, 24, 3), depth


def test_a_mask_and_the_geometries_of_comfyuis_own_nodes_are_depth_too() -> None:
    image, depth = near_and_far()
    expected = render(image, depth[..., None].expand(-1, -1, -1, 3), depth_kind="metres")
    kinds: dict[str, Any] = {"mask": depth, "one mask": depth[0], "MoGe": {"depth": depth, "image": image}}
    kinds["Depth Anything 3"] = {"depth": depth, "mode": "mono", "sky": torch.zeros_like(depth)}
    for given in kinds.values():
        for out, same in zip(render(image, given, depth_kind="metres"), expected, strict=True):
            torch.testing.assert_close(out, same, rtol=0.0, atol=0.0)
    sky = torch.zeros_like(depth, dtype=torch.bool)
    sky[:, :6] = True
    infinite = render(image, torch.where(sky, torch.inf, depth), depth_kind="metres")
    for given in ({"depth": depth, "mask": ~sky}, {"depth": depth, "sky": sky.float(), "mode": "mono"}):
        assert torch.equal(render(image, given, depth_kind="metres")[0], infinite[0])


def test_a_geometry_is_scaled_to_near_and_far_for_both_kinds_of_white() -> None:
    image, depth = near_and_far()
    expected = render(image, 0.1 * depth, depth_kind="white is far")
    for kind in ("white is near", "white is far"):
        assert torch.equal(render(image, {"depth": 0.1 * depth}, depth_kind=kind)[0], expected[0])


@pytest.mark.parametrize("kind", ["metres", "white is near", "white is far"])
@pytest.mark.parametrize("hole", [0.0, torch.nan, torch.inf, -torch.inf])
def test_pixels_without_depth_take_that_of_the_surface_behind_them(kind: str, hole: float) -> None:
    image, depth = near_and_far()
    values = 1.0 / depth if kind == "white is near" else depth
    full = render(image, values, depth_kind=kind, focus="metres")[0]
    holes = torch.zeros_like(depth, dtype=torch.bool)
    holes[:, 3:5, 2:5] = True
    out = render(image, torch.where(holes, hole, values), depth_kind=kind, focus="metres")[0]
    if not (hole == 0.0 and kind != "metres") and (kind, hole) != ("metres", torch.inf):  # those are depths
        assert torch.equal(out, full)


test_depth_that_does_not_fit_is_refused_in_one_sentence = refuses(
    (lambda: render(scene()[0], torch.rand(3, 18, 24, 3)), "one for each of the 2 images, got 3"),
    (lambda: render(scene()[0], torch.ones(1, 18, 24, 3)), "got 1 everywhere"),
    (lambda: render(scene()[0], torch.zeros(1, 18, 24), depth_kind="metres"), "depth has no pixel with a depth"),
    (lambda: render(scene()[0], {"image": scene()[0]}), "the geometry has no depth"),
    (lambda: render(scene()[0] / 0.0, scene()[1]), "image has pixels that are NaN or infinite"),
)


def test_the_workflow_is_valid_for_the_node() -> None:
    """What ComfyUI's page checks when it opens a workflow: types, sockets, links and the values of all widgets."""
    workflow = json.loads((FOLDER / "workflow.json").read_text())
    nodes = {each["id"]: each for each in workflow["nodes"]}
    (ours,) = (each for each in nodes.values() if each["type"] == "TorchdofDepthOfField")
    assert [each["name"] for each in ours["inputs"]] == [name for name in INPUTS if name not in DEFAULTS]
    assert [each["name"] for each in ours["outputs"]] == list(NODE.RETURN_NAMES)
    assert ours["widgets_values"] == list(DEFAULTS.values())
    for number, source, of_source, target, of_target, kind in workflow["links"]:
        assert number in nodes[source]["outputs"][of_source]["links"]
        assert number == nodes[target]["inputs"][of_target]["link"]
        assert kind == nodes[source]["outputs"][of_source]["type"] == nodes[target]["inputs"][of_target]["type"]
    assert workflow["last_node_id"] == max(nodes) and workflow["last_link_id"] == max(k for k, *_ in workflow["links"])


def test_comfyuis_progress_bar_moves_with_every_image(monkeypatch: pytest.MonkeyPatch) -> None:
    moved: list[int] = []

    class ProgressBar:
        def __init__(self, total: int) -> None:
            moved.append(-total)

        def update(self, step: int) -> None:
            moved.append(step)

    utils = ModuleType("comfy.utils")
    utils.ProgressBar = ProgressBar  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "comfy", ModuleType("comfy"))
    monkeypatch.setitem(sys.modules, "comfy.utils", utils)
    render(*scene())
    assert moved == [-2, 1, 1]
