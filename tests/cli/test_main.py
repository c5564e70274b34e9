"""Which commands there are, and what is said of one that cannot run."""

import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from torchdof.cli import main
from torchdof.cli.arguments import DEPTH, LENS
from torchdof.cli.main import app


def other_command(monkeypatch: pytest.MonkeyPatch, folder: Path, text: str) -> None:
    """Installs a module ``extra_room.command`` that brings the command ``fit``."""
    package = folder / "extra_room"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "command.py").write_text(text)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(main, "_MODULES", {**main._MODULES, "fit": "extra_room.command"})
    monkeypatch.delitem(sys.modules, "extra_room", raising=False)
    monkeypatch.delitem(sys.modules, "extra_room.command", raising=False)


def test_commands_of_other_modules_join_by_being_there(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    other_command(
        monkeypatch, tmp_path, 'def fit(name: str) -> None:\n    "Fits a table."\n    print("fitted", name)\n'
    )
    assert "Fits a table." in CliRunner().invoke(app, ["--help"]).output
    assert CliRunner().invoke(app, ["fit", "lens"]).stdout == "fitted lens\n"


def test_commands_of_modules_that_are_not_there_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(main, "_MODULES", {**main._MODULES, "fit": "no_room.command", "bench": "torchdof.no_bench"})
    result = CliRunner().invoke(app, ["--help"])
    assert "render" in result.output and "bench" not in result.output
    assert CliRunner().invoke(app, ["fit"]).exit_code == 2


def test_command_whose_package_is_missing_says_which_extra_brings_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    other_command(monkeypatch, tmp_path, "import scipy\n\n\ndef fit() -> None:\n    pass\n")
    monkeypatch.setitem(sys.modules, "scipy", None)
    result = CliRunner().invoke(app, ["fit"])
    assert result.exit_code == 2
    assert "this command needs scipy; install it with: pip install 'torchdof[fit]'" in result.stderr


def test_an_option_means_the_same_in_all_commands() -> None:
    commands = {name: main._imported(name) for name in main._MODULES if main._source(name)}
    meanings: dict[str, dict[str, str]] = {}  # option -> parameter -> a command that has it
    spellings: dict[str, dict[str, str]] = {}  # parameter -> options -> a command that has it
    for command, parsed in commands.items():
        for parameter in parsed.params:
            if parameter.opts[0].startswith("-"):
                spellings.setdefault(parameter.name, {})[" ".join(sorted(parameter.opts))] = command
                for option in parameter.opts:
                    meanings.setdefault(option, {})[parameter.name] = command
    assert {option: means for option, means in meanings.items() if len(means) > 1} == {}
    assert {parameter: options for parameter, options in spellings.items() if len(options) > 1} == {}
    assert all("--json" in {option for p in parsed.params for option in p.opts} for parsed in commands.values())


def test_what_renders_and_what_measures_take_the_same_lens_depth_and_blur() -> None:
    commands = {name: main._imported(name) for name in ("render", "inspect", "bench", "export", "tables")}
    options = {name: {p.name: p.rich_help_panel for p in command.params} for name, command in commands.items()}
    told = {name for name, panel in options["render"].items() if panel in (LENS, DEPTH)}
    told -= {"depth_edges", "steady", "strict"}  # what is done with it
    shape = {"blades", "rotation", "curvature", "squeeze", "aperture"}
    assert told <= set(options["inspect"]) and told <= set(options["bench"])
    for name in ("render", "bench", "tables"):
        assert shape | {"vignetting"} <= set(options[name]), name
    assert shape | {"table"} <= set(options["export"]) and "table" in options["bench"]
