"""``verify`` refuses files that are damaged, not portable, or exported from another module."""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.helper
import onnx.numpy_helper
import pytest
from click.testing import CliRunner

import torchdof
from tests.files import store_model
from torchdof.cli.main import app
from torchdof.export import describe, verify
from torchdof.export.verification import _tensors


@pytest.fixture
def model(plain: Any) -> onnx.ModelProto:
    return onnx.load(plain.path)


def save(model: onnx.ModelProto, folder: Path) -> Path:
    onnx.save(model, folder / "other.onnx")
    return folder / "other.onnx"


OTHERS: dict[str, Any] = {"tolerance": 0.01, "max_coc_px": 5.0, "occlusion": True}
OTHERS |= {"table": torchdof.BlurTable.gaussian(), "camera": torchdof.Camera()}


@pytest.mark.parametrize("name", OTHERS)
def test_another_module_is_refused(plain: Any, name: str) -> None:
    options = {"camera": plain.dof.camera, **plain.dof.options.arguments(), name: OTHERS[name]}
    message = {"table": "table name=", "camera": "camera "}.get(name, f"options {name}=")
    with pytest.raises(ValueError, match=f"made with {message}"):
        verify(plain.path, torchdof.DepthOfField(**options))


@pytest.mark.parametrize("of_rays", [False, True], ids=["of a layer", "of rays"])
def test_a_changed_kernel_is_detected(of_rays: bool, plain: Any, model: onnx.ModelProto, tmp_path: Path) -> None:
    tensors = [t for t in _tensors(model.graph) if t.data_type == onnx.TensorProto.FLOAT]
    shaped = [t for t in tensors if (len(t.dims) == 2 and t.dims[0] == 1 if of_rays else len(t.dims) == 4)]
    kernel = max(shaped, key=lambda t: int(np.prod(t.dims)))
    values = onnx.numpy_helper.to_array(kernel).copy()
    if of_rays:  # one tensor has the kernels of all radii
        values *= 1.01
    else:
        values.flat[values.size // 2] *= 1.01
    kernel.CopyFrom(onnx.numpy_helper.from_array(values, kernel.name))
    with pytest.raises(ValueError, match=r"differs from the module by more than 1e-05(.|\n)*DIFFERS"):
        verify(save(model, tmp_path), plain.dof)


def test_unportable_is_refused(plain: Any, model: onnx.ModelProto, tmp_path: Path) -> None:
    domain, interface = copy.deepcopy(model), copy.deepcopy(model)
    domain.opset_import.append(onnx.helper.make_opsetid("com.microsoft", 1))
    interface.graph.input[0].type.tensor_type.shape.dim[2].dim_param = "height"
    external: dict[str, Any] = {"save_as_external_data": True, "convert_attribute": True, "size_threshold": 0}
    for changed, options, message in (
        (domain, {}, "needs operators of com.microsoft"),
        (interface, {}, "the graph must take and give"),
        (model, external | {"location": "weights.bin"}, "keeps weights in another file"),
    ):
        onnx.save(changed, tmp_path / "other.onnx", **options)
        with pytest.raises(ValueError, match=message):
            verify(tmp_path / "other.onnx", plain.dof)


def test_damaged_and_foreign_files_are_named(plain: Any, tmp_path: Path) -> None:
    (tmp_path / "cut.onnx").write_bytes(plain.path.read_bytes()[:5000])
    (tmp_path / "text.onnx").write_text("not a graph")
    for name in ("cut.onnx", "text.onnx"):
        with pytest.raises(ValueError, match=f"{name} is not an ONNX file"):
            verify(tmp_path / name, plain.dof)
    with pytest.raises(FileNotFoundError, match="there is no file"):
        verify(tmp_path / "none.onnx", plain.dof)


def test_metadata_describe_inputs_camera_table_and_options(plain: Any, model: onnx.ModelProto, tmp_path: Path) -> None:
    facts = describe(plain.path)
    assert model.producer_name == "torchdof" and model.producer_version == facts["version"]
    assert all("give NaN in their item" in facts["inputs"][name] for name in ("focus_m", "f_number"))
    assert "metres" in facts["inputs"]["depth"] and "linear light" in facts["output"]["out"]
    assert facts["camera"]["focal_length_mm"] == plain.dof.camera.focal_length_mm
    assert facts["table"]["family"] == "disc" and len(facts["table"]["sha256"]) == 64
    assert facts["options"]["tolerance"] == plain.dof.options.tolerance and facts["opset"] == 20
    del model.metadata_props[:]
    with pytest.raises(ValueError, match="not written by torchdof.export"):
        describe(save(model, tmp_path))


# Malicious metadata; tests/fuzz changes arbitrary bytes


@pytest.mark.parametrize(
    "text",
    ["\x1b[2J\x1b]0;title\x07", "line\nbreak\rback", "\u202edrow", "\x00\x08\x7f\x9b", "x" * 20_000],
    ids=["escape", "lines", "direction", "control", "long"],
)
def test_shown_metadata_have_no_control_characters_and_are_short(tmp_path: Path, text: str) -> None:
    facts = {"torchdof.table": json.dumps({"name": text, text: 1}), f"torchdof.{text}": json.dumps(text)}
    store_model(tmp_path / "x.onnx", facts)
    result = CliRunner().invoke(app, ["export", "--show", str(tmp_path / "x.onnx")])
    assert result.exit_code == 0 and len(result.output) < 3000
    assert all(line.isprintable() for line in result.output.split("\n"))


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({f"torchdof.k{i}": "1" for i in range(1000)}, r"torchdof.k\d+ are more than torchdof.export writes"),
        ({"torchdof.camera": '"' + "x" * 2**20 + '"'}, "torchdof.camera are more than torchdof.export writes"),
        *(({"torchdof.camera": value}, "torchdof.camera are not JSON")
          for value in ("[" * 50_000, "9" * 10_000, "__import__('pathlib').Path('ran').touch()")),
    ],
)  # fmt: skip
def test_foreign_metadata_are_not_executed_and_refused_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, facts: dict[str, str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    store_model(tmp_path / "x.onnx", facts)
    with pytest.raises(ValueError, match=rf"x\.onnx: its metadata {message}"):
        describe(tmp_path / "x.onnx")
    assert [path.name for path in tmp_path.iterdir()] == ["x.onnx"]


def test_describe_reads_no_other_file_and_none_larger_than_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for external in ("missing", "/etc/passwd"):
        store_model(tmp_path / "x.onnx", {}, external)
        assert describe(tmp_path / "x.onnx") == {"options": {}}
    monkeypatch.setattr("torchdof.export.metadata.free_bytes", lambda: 100.0)
    with pytest.raises(ValueError, match=r"x\.onnx takes .* more than there is memory for"):
        describe(tmp_path / "x.onnx")
