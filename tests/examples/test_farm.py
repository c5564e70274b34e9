"""The options in a template for render farms exist."""

import re
from pathlib import Path

from torchdof.cli.command import command_of
from torchdof.cli.render import Render

FARM = Path(__file__).parents[2] / "examples" / "farm"


def options_of_render() -> set[str]:
    return {option for parameter in command_of("render", Render).params for option in parameter.opts}


def test_the_openjd_template_uses_existing_options() -> None:
    text = (FARM / "openjd.yaml").read_text()
    called = set(re.findall(r"^ +- (--[a-z-]+)$", text, flags=re.MULTILINE))
    assert {"--frames", "--resume", "--out", "--focus-m"} <= called <= options_of_render()
    declared = set(re.findall(r"^  - name: (\w+)$", text, flags=re.MULTILINE)) - {"Render"}
    assert set(re.findall(r"\{\{Param\.(\w+)\}\}", text)) == declared
