"""The command line. Each command lives in a module of its own, which is imported when the command runs."""

import ast
import importlib
import importlib.metadata
import importlib.util
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from .errors import advice, told_in_one_sentence

__all__ = ["app", "main"]

# Each module defines a function of the command's name, with the options as Typer reads them off its signature.
_MODULES = {
    "render": "torchdof.cli.render",
    "fit": "torchdof.cli.fit",
    "export": "torchdof.cli.export",
    "bench": "torchdof.cli.bench",
    "inspect": "torchdof.cli.inspect",
    "tables": "torchdof.cli.tables",
}


class _Commands(TyperGroup):
    """The commands that are installed. The list of them is read, not imported: it is there at once."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [name for name in _MODULES if _source(name) is not None]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """What the list shows of a command: its name and the first paragraph of its help."""
        source = _source(cmd_name)
        return None if source is None else TyperCommand(cmd_name, help=_summary(source, cmd_name))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command itself, for which its module is imported."""
        name, _, remaining = super().resolve_command(ctx, args)
        return name, _imported(str(name)), remaining

    def invoke(self, ctx: Any) -> Any:
        with told_in_one_sentence():
            return super().invoke(ctx)


app = typer.Typer(cls=_Commands, no_args_is_help=True, pretty_exceptions_enable=False)


@app.callback(invoke_without_command=True)
def _torchdof(
    version: Annotated[bool, typer.Option("--version", help="Print the version and the engine in use.")] = False,
) -> None:
    """Depth of field from an image and its depth: the photograph that a real lens would have taken."""
    if version:
        from .. import native  # takes PyTorch

        print(f"torchdof {importlib.metadata.version('torchdof')}, engine {native.describe()}")
        raise typer.Exit()


def _source(name: str) -> Path | None:
    """The file of a command's module; None where there is no such command, or it is not installed."""
    package, _, module = _MODULES.get(name, "").rpartition(".")
    spec = importlib.util.find_spec(package) if package else None
    folders = spec.submodule_search_locations if spec is not None else None
    files = [Path(folder) / f"{module}.py" for folder in folders or []]
    return next((file for file in files if file.is_file()), None)


def _summary(source: Path, name: str) -> str:
    """First paragraph of the docstring of a function, from its source."""
    for node in ast.parse(source.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            return (ast.get_docstring(node) or "").partition("\n\n")[0]
    return ""


def _imported(name: str) -> Any:
    """The command of a name, imported; where a package is missing, one that says what to install."""
    single = typer.Typer(add_completion=False, rich_markup_mode="markdown")
    try:
        function = getattr(importlib.import_module(_MODULES[name]), name)
    except ModuleNotFoundError as error:
        message = advice(error)

        def function() -> None:
            raise ValueError(message)

        single.command(name, help=message)(function)
    else:
        single.command(name, no_args_is_help=name in ("render", "inspect"))(function)
    return typer.main.get_command(single)


def main() -> None:
    """Entry point of ``torchdof`` and of ``python -m torchdof``."""
    app(prog_name="torchdof")
