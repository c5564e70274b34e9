"""Malicious tables, manifests, prescriptions, states and graphs; tests/fuzz changes arbitrary bytes."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from tests.files import store_model
from torchdof.cli.main import app
from torchdof.export import describe

pytestmark = pytest.mark.hard


# Metadata shown by `torchdof export --show`


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
    ("value", "message"),
    [
        ('"' + "x" * 2**20 + '"', "are more than torchdof.export writes"),
        ("[" * 50_000, "are not JSON"),
        ("9" * 10_000, "are not JSON"),
        ("__import__('pathlib').Path('ran').touch()", "are not JSON"),
    ],
    ids=lambda text: text[:12],
)
def test_foreign_metadata_are_not_executed_and_refused_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    store_model(tmp_path / "x.onnx", {"torchdof.camera": value})
    with pytest.raises(ValueError, match=rf"x\.onnx: its metadata torchdof.camera {message}"):
        describe(tmp_path / "x.onnx")
    assert [path.name for path in tmp_path.iterdir()] == ["x.onnx"]


def test_too_many_metadata_are_refused(tmp_path: Path) -> None:
    store_model(tmp_path / "x.onnx", {f"torchdof.k{i}": "1" for i in range(1000)})
    with pytest.raises(ValueError, match="are more than torchdof.export writes"):
        describe(tmp_path / "x.onnx")


def test_describe_opens_no_other_file(tmp_path: Path) -> None:
    for external in ("missing", "/etc/passwd"):
        store_model(tmp_path / "x.onnx", {}, external)
        assert describe(tmp_path / "x.onnx") == {"options": {}}


def test_an_onnx_file_larger_than_memory_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store_model(tmp_path / "x.onnx", {})
    monkeypatch.setattr("torchdof.export.metadata.free_bytes", lambda: 100.0)
    with pytest.raises(ValueError, match=r"x\.onnx takes .* more than there is memory for"):
        describe(tmp_path / "x.onnx")
