"""The command line. Each command lives in a module of its own, which is imported when it is asked for."""

import importlib
import importlib.metadata
import os
import signal
from types import FrameType

import click

from .command import command_of
from .errors import told_in_one_sentence

__all__ = ["app", "main"]

COMMANDS = ("render", "fit", "export", "bench", "inspect", "tables")
"""Each is a class in the module of its name."""


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
        with told_in_one_sentence():
            return super().invoke(ctx)


def _print_version(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted:
        from .. import native  # takes PyTorch

        click.echo(f"torchdof {importlib.metadata.version('torchdof')}, engine {native.describe()}")
        ctx.exit()


@click.group(cls=_Commands, context_settings={"max_content_width": 120})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_version,
    help="Print the version and the engine in use.",
)
def app() -> None:
    """Depth of field from an image and its depth: the photograph that a real lens would have taken."""


def _end(number: int, _: FrameType | None) -> None:
    """Ends the process as Ctrl-C does: what is being written is completed, or vanishes."""
    raise SystemExit(128 + number)


def main() -> None:
    """Entry point of ``torchdof`` and of ``python -m torchdof``."""
    # PyTorch's threads (OpenMP's) wait for their next work without a rest, which takes the processor from whoever has
    # some. GNU's library and LLVM's read these when PyTorch is loaded; what the user set is left as it is.
    if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME"} & set(os.environ):
        os.environ |= {"OMP_WAIT_POLICY": "passive", "KMP_BLOCKTIME": "0"}
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) == signal.SIG_DFL:
            signal.signal(getattr(signal, name), _end)
    app(prog_name="torchdof")
