"""An installation has the command and its data, and the examples in docstrings run."""

import doctest
import importlib
import importlib.metadata
from typing import Any

import pytest
from click.testing import CliRunner

import torchdof
from tests.test_imports import FILES
from tests.traced import TRACED
from torchdof.cli.main import app


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[TRACED] if n == "torchdof.export.conversion" else []) for n in FILES if "__" not in n],
)
def test_examples_in_docstrings_run(name: str, request: pytest.FixtureRequest) -> None:
    names: dict[str, Any] = {}
    if name == "torchdof.export.conversion":  # the result is that of another file, because tracing takes long
        names["to_onnx"] = lambda dof, path: request.getfixturevalue("plain").verification
    failed, _ = doctest.testmod(
        importlib.import_module(name), None, extraglobs=names, optionflags=doctest.NORMALIZE_WHITESPACE
    )
    assert failed == 0


def test_public_names_have_an_example() -> None:
    without = [name for name in torchdof.__all__ if ">>>" not in (getattr(torchdof, name).__doc__ or "")]
    assert without == []


def test_command_is_installed_and_its_version_shows_the_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name="torchdof")
    assert entry.value == "torchdof.cli.main:main"
    assert callable(entry.load())
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    printed = CliRunner().invoke(app, ["--version"]).output
    assert printed.startswith(f"torchdof {importlib.metadata.version('torchdof')}, engine torch (")
