"""A command is a dataclass: its fields are its arguments and options, stated once, and Click reads them.

Fields that are dataclasses themselves are groups of options that several commands share; their docstring
heads them in ``--help``. Nothing here imports PyTorch, so that help and wrong arguments are answered at once.
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
    """A field that is an option of a command.

    Args:
        help: What it means.
        default: What it is where it isn't given; ``...`` asks for it.
        names: What it is called; the field's name with dashes if nothing is said.
        metavar: What stands for its value in the help.
        read: Makes the value of its text; a ``ValueError`` says what was expected.
        group: The heading in the help that it stands under, if not its class's.
        least: The smallest whole number.
        positive: Whether it must be greater than 0, and finite.
        basic: Whether it stands first in the help, before the groups.
    """
    facts = {"help": help, "names": names, "metavar": metavar, "read": read, "least": least}
    facts["positive"] = positive
    facts["group"] = "Options" if basic else group
    return dataclasses.field(**({} if default is ... else {"default": default}), metadata=facts)


def argument(help: str, metavar: str, default: Any = ...) -> Any:
    """A field that is an argument of a command, at its place; with a default it may be left out."""
    return option(help, default, metavar=metavar, names=("argument",))


def numbers(count: int | None, expected: str) -> Callable[[str], tuple[float, ...]]:
    """Reads so many numbers, or any, with commas between them; the message of an error is what was expected."""

    def read(text: str) -> tuple[float, ...]:
        with contextlib.suppress(ValueError):
            values = tuple(map(float, text.split(",")))
            if count in (None, len(values)):
                return values
        raise ValueError(f"{expected}, got {text!r}")

    return read


def word_or_number(words: tuple[str, ...], expected: str) -> Callable[[str], float | str]:
    """Reads one of some words, or a number; what was expected is the message where it is neither."""
    return lambda text: text if text in words else numbers(1, expected)(text)[0]


@contextlib.contextmanager
def by_option(names: Mapping[str, str]) -> Iterator[None]:
    """Has a refusal say the option's name where it says its own."""
    try:
        yield
    except ValueError as error:
        pattern = re.compile(r"\b(" + "|".join(names) + r")\b")
        raise ValueError(pattern.sub(lambda found: names[found.group()], str(error))) from None


class _Command(click.Command):
    """A command whose help lists options by their groups."""

    groups: dict[str | None, str]  # of each parameter's name

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
    """The command whose arguments are the fields of a class, whose docstring says what it does, and ``run`` does it."""
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
    """The fields of a class and their types."""
    hints = typing.get_type_hints(kind)
    return [(field, hints[field.name]) for field in dataclasses.fields(kind)]


def _parameters(kind: type[Any], group: str) -> Iterator[tuple[click.Parameter, str]]:
    """The arguments and options that the fields of a class are, and those of the classes in it, with their groups."""
    for field, hint in _fields(kind):
        if dataclasses.is_dataclass(hint):
            yield from _parameters(hint, (hint.__doc__ or "").rstrip("."))  # type: ignore[arg-type]
        else:
            yield _parameter(field, hint), field.metadata["group"] or group


def _parameter(field: Any, hint: Any) -> click.Parameter:
    """The argument or option that a field is."""
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
    """A number that is greater than 0 and finite, or none."""
    if value is not None and not 0 < value < math.inf:
        raise ValueError(f"{parameter.opts[0]} must be positive and finite, got {value:g}")
    return value


def _made(kind: type[Any], values: dict[str, Any]) -> Any:
    """An object of a class, and of the classes in it, from the values of all their fields."""
    made = {
        field.name: _made(hint, values) if dataclasses.is_dataclass(hint) else values[field.name]  # type: ignore[arg-type]
        for field, hint in _fields(kind)
    }
    return kind(**made)
