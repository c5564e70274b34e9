"""Builds Click commands from dataclasses, whose fields are the arguments and options of the command.

A command inherits groups of options, which several commands can share; the docstring of a group is its heading in
``--help``.
"""

import dataclasses
import inspect
import re
import reprlib
import typing
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Literal

import click
from typing_extensions import dataclass_transform

_BASIC_HEADING = "Options"  # heading of the options that --help lists first


def refuse(*problems: tuple[object, str]) -> None:
    """Raises the message of the first problem that is there."""
    for is_there, message in problems:
        if is_there:
            raise ValueError(message)


def option(
    help: str, default: Any = None, *, names: tuple[str, ...] = (), group: str = "", basic: bool = False, **details: Any
) -> Any:
    """Declares a dataclass field as an option of :class:`click.Option`, whose type is that of the field.

    ``default=...`` makes it required. Without ``names`` it is spelled like the field, with dashes. ``group`` is its
    heading in ``--help``, by default the docstring of the class; ``basic`` options are listed before the groups.
    """
    metadata = {"names": names, "group": _BASIC_HEADING if basic else group, "details": {"help": help, **details}}
    return dataclasses.field(**({} if default is ... else {"default": default}), metadata=metadata)


def argument(help: str, metavar: str, default: Any = ...) -> Any:
    """Declares a dataclass field as a positional argument, which a default makes optional."""
    return option(help, default, metavar=metavar, names=("argument",))


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(option, argument))
class Group:
    """Base of all groups of options, and of commands; each is a frozen dataclass."""

    def __init_subclass__(cls) -> None:
        dataclasses.dataclass(frozen=True, kw_only=True)(cls)

    def __post_init__(self) -> None:
        """Refuses options that contradict each other."""

    def given(self, *groups: type[Any]) -> set[str]:
        """Names of the options of some groups that are not at their default."""
        fields = [field for group in groups for field in dataclasses.fields(group)]
        return {field.name for field in fields if getattr(self, field.name) != field.default}


class Command(Group):
    """Options."""

    as_json: bool = option("Print results as JSON, for programs: one object a line.", False, names=("--json",))


class Parsed(click.ParamType):
    """The type of an option whose text ``parse`` reads. The message for a ``ValueError`` states form and example."""

    def __init__(self, form: str, parse: Callable[[str], Any], example: str = "") -> None:
        self.name, self.parse, self.example = form, parse, example

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """The name of the value in ``--help``."""
        return self.name

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Click's conversion of a text."""
        try:
            return self.parse(value)
        except ValueError:
            expected = f"{self.name} such as {self.example}" if self.example else self.name
            raise ValueError(f"{param and param.opts[0]} expects {expected}, got {reprlib.repr(value)}") from None


def numbers(count: int | None = None) -> Callable[[str], tuple[float, ...]]:
    """A reader of ``count`` numbers (None: any count) separated by commas."""

    def read(text: str) -> tuple[float, ...]:
        values = tuple(map(float, text.split(",")))
        if count not in (None, len(values)):
            raise ValueError
        return values

    return read


def number_or(*words: str) -> Callable[[str], float | str]:
    """A reader of a number or one of some words."""
    return lambda text: text if text in words else float(text)


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
    parameters, help_text = list(_parameters(kind)), inspect.getdoc(kind) or ""
    return _Command(
        name,
        params=parameters,
        help=help_text,
        short_help=" ".join(help_text.partition("\n\n")[0].split()),
        no_args_is_help=any(parameter.required for parameter in parameters),
        callback=lambda **values: kind(**values).run(),
        context_settings={"max_content_width": 120},
    )


def _parameters(kind: type[Any]) -> Iterator[click.Parameter]:
    """Arguments and options of a command: its own, and those of its groups in order."""
    hints, fields = typing.get_type_hints(kind), {field.name: field for field in dataclasses.fields(kind)}
    for home in kind.__mro__:
        heading = _BASIC_HEADING if home is kind else (home.__doc__ or "").rstrip(".")
        for name in inspect.get_annotations(home):
            parameter = _parameter(fields[name], hints[name])
            parameter.heading = fields[name].metadata["group"] or heading  # type: ignore[attr-defined]
            yield parameter


def _parameter(field: Any, hint: Any) -> click.Parameter:
    """Argument or option for a field of type ``hint``; a tuple that is not :class:`Parsed` takes several values."""
    given, names, required = field.metadata["details"], field.metadata["names"], field.default is dataclasses.MISSING
    is_list = typing.get_origin(hint) is tuple and not isinstance(given.get("type"), Parsed)
    takes_several = given.get("multiple", is_list)
    if typing.get_args(hint) and typing.get_origin(hint) is not Literal:  # X | None, tuple[X, ...]
        hint = typing.get_args(hint)[0]
    kind = click.Choice(typing.get_args(hint)) if typing.get_origin(hint) is Literal else hint
    details = {"type": kind, "required": required, **given}
    if not required and field.default not in (None, ()):
        details["default"] = field.default
    if names == ("argument",):
        return click.Argument([field.name], nargs=-1 if takes_several else 1, **details)
    if hint is bool:
        details["is_flag"] = True
    else:
        details |= {"multiple": takes_several, "show_default": bool(field.default) and not required}
    return click.Option([field.name, *(names or [f"--{field.name.replace('_', '-')}"])], **details)
