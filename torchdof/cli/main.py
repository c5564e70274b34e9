"""The command line: each command is imported when it is asked for, and what is wrong with the input is one sentence."""

import contextlib
import errno
import importlib
import importlib.metadata
import os
import sys
from collections.abc import Iterator
from typing import Any

import click

from ..io.atomic import unwound_on_termination
from .command import command_of

__all__ = ["app", "main"]

COMMANDS = ("render", "fit", "export", "bench", "inspect", "tables")
"""Each is a class in the module of its name."""

_EXTRAS = {
    **{"scipy": "fit", "threadpoolctl": "fit", "matplotlib": "plot"},
    **{"onnx": "export", "onnxscript": "export", "onnxruntime": "export"},
}
_TOO_LITTLE = "there is too little memory for this image; a smaller one, or a coarser --tolerance, takes less"
# PyTorch's own words for it on the CPU are those of what it is built from
_NO_MEMORY = ("can't allocate memory", "not enough memory", "bad_alloc", "size calculation overflowed", "new thread")


@contextlib.contextmanager
def _told_in_one_sentence() -> Iterator[None]:
    """Ends with code 2 and the message of errors of the input, files, memory and missing packages; others pass."""
    try:
        yield
        return
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _EXTRAS:
            raise
        message = f"this command needs {package}; install it with: pip install 'torchdof[{_EXTRAS[package]}]'"
    except (OSError, ValueError) as error:
        if isinstance(error, OSError) and error.errno == errno.EPIPE:
            raise
        message = str(error) or type(error).__name__
    except MemoryError:  # numpy's has a message of its own, about arrays
        message = _TOO_LITTLE
    except RuntimeError as error:
        torch = sys.modules.get("torch")  # whoever ran out of a device's memory has imported it
        if torch is not None and isinstance(error, torch.OutOfMemoryError):
            message = "the device has too little memory for this image; try --device cpu"
        elif any(words in str(error) for words in _NO_MEMORY):
            message = _TOO_LITTLE
        else:
            raise
    with contextlib.suppress(OSError):  # who cannot be told still gets the code
        click.echo(f"error: {message}", err=True)
    raise SystemExit(2)


class _Commands(click.Group):
    """The commands."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f".{cmd_name}", __package__)
        return command_of(cmd_name, getattr(module, cmd_name.capitalize()))

    def invoke(self, ctx: click.Context) -> object:
        with _told_in_one_sentence():
            return super().invoke(ctx)


def _print_version(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted:
        from .. import native  # takes PyTorch

        click.echo(f"torchdof {importlib.metadata.version('torchdof')}, engine {native.describe()}")
        ctx.exit()


_VERSION: dict[str, Any] = {"is_flag": True, "is_eager": True, "expose_value": False, "callback": _print_version}


@click.group(cls=_Commands, context_settings={"max_content_width": 120})
@click.option("--version", **_VERSION, help="Print the version and the engine in use.")
def app() -> None:
    """Depth of field from an image and its depth: the photograph that a real lens would have taken."""


def _open_streams() -> None:
    """Opens what is closed of standard input, output and error as nothing: no file may take its place, and messages."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # takes the lowest free number, which is the stream's own


def main() -> None:
    """Entry point of ``torchdof`` and of ``python -m torchdof``."""
    # PyTorch's threads (OpenMP's) wait for their next work without a rest, which takes the processor from whoever has
    # some. GNU's library and LLVM's read these when PyTorch is loaded; what the user set is left as it is.
    if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME"} & set(os.environ):
        os.environ |= {"OMP_WAIT_POLICY": "passive", "KMP_BLOCKTIME": "0"}
    _open_streams()
    with unwound_on_termination():
        app(prog_name="torchdof")
