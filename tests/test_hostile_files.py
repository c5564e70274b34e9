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
