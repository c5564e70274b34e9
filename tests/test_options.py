"""Signatures, help and type hints have the options of the dataclass ``Options``."""

import dataclasses
import inspect

import pytest

from torchdof import Camera, DepthOfField, blur_by_coc, depth_of_field
from torchdof.options import OptionArguments, Options

OPTIONS = {field.name: field.default for field in dataclasses.fields(Options)}


def test_type_hints_have_every_option() -> None:
    assert ["table", *OptionArguments.__annotations__] == list(OPTIONS)


@pytest.mark.parametrize("function", [DepthOfField, depth_of_field, blur_by_coc])
def test_the_signature_has_every_option_with_its_default_and_help_names_their_class(function: object) -> None:
    parameters = inspect.signature(function).parameters  # type: ignore[arg-type]
    assert {name: parameters[name].default for name in OPTIONS} == {**OPTIONS, "table": None}
    assert "**options: As in :class:`torchdof.options.Options`" in (function.__doc__ or "")


def test_an_unknown_option_is_refused_by_name() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'blades'"):
        DepthOfField(Camera(), blades=5)  # type: ignore[call-arg]
