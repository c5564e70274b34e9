"""Builds Click commands from dataclasses, whose fields are the arguments and options of the command.

A field that is itself a dataclass is a group of options, which several commands can share; its docstring is the heading
in ``--help``.
"""

import contextlib
import dataclasses
import inspect
import re
import typing
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Literal

import click

_BASIC_HEADING = "Options"  # heading of the options that --help lists first


def option(
    help: str,
    default: Any = None,
    *,
    names: tuple[str, ...] = (),
    read: Callable[[str], Any] | None = None,
    group: str = "",
    basic: bool = False,
    **details: Any,
) -> Any:
    """Declares a dataclass field as an option.

    Args:
        help: Text in ``--help``.
        default: Default value; ``...`` makes the option required.
        names: Spellings on the command line; empty uses the field's name with dashes.
        read: Converts the text to the value, or raises ``ValueError`` with the expected form.
        group: Heading in ``--help``; empty uses the docstring of the field's class.
        basic: Whether ``--help`` lists the option before the groups.
        **details: Further arguments of :class:`click.Option`; its ``type`` is otherwise that of the field.
    """
    details["help"] = help
    if read is not None:
        details |= {"type": str, "callback": lambda _, __, text: None if text is None else read(text)}
    metadata = {"names": names, "group": _BASIC_HEADING if basic else group, "details": details}
    return dataclasses.field(**({} if default is ... else {"default": default}), metadata=metadata)


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


def by_option(message: str, parameters: Iterable[click.Parameter]) -> str:
    """A message with options in the place of the library's arguments, which may end with a unit: ``tilt_deg``."""
    names = {f"{p.name}{unit}": p.opts[0] for unit in ("", "_m", "_deg", "_px") for p in parameters}
    pattern = rf"(^|[(,] ?| (?=\w+=))({'|'.join(names)})(?= must | is | -?\d| inf|=)"
    return re.sub(pattern, lambda match: match[1] + names[match[2]], message)


class _Command(click.Command):
    """A command whose ``--help`` lists options by the heading that each has in its attribute ``heading``."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        rows: dict[str, list[tuple[str, str]]] = {_BASIC_HEADING: []}
        for parameter in self.get_params(ctx):
            row = parameter.get_help_record(ctx)
            if row is not None and isinstance(parameter, click.Option):
                rows.setdefault(getattr(parameter, "heading", _BASIC_HEADING), []).append(row)
        for heading, rows_of_heading in rows.items():
            with formatter.section(heading):
                formatter.write_dl(rows_of_heading, col_max=28)


def command_of(name: str, kind: type[Any]) -> click.Command:
    """The command that makes a ``kind`` of its arguments and runs it; the docstring of ``kind`` is the help."""
    parameters, help_text = list(_parameters(kind, _BASIC_HEADING)), inspect.getdoc(kind) or ""
    return _Command(
        name,
        params=parameters,
        help=help_text,
        short_help=" ".join(help_text.partition("\n\n")[0].split()),
        no_args_is_help=any(parameter.required for parameter in parameters),
        callback=lambda **values: _instance(kind, values).run(),
        context_settings={"max_content_width": 120},
    )


def _parameters(kind: type[Any], heading: str) -> Iterator[click.Parameter]:
    """Arguments and options for the fields of a class and of the groups in it."""
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        if dataclasses.is_dataclass(hint):
            yield from _parameters(hint, (hint.__doc__ or "").rstrip("."))  # type: ignore[arg-type]
        else:
            parameter = _parameter(field, hint)
            parameter.heading = field.metadata["group"] or heading  # type: ignore[attr-defined]
            yield parameter


def _parameter(field: Any, hint: Any) -> click.Parameter:
    """Argument or option for a field of type ``hint``; a tuple without a ``read`` of its own takes several values."""
    given = field.metadata["details"]
    required = field.default is dataclasses.MISSING
    takes_several = typing.get_origin(hint) is tuple and "callback" not in given
    if typing.get_args(hint) and typing.get_origin(hint) is not Literal:  # X | None, tuple[X, ...]
        hint = typing.get_args(hint)[0]
    kind = click.Choice(typing.get_args(hint)) if typing.get_origin(hint) is Literal else hint
    details = {"type": kind, "required": required, **given}
    if not required and field.default not in (None, ()):
        details["default"] = field.default
    if field.metadata["names"] == ("argument",):
        return click.Argument([field.name], nargs=-1 if takes_several else 1, **details)
    if hint is bool:
        details["is_flag"] = True
    else:
        details |= {"multiple": takes_several, "show_default": bool(field.default) and not required}
    return click.Option([field.name, *_spellings(field)], **details)


def _spellings(field: Any) -> tuple[str, ...]:
    names: tuple[str, ...] = field.metadata["names"]
    return (field.name.upper(),) if names == ("argument",) else names or (f"--{field.name.replace('_', '-')}",)


def options_of(command: Any) -> dict[str, Any]:
    """Values of a command's arguments and options, also those of its groups, by their first spelling."""
    values: dict[str, Any] = {}
    for field in dataclasses.fields(command):
        value = getattr(command, field.name)
        values |= options_of(value) if dataclasses.is_dataclass(value) else {_spellings(field)[0]: value}
    return values


def _instance(kind: type[Any], values: dict[str, Any]) -> Any:
    """Creates an object of ``kind`` with its groups; ``values`` has the values of all their fields by name."""
    hints = typing.get_type_hints(kind)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if dataclasses.is_dataclass(hint)}
    return kind(**{name: _instance(groups[name], values) if name in groups else values[name] for name in hints})
