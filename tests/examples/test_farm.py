"""The templates for render farms: their options exist, and the farms' own validators accept them."""

import importlib.util
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from torchdof.cli.command import command_of
from torchdof.cli.render import Render

FARM = Path(__file__).parents[2] / "examples" / "farm"
SHOT = ["Image=/s/b.####.exr", "Depth=/s/d.####.exr", "Out=/s/o.####.exr", "Frames=1-48", "ChunkFrames=5"]


def installed(*names: str) -> pytest.MarkDecorator:
    missing = [name for name in names if importlib.util.find_spec(name) is None]
    return pytest.mark.skipif(bool(missing), reason=f"not installed: {', '.join(missing)}")


def options_of_render() -> set[str]:
    return {option for parameter in command_of("render", Render).params for option in parameter.opts}


def test_the_openjd_template_uses_existing_options() -> None:
    text = (FARM / "openjd.yaml").read_text()
    called = set(re.findall(r"^ +- (--[a-z-]+)$", text, flags=re.MULTILINE))
    assert {"--frames", "--resume", "--out", "--focus-m"} <= called <= options_of_render()
    declared = set(re.findall(r"^  - name: (\w+)$", text, flags=re.MULTILINE)) - {"Render"}
    assert set(re.findall(r"\{\{Param\.(\w+)\}\}", text)) == declared


@installed("openjd")
def test_openjd_accepts_its_template() -> None:
    tool = str(Path(sys.executable).with_name("openjd"))
    template = str(FARM / "openjd.yaml")
    output = subprocess.run([tool, "check", template], capture_output=True, text=True, check=True).stdout
    assert "passes validation checks" in output
    parameters = [word for value in SHOT for word in ("-p", value)]
    output = subprocess.run([tool, "summary", template, *parameters], capture_output=True, text=True, check=True).stdout
    assert "Total tasks: 48" in output


@installed("outline", "opencue")
def test_opencue_accepts_its_job(tmp_path: Path) -> None:
    command = [sys.executable, str(FARM / "cue_job.py"), "--image", "/s/b.####.exr", "--out", "/s/o.####.exr"]
    command += ["--frames", "1-48", "--chunk", "5", "--print", "--", "--focus-m", "2"]
    output = subprocess.run(
        command, capture_output=True, text=True, check=True, env={**os.environ, "HOME": str(tmp_path)}
    ).stdout
    layer = ElementTree.fromstring(output[output.index("<spec>") :]).find("./job/layers/layer")
    assert layer is not None
    assert (layer.findtext("range"), layer.findtext("chunk")) == ("1-48", "5")
    words = str(layer.findtext("cmd")).split()
    assert words[-4:] == ["2", "--resume", "--frames", "#FRAME_START#-#FRAME_END#"]
    assert {word for word in words if word.startswith("--")} <= options_of_render()
