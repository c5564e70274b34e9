"""What an installation promises: a light import, the command, its data, and examples in docstrings that run."""

import doctest
import importlib
import importlib.metadata
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import torchdof

MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(torchdof.__path__, "torchdof.")
    if module.name != "torchdof.__main__"
)


def test_import_stays_light() -> None:
    heavy = ("scipy", "onnx", "onnxruntime", "onnxscript", "OpenImageIO", "matplotlib", "typer", "rich")
    code = f"import sys, torchdof; print([name for name in {heavy!r} if name in sys.modules])"
    run = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize("name", ["torchdof", *MODULES])
def test_examples_in_docstrings_run(name: str) -> None:
    failed, _ = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert failed == 0


def test_public_names_have_an_example() -> None:
    without = [name for name in torchdof.__all__ if ">>>" not in (getattr(torchdof, name).__doc__ or "")]
    assert without == []


def test_tables_and_type_information_are_installed() -> None:
    folder = Path(torchdof.__file__).parent
    assert (folder / "py.typed").is_file()
    assert (folder / "optics" / "tables" / "sato_j15.json").is_file()


def test_command_is_installed() -> None:
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name="torchdof")
    assert entry.value == "torchdof.cli.main:main"
    assert callable(entry.load())
