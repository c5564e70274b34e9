"""Tables, manifests, prescriptions, states and graphs as files that lie or want to run."""

import json
import pickle
import sys
from pathlib import Path
from typing import Any

import onnx
import pytest
import torch
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchdof import BlurTable, Camera, DepthOfField
from torchdof.cli.main import app
from torchdof.export import describe
from torchdof.fit import FitError, read_captures
from torchdof.fit.lens.lens import Lens
from torchdof.io.images import read_values

pytestmark = pytest.mark.hard

FUZZ = settings(
    max_examples=max(100, settings().max_examples // 5),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)

WHOLE_TABLE = json.dumps(
    BlurTable("ring", [0.1, 0.2], {"sigma": [0.1, 0.2], "r_c": [0.0, 0.1]}, unit="fraction").to_dict()
)


@FUZZ
@given(st.data())
def test_any_table_file_is_read_or_refused_by_name(tmp_path: Path, data: Any) -> None:
    path = tmp_path / "lens.json"
    fields = json.loads(WHOLE_TABLE)
    kind = data.draw(st.sampled_from(["bytes", "json", "fields", "cut", "changed"]))
    if kind == "bytes":
        path.write_bytes(data.draw(st.binary(max_size=60)))
    elif kind == "json":
        path.write_text(json.dumps(data.draw(JSON)))
    elif kind == "fields":
        wrong = data.draw(st.dictionaries(st.sampled_from([*fields, "sensor_width_mm", "other"]), JSON, max_size=3))
        path.write_text(json.dumps({**fields, **wrong}))
    elif kind == "cut":
        path.write_text(WHOLE_TABLE[: data.draw(st.integers(0, len(WHOLE_TABLE)))])
    else:
        place = data.draw(st.integers(0, len(WHOLE_TABLE) - 1))
        path.write_text(WHOLE_TABLE[:place] + data.draw(st.characters(codec="utf-8")) + WHOLE_TABLE[place + 1 :])
    try:
        table = BlurTable.load(path)
    except ValueError as error:
        assert "lens.json" in str(error)
    else:
        kernels = table.kernels(torch.tensor([-1.0, 1.0]), 10, size=5)
        assert torch.isfinite(kernels).all() and float(kernels.min()) >= 0


MANIFEST = """focus_m = 0.5
sharp = "sharp.png"
focal_length_mm = 50.0
dots = "one"
[[shot]]
file = "near.png"
distance_m = 0.4
"""

TOML_VALUES = st.one_of(
    st.floats().map(repr), st.integers(-(10**30), 10**30).map(str), st.booleans().map(lambda b: str(b).lower()),
    st.text(max_size=6).map(json.dumps), st.just("[]"), st.just("{}"), st.just("1979-05-27"), st.text(max_size=6),
)  # fmt: skip


@FUZZ
@given(st.integers(0, 7), TOML_VALUES, st.none() | st.integers(0, 120))
def test_any_manifest_is_refused_by_name(tmp_path: Path, line: int, value: str, cut: int | None) -> None:
    lines = MANIFEST.splitlines()
    if line < len(lines) and "=" in lines[line]:
        lines[line] = lines[line].partition("=")[0] + "= " + value
    else:
        lines.insert(line, f"{value} = {value}")
    (tmp_path / "capture.toml").write_bytes("\n".join(lines)[:cut].encode("utf-8", "surrogatepass"))
    # the pictures are not there: a manifest that is right ends in the name of one
    with pytest.raises((FitError, OSError, ValueError), match=r"capture\.toml|\.png|is not an image"):
        read_captures(tmp_path)


WHOLE_LENS = (Path(sys.modules[Lens.__module__].__file__ or "").parent / "lenses" / "wide_22mm.txt").read_text()


@FUZZ
@given(st.data())
def test_any_prescription_is_read_or_refused_by_name(tmp_path: Path, data: Any) -> None:
    path = tmp_path / "lens.txt"
    place = data.draw(st.integers(0, len(WHOLE_LENS) - 1))
    added = data.draw(st.text(max_size=4) | st.sampled_from(["nan", "-1", "inf", "1e999", "\n", "/0", "stop"]))
    cut = data.draw(st.integers(0, len(WHOLE_LENS)) | st.just(len(WHOLE_LENS)))
    text = (WHOLE_LENS[:place] + added + WHOLE_LENS[place + 1 :])[:cut]
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    try:
        Lens.read(path)
    except ValueError as error:
        assert "lens.txt" in str(error)


class Bomb:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.path,))


@pytest.mark.parametrize("suffix", [".json", ".toml", ".txt", ".npy", ".npz", ".png", ".exr", ".onnx"])
def test_a_pickle_under_any_name_is_not_run(tmp_path: Path, suffix: str) -> None:
    bomb = pickle.dumps(Bomb(tmp_path / "ran"))
    path = tmp_path / f"bomb{suffix}"
    path.write_bytes(bomb)
    readers = {".json": BlurTable.load, ".toml": read_captures, ".txt": Lens.read, ".onnx": describe}
    with pytest.raises((ValueError, OSError), match="bomb"):
        readers.get(suffix, read_values)(path)  # type: ignore[operator]
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("value", ["__import__('pathlib').Path('ran').touch()", "!!python/object:x", "[1, 2", "NaN"])
def test_metadata_of_an_onnx_file_are_data(tmp_path: Path, value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    node = onnx.helper.make_node("Identity", ["image"], ["out"])
    values = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1]) for name in ("image", "out")]
    model = onnx.helper.make_model(onnx.helper.make_graph([node], "g", values[:1], values[1:]))
    model.metadata_props.add(key="torchdof.options", value=value)
    onnx.save_model(model, tmp_path / "x.onnx")
    try:
        assert set(describe(tmp_path / "x.onnx")) == {"options"}
    except ValueError as error:
        assert str(error)
    assert not (tmp_path / "ran").exists()


def test_a_state_is_loaded_as_weights_only(tmp_path: Path) -> None:
    dof = DepthOfField(Camera(focus_m=1.5), BlurTable.load("sato_j15"))
    torch.save(dof.state_dict(), tmp_path / "dof.pt")
    other = DepthOfField(Camera())
    other.load_state_dict(torch.load(tmp_path / "dof.pt", weights_only=True))
    assert other.camera.focus_m == 1.5 and other.options.table.to_dict() == dof.options.table.to_dict()


# What `torchdof export --show` shows


def model_with(path: Path, facts: dict[str, str], external: str | None = None) -> None:
    """An ONNX file with these metadata and, if named, a tensor that lies in another file."""
    node = onnx.helper.make_node("Identity", ["image"], ["out"])
    values = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1]) for name in ("image", "out")]
    graph = onnx.helper.make_graph([node], "g", values[:1], values[1:])
    if external is not None:
        tensor = graph.initializer.add(name="w", data_type=onnx.TensorProto.FLOAT, dims=[1])
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value=external)
    model = onnx.helper.make_model(graph)
    for key, value in {"torchdof.options": "{}", **facts}.items():
        model.metadata_props.add(key=key, value=value)
    onnx.save_model(model, path)


@pytest.mark.parametrize(
    "text",
    ["\x1b[2J\x1b]0;title\x07", "line\nbreak\rback", "\u202edrow", "\x00\x08\x7f\x9b", "x" * 20_000],
    ids=["escape", "lines", "direction", "control", "long"],
)
def test_shown_metadata_cannot_steer_a_terminal_or_fill_it(tmp_path: Path, text: str) -> None:
    facts = {"torchdof.table": json.dumps({"name": text, text: 1}), f"torchdof.{text}": json.dumps(text)}
    model_with(tmp_path / "x.onnx", facts)
    result = CliRunner().invoke(app, ["export", "--show", str(tmp_path / "x.onnx")])
    assert result.exit_code == 0 and len(result.output) < 3000
    assert all(line.isprintable() for line in result.output.split("\n"))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ('"' + "x" * 2**20 + '"', "are more than torchdof.export writes"),
        ("[" * 50_000, "are not JSON"),
        ("9" * 10_000, "are not JSON"),
        ("{'a': 1}", "are not JSON"),
    ],
)
def test_metadata_that_no_export_writes_are_refused_by_name(tmp_path: Path, value: str, message: str) -> None:
    model_with(tmp_path / "x.onnx", {"torchdof.camera": value})
    with pytest.raises(ValueError, match=rf"x\.onnx: its metadata torchdof.camera {message}"):
        describe(tmp_path / "x.onnx")


def test_endless_metadata_are_refused(tmp_path: Path) -> None:
    model_with(tmp_path / "x.onnx", {f"torchdof.k{i}": "1" for i in range(1000)})
    with pytest.raises(ValueError, match="are more than torchdof.export writes"):
        describe(tmp_path / "x.onnx")


def test_describing_a_file_opens_no_other(tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(b"1234")
    model_with(tmp_path / "x.onnx", {}, external="secret")
    (tmp_path / "secret").unlink()
    assert describe(tmp_path / "x.onnx") == {"options": {}}
    model_with(tmp_path / "y.onnx", {}, external="/etc/passwd")
    assert describe(tmp_path / "y.onnx") == {"options": {}}


def test_an_onnx_file_larger_than_memory_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model_with(tmp_path / "x.onnx", {})
    monkeypatch.setattr("torchdof.export.metadata.free_bytes", lambda: 100.0)
    with pytest.raises(ValueError, match=r"x\.onnx takes .* more than there is memory for"):
        describe(tmp_path / "x.onnx")
