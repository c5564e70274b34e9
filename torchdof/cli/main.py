"""The command line. Each command lives in a module of its own, which is imported when the command is asked for."""

import importlib
import importlib.util
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

from .errors import advice, told_in_one_sentence

__all__ = ["app", "main"]

# Each module defines a function of the command's name, with the options as Typer reads them off its signature.
_MODULES = {
    "render": "torchdof.cli.render",
    "fit": "torchdof.cli.fit",
    "export": "torchdof.cli.export",
    "bench": "torchdof.cli.bench",
}


class _Commands(TyperGroup):
    """The commands that are installed."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [name for name in _MODULES if _installed(name)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in _MODULES or not _installed(cmd_name):
            return None
        single = typer.Typer(add_completion=False, rich_markup_mode="markdown")
        try:
            function = getattr(importlib.import_module(_MODULES[cmd_name]), cmd_name)
        except ModuleNotFoundError as error:
            message = advice(error)

            def function() -> None:
                raise ValueError(message)

            single.command(cmd_name, help=message)(function)
        else:
            single.command(cmd_name, no_args_is_help=cmd_name == "render")(function)
        return typer.main.get_command(single)

    def invoke(self, ctx: Any) -> Any:
        with told_in_one_sentence():
            return super().invoke(ctx)


app = typer.Typer(cls=_Commands, no_args_is_help=True, pretty_exceptions_enable=False)


@app.callback()
def _torchdof() -> None:
    """Depth of field from an image and its depth: the photograph that a real lens would have taken."""


def _installed(name: str) -> bool:
    package, _, module = _MODULES[name].rpartition(".")
    spec = importlib.util.find_spec(package)  # finds the package without running it
    folders = spec.submodule_search_locations if spec is not None else None
    return any((Path(folder) / f"{module}.py").is_file() for folder in folders or [])


def main() -> None:
    """Entry point of ``torchdof`` and of ``python -m torchdof``."""
    app(prog_name="torchdof")
