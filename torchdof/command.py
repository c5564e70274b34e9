"""The command line. Each command lives in a module of its own, which is imported when the command is asked for."""

import errno
import importlib
import importlib.util
from pathlib import Path
from typing import Any

import torch
import typer
from rich.console import Console
from typer.core import TyperGroup

from . import memory

__all__ = ["app", "main"]

# Each module defines a function of the command's name, with the options as Typer reads them off its signature.
_MODULES = {
    "render": "torchdof.render_command",
    "fit": "torchdof.fit.command",
    "export": "torchdof.export.command",
    "bench": "torchdof.bench",
}
_EXTRAS = {"scipy": "fit", "onnx": "export", "onnxscript": "export", "onnxruntime": "export", "matplotlib": "plot"}


class _Commands(TyperGroup):
    """The commands that are installed; whatever is wrong with the input ends in one sentence and exit code 2."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [name for name in _MODULES if _installed(name)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in _MODULES or not _installed(cmd_name):
            return None
        single = typer.Typer(add_completion=False, rich_markup_mode="markdown")
        try:
            function = getattr(importlib.import_module(_MODULES[cmd_name]), cmd_name)
        except ModuleNotFoundError as error:
            message = _advice(error)

            def function() -> None:
                raise ValueError(message)

            single.command(cmd_name, help=message)(function)
        else:
            single.command(cmd_name, no_args_is_help=cmd_name == "render")(function)
        return typer.main.get_command(single)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except ModuleNotFoundError as error:
            message = _advice(error)
        except torch.OutOfMemoryError:
            message = "the device has too little memory for this image; try --device cpu"
        except OSError as error:
            if error.errno == errno.EPIPE:
                raise
            message = str(error)
        except (ValueError, MemoryError) as error:
            message = str(error) or "there is too little memory for this image"
        Console(stderr=True).print(f"error: {message}", markup=False, highlight=False, soft_wrap=True)
        raise typer.Exit(2)


app = typer.Typer(cls=_Commands, no_args_is_help=True, pretty_exceptions_enable=False)


@app.callback()
def _torchdof() -> None:
    """Depth of field from an image and its depth: the photograph that a real lens would have taken."""


def _installed(name: str) -> bool:
    package, _, module = _MODULES[name].rpartition(".")
    spec = importlib.util.find_spec(package)  # finds the package without running it
    folders = spec.submodule_search_locations if spec is not None else None
    return any((Path(folder) / f"{module}.py").is_file() for folder in folders or [])


def _advice(error: ModuleNotFoundError) -> str:
    package = (error.name or "").partition(".")[0]
    if package not in _EXTRAS:
        raise error
    return f"this command needs {package}; install it with: pip install 'torchdof[{_EXTRAS[package]}]'"


def main() -> None:
    """Entry point of ``torchdof`` and of ``python -m torchdof``."""
    memory.keep_freed()
    app(prog_name="torchdof")
