"""Builds Click commands from dataclasses, whose fields are the arguments and options of the command.

A field that is itself a dataclass is a group of options, which several commands can share; its docstring is the heading
in ``--help``. This module does not import PyTorch, so that help and errors about arguments appear at once.
"""

import contextlib
import dataclasses
import inspect
import math
import re
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import click

__all__ = ["argument", "by_option", "command_of", "numbers", "option", "word_or_number"]

_TYPES: dict[Any, click.ParamType] = {
    **{str: click.STRING, int: click.INT, float: click.FLOAT, bool: click.BOOL},
    Path: click.Path(path_type=Path),
}


def option(
    help: str,
    default: Any = None,
    *,
    names: tuple[str, ...] = (),
    metavar: str | None = None,
    read: Callable[[str], Any] | None = None,
    group: str = "",
    least: int | None = None,
    positive: bool = False,
    basic: bool = False,
) -> Any:
    """Declares a dataclass field as an option.

    Args:
        help: Text in ``--help``.
        default: Default value; ``...`` makes the option required.
        names: Spellings on the command line; empty uses the field's name with dashes.
        metavar: Placeholder for the value in ``--help``.
        read: Converts the text to the value, or raises ``ValueError`` with the expected form.
        group: Heading in ``--help``; empty uses the docstring of the field's class.
        least: Smallest allowed value of a whole number.
        positive: Whether the value must be finite and above 0.
        basic: Whether ``--help`` lists the option before the groups.
    """
    facts = {"help": help, "names": names, "metavar": metavar, "read": read, "least": least}
    facts["positive"] = positive
    facts["group"] = "Options" if basic else group
    return dataclasses.field(**({} if default is ... else {"default": default}), metadata=facts)


def argument(help: str, metavar: str, default: Any = ...) -> Any:
    """Declares a dataclass field as a positional argument, which a default makes optional."""
    return option(help, default, metavar=metavar, names=("argument",))


def numbers(count: int | None, expected: str) -> Callable[[str], tuple[float, ...]]:
    """A parser of ``count`` numbers (None: any count) separated by commas; its errors start with ``expected``."""

    def read(text: str) -> tuple[float, ...]:
        with contextlib.suppress(ValueError):
            values = tuple(map(float, text.split(",")))
            if count in (None, len(values)):
                return values
        raise ValueError(f"{expected}, got {text!r}")

    return read


def word_or_number(words: tuple[str, ...], expected: str) -> Callable[[str], float | str]:
    """A parser of one of ``words`` or a number; its errors start with ``expected``."""
    return lambda text: text if text in words else numbers(1, expected)(text)[0]


@contextlib.contextmanager
def by_option(names: Mapping[str, str]) -> Iterator[None]:
    """Replaces names of arguments by names of options (argument -> option) in the message of a ``ValueError``."""
    try:
        yield
    except ValueError as error:
        pattern = re.compile(r"\b(" + "|".join(names) + r")\b")
        raise ValueError(pattern.sub(lambda found: names[found.group()], str(error))) from None


class _Command(click.Command):
    """A command whose ``--help`` lists options by group."""

    groups: dict[str | None, str]  # name of a parameter -> heading

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        shown: dict[str, list[tuple[str, str]]] = {"Options": []}
        for parameter in self.get_params(ctx):
            row = parameter.get_help_record(ctx)
            if row is not None and not isinstance(parameter, click.Argument):
                shown.setdefault(self.groups.get(parameter.name, "Options"), []).append(row)
        for group, rows in shown.items():
            with formatter.section(group):
                formatter.write_dl(rows, col_max=28)


def command_of(name: str, kind: type[Any]) -> click.Command:
    """The command that makes a ``kind`` of its arguments and runs it; the docstring of ``kind`` is the help."""
    parameters, told = list(_parameters(kind, "Options")), inspect.getdoc(kind) or ""
    command = _Command(
        name,
        params=[parameter for parameter, _ in parameters],
        help=told,
        short_help=" ".join(told.partition("\n\n")[0].split()),
        no_args_is_help=any(parameter.required for parameter, _ in parameters),
        callback=lambda **values: _made(kind, values).run(),
        context_settings={"max_content_width": 120},
    )
    command.groups = {parameter.name: group for parameter, group in parameters}
    return command


def _fields(kind: type[Any]) -> list[tuple[Any, Any]]:
    """Fields of a class, each with its type."""
    hints = typing.get_type_hints(kind)
    return [(field, hints[field.name]) for field in dataclasses.fields(kind)]


def _parameters(kind: type[Any], group: str) -> Iterator[tuple[click.Parameter, str]]:
    """Arguments and options for the fields of a class and of the groups in it, each with its heading."""
    for field, hint in _fields(kind):
        if dataclasses.is_dataclass(hint):
            yield from _parameters(hint, (hint.__doc__ or "").rstrip("."))  # type: ignore[arg-type]
        else:
            yield _parameter(field, hint), field.metadata["group"] or group


def _parameter(field: Any, hint: Any) -> click.Parameter:
    """Argument or option for a field."""
    facts, required, read = field.metadata, field.default is dataclasses.MISSING, field.metadata["read"]
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        hint = typing.get_args(hint)[0]
    several = typing.get_origin(hint) is tuple and read is None
    hint = typing.get_args(hint)[0] if several else hint
    given: dict[str, Any] = {"help": facts["help"], "metavar": facts["metavar"], "required": required}
    if read is not None:
        given |= {"type": click.STRING, "callback": lambda _, __, text: None if text is None else read(text)}
    elif typing.get_origin(hint) is Literal:
        given["type"] = click.Choice(typing.get_args(hint))
    else:
        given["type"] = _TYPES[hint] if facts["least"] is None else click.IntRange(min=facts["least"])
    if facts["positive"]:
        given["callback"] = _positive
    if not required and field.default not in (None, ()):
        given["default"] = field.default
    if facts["names"] == ("argument",):
        return click.Argument([field.name], nargs=-1 if several else 1, **given)
    if hint is bool:
        given["is_flag"] = True
    else:
        given |= {"multiple": several, "show_default": bool(field.default) and not required}
    return click.Option([field.name, *(facts["names"] or (f"--{field.name.replace('_', '-')}",))], **given)


def _positive(_: click.Context, parameter: click.Parameter, value: float | None) -> float | None:
    """Refuses a number that is not positive and finite; None is allowed."""
    if value is not None and not 0 < value < math.inf:
        raise ValueError(f"{parameter.opts[0]} must be positive and finite, got {value:g}")
    return value


def _made(kind: type[Any], values: dict[str, Any]) -> Any:
    """Creates an object of ``kind`` with its groups; ``values`` has the values of all their fields by name."""
    made = {
        field.name: _made(hint, values) if dataclasses.is_dataclass(hint) else values[field.name]  # type: ignore[arg-type]
        for field, hint in _fields(kind)
    }
    return kind(**made)
