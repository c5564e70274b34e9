"""The command line; it imports a command when that is called, and reports wrong input in one sentence."""

import importlib
import importlib.metadata
import os
import re
import sys

import click

from ..extras import missing
from ..io.atomic import exit_on_signals
from .command import by_option, command_of
from .output import to_stderr

COMMANDS = ("render", "fit", "export", "bench", "inspect", "tables")
"""Names of the commands; each is a module with a class of the same name, capitalised."""

# Parts of the messages of PyTorch's RuntimeError when memory runs out; they come from several libraries.
_NO_MEMORY = "allocate memory|not enough memory|out of memory|bad_alloc|calculation overflowed|new thread"


class _Commands(click.Group):
    """All commands."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if "." in cmd_name and not ctx.resilient_parsing:
            ctx.fail(f"{cmd_name!r} is not a command; to blur a picture: torchdof render {cmd_name} DEPTH -o OUT")
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f".{cmd_name}", __package__)
        return command_of(cmd_name, getattr(module, cmd_name.capitalize()))

    def invoke(self, ctx: click.Context) -> object:
        """Prints errors of input, files, memory and missing packages, and exits with code 2, or 130 after Ctrl-C."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            to_stderr("interrupted")
            raise SystemExit(130) from None
        except ModuleNotFoundError as error:
            reason = missing("this command", error.name)
            if reason is None:
                raise
            message = str(reason)
        except (OSError, ValueError) as error:
            if isinstance(error, BrokenPipeError):
                raise
            command = self.get_command(ctx, ctx.invoked_subcommand or "")
            message = by_option(str(error) or type(error).__name__, command.params if command else ())
        except (MemoryError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and not re.search(_NO_MEMORY, str(error)):
                raise
            message = "there is too little memory for this image; try a smaller one, or a coarser --tolerance"
        to_stderr(f"error: {message}")
        raise SystemExit(2)


def _print_version(ctx: click.Context, _: click.Parameter, is_given: bool) -> None:
    if is_given:
        from .. import native  # imports PyTorch

        click.echo(f"torchdof {importlib.metadata.version('torchdof')}, engine {native.describe()}")
        ctx.exit()


@click.group(cls=_Commands, context_settings={"max_content_width": 120})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_version,
    help="Print version, engine.",
)
def app() -> None:
    """Depth of field from an image and its depth: the photograph that a real lens would have taken."""


def main() -> None:
    """Entry point of ``torchdof`` and of ``python -m torchdof``."""
    # The OpenMP threads of PyTorch spin while they wait, which slows other processes. The OpenMP libraries of GNU and
    # LLVM read these variables when PyTorch is loaded. A variable that the user has set turns this off.
    if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME"} & set(os.environ):
        os.environ |= {"OMP_WAIT_POLICY": "passive", "KMP_BLOCKTIME": "0"}
    # A closed standard stream is opened on the null device: a file could get its number otherwise, and its messages.
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # gets the lowest free number, the stream's own
    with exit_on_signals():
        app(prog_name="torchdof")
