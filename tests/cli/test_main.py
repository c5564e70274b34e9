"""The list of commands, the names and meanings of their options, and errors before a command starts."""

import os
import sys
from collections.abc import Callable

import click
import pytest

from torchdof.cli import main
from torchdof.cli.export import Export
from torchdof.cli.main import COMMANDS, app

PARSED = {name: command for name in COMMANDS if (command := app.get_command(click.Context(app), name))}


def test_help_lists_every_command_with_its_purpose(run: Callable[..., str]) -> None:
    listed = " ".join(run("--help").split())
    assert list(PARSED) == list(COMMANDS) and len(COMMANDS) == 6
    assert all(f"{name} {command.short_help}" in listed for name, command in PARSED.items())


def test_help_of_a_command_has_examples_and_puts_the_basic_options_first(run: Callable[..., str]) -> None:
    text = " ".join(run("render --help").split())
    for example in ("torchdof render shot.exr -o out.exr", "--focus-m 1:2,48:5.5", "--depth-kind disparity"):
        assert example in text
    basic, groups = text.partition("Options: ")[2].partition("Focus and lens: ")[::2]
    assert all(f"{option} " in basic for option in ("--out", "--focus-m", "--f-number", "--depth-scale", "--tolerance"))
    assert groups.index("--tilt ") < groups.index("Depth map: ") < groups.index("--near-m ") < groups.index("Blur: ")


def test_an_option_means_the_same_in_all_commands() -> None:
    meanings: dict[str, dict[str | None, str]] = {}  # option -> parameter -> a command that has it
    spellings: dict[str | None, dict[str, str]] = {}  # parameter -> options -> a command that has it
    for name, command in PARSED.items():
        for parameter in (each for each in command.params if isinstance(each, click.Option)):
            spellings.setdefault(parameter.name, {})[" ".join(sorted(parameter.opts))] = name
            for option in parameter.opts:
                meanings.setdefault(option, {})[parameter.name] = name
    assert {option: means for option, means in meanings.items() if len(means) > 1} == {}
    assert {parameter: options for parameter, options in spellings.items() if len(options) > 1} == {}
    assert all("--json" in {option for p in command.params for option in p.opts} for command in PARSED.values())


def test_defaults_equal_those_of_the_library() -> None:
    from torchdof.export.conversion import OPSET
    from torchdof.fit.photo.target import SQUARE_MM

    defaults = {name: {p.name: p.default for p in PARSED[name].params} for name in ("export", "fit")}
    assert (defaults["export"]["opset"], defaults["fit"]["square_mm"]) == (OPSET, SQUARE_MM)


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch, run: Callable[..., str]) -> None:
    def missing(self: Export) -> None:
        import scipy  # noqa: F401

    monkeypatch.setitem(sys.modules, "scipy", None)
    monkeypatch.setattr(Export, "run", missing)
    expected = "this command needs scipy; in the folder of torchdof's source, run: pip install '.[fit]'"
    assert expected in run("export", code=2)


@pytest.mark.parametrize("place", ["importlib.import_module", "torchdof.bench.speed.compare"])
def test_ctrl_c_gives_one_word_and_code_130(
    place: str, run: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(place, stop)
    assert run("bench", code=130) == "interrupted\n"


@pytest.mark.parametrize("variables", [{}, {"GOMP_SPINCOUNT": "77"}, {"OMP_WAIT_POLICY": "active"}], ids=str)
def test_waiting_threads_do_not_spin_unless_asked(variables: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """PyTorch, whose libraries read these variables, is not loaded before: tests/test_imports.py."""
    names = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")
    environment = {name: value for name, value in os.environ.items() if name not in names} | variables
    monkeypatch.setattr(os, "environ", environment)
    monkeypatch.setattr(main, "app", lambda **_: None)
    main.main()
    found = {name: environment[name] for name in names if name in environment}
    assert found == (variables or {"OMP_WAIT_POLICY": "passive", "KMP_BLOCKTIME": "0"})
