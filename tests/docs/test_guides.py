"""The documentation is true: its code runs, its options, links and files exist, its pictures match their scripts."""

import importlib.metadata
import re
import runpy
import shlex
import shutil
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import pytest
import torch
from click.testing import CliRunner

import torchdof
from torchdof.cli import main
from torchdof.cli.main import app
from torchdof.fit.lens import Lens
from torchdof.io.images import Picture, read_image, write_image
from torchdof.reference.metrics import display, psnr

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
_RUN = ("index", "datasets", "depth", "embedding", "measuring", "phone", "shapes", "speed")
RUN = [*PAGES[:1], *(ROOT / f"docs/{name}.md" for name in _RUN), *sorted((ROOT / "docs" / "guides").glob("*.md"))]
"""Pages whose blocks are run from top to bottom; a comment ``<!-- not run: why -->`` excludes a block."""

_BLOCK = re.compile(r"(?P<skip><!-- not run: [^\n]+ -->\n)?^```(?P<kind>sh|python)\n(?P<text>.*?)^```$", re.M | re.S)
_COMMAND = re.compile(r"(?:^|`)\s*((?:python -m )?torchdof (?:[a-z]+)(?: [^`\n\\]*(?:\\\n[^`\n\\]*)*)?)", re.M)
_LINK = re.compile(r"""\]\((?P<link>[^)\s]+)\)|src="(?P<source>[^"]+)\"""")
_PATH = re.compile(r"(?:`| )((?:examples|tests|docs|fit|export|torchdof|optics|render|depth)/[a-z_/]+(?:\.[a-z]+|/))")
_ALIKE_DB = 40.0  # PSNR between a stored JPEG and a newly drawn picture; JPEG compression alone costs less


def _names(pages: list[Path]) -> list[str]:
    return [str(page.relative_to(ROOT)) for page in pages]


def commands_of(text: str) -> list[list[str]]:
    """The commands of a shell block, word by word."""
    lines = re.sub(r"(^|\s)#.*", "", text.replace("\\\n", " "), flags=re.M).splitlines()
    return [words for words in map(shlex.split, lines) if words]


def run_command(program: str, *words: str) -> None:
    """Runs a torchdof command; of ``make`` it checks only that the targets exist."""
    assert program in ("torchdof", "make"), f"{program}: a command that this test does not know"
    if program == "make":
        assert set(words) <= set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.M))
    else:
        result = CliRunner().invoke(app, words, catch_exceptions=False)
        assert result.exit_code == 0, result.output


def given(folder: Path) -> dict[str, Any]:
    """The Python names that the pages use without defining them; writes the reader's own files into a folder."""
    image = torch.rand(1, 3, 480, 640, generator=torch.Generator().manual_seed(0))
    x, y = torch.meshgrid(torch.arange(640.0), torch.arange(480.0), indexing="xy")
    values = (0.65 - 0.0012 * x + 0.00083 * y).clamp_min(0.1)[None, None]  # a plane, about as far as the pages say
    write_image(folder / "photo.jpg", Picture(image))
    write_image(folder / "depth.png", Picture(1 / values / 65.535, ("Y",)), "linear", "16")  # millimetres
    camera = torchdof.Camera(focus_m=2.0)
    return {
        "__name__": "guide",
        "torchdof": torchdof,
        "image": image,
        "depth": 1 / values,
        "heart": torch.eye(9),
        "camera": camera,
        "dof": torchdof.DepthOfField(camera),
        "frames": 2 * [(image, 1 / values)],
    }


def captures_of_measuring(folder: Path, simulator: ModuleType) -> None:
    """Writes the photographs named in the manifest of docs/measuring.md, simulated with the camera stated there."""
    text, prescription = (_text_block("measuring.md", kind) for kind in ("toml", "text"))
    (folder / "shown.txt").write_text(prescription)
    shown = Lens.read(folder / "shown.txt")
    assert len(shown.surfaces) == 3 and shown.stop == 1 and shown.surfaces[-1].conic == -0.6
    manifest = tomllib.loads(text)
    numbers = ("focal_length_mm", "f_number", "focus_m", "sensor_width_mm")
    camera = torchdof.Camera(*(manifest[name] for name in numbers))
    width, lens = 640, folder / "my-lens"

    def kernel(distance_m: float) -> tuple[str, dict[str, float]]:
        return "disc", {"radius": float(camera.coc_px(torch.full((1, 1, 1, 1), distance_m), width).abs())}

    dot = simulator.Simulator(level=0.7, snr_db=46, dot_radius=9.0, black=0.02)
    shots = manifest["shot"]
    distances_m = [shot["distance_m"] for shot in shots]
    simulator.write_captures(lens, dot, manifest["focus_m"], distances_m, kernel, width, height=240)
    for path in lens.glob("*.png"):
        write_image(path.with_suffix(".tif"), Picture(read_image(path).pixels), manifest["transfer"], "16")
        path.unlink()
    assert {path.name for path in lens.glob("*.tif")} == {manifest["sharp"], *(shot["file"] for shot in shots)}
    (lens / "capture.toml").write_text(text)


def _text_block(page: str, kind: str) -> str:
    (block,) = re.findall(rf"^```{kind}\n(.*?)^```$", (ROOT / "docs" / page).read_text(), re.M | re.S)
    return str(block)


@pytest.mark.parametrize("name", _names(RUN))
@pytest.mark.usefixtures("capsys")
def test_blocks_of_a_guide_run_from_top_to_bottom(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("examples", "tests"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    names = given(tmp_path)
    if name == "docs/measuring.md":
        captures_of_measuring(tmp_path, request.getfixturevalue("simulator"))
    if name == "docs/phone.md":
        options = {"width": 500, "tone": 0.0, "noise": 0.003, "jpeg": 97}
        request.getfixturevalue("simulator").write_photographs(tmp_path / "photographs", 0.2, [0.45], **options)
    if name == "docs/embedding.md":
        shutil.copyfile(request.getfixturevalue("plain").path, "dof.onnx")
        names |= {key: names[key].numpy() for key in ("image", "depth")}
    blocks = [match for match in _BLOCK.finditer((ROOT / name).read_text()) if not match["skip"]]
    assert blocks
    for block in blocks:
        if block["kind"] == "python":
            exec(compile(block["text"], name, "exec"), names)
        else:
            for words in commands_of(block["text"]):
                run_command(*words)


@pytest.mark.parametrize("name", _names(PAGES))
def test_commands_of_a_page_use_existing_options(name: str) -> None:
    commands = {command: app.get_command(click.Context(app), command) for command in main.COMMANDS}
    parsed = {name: command for name, command in commands.items() if command is not None}
    for match in _COMMAND.finditer((ROOT / name).read_text()):
        words = re.sub(r"\\\n", " ", match[1]).removeprefix("python -m ").split()
        options = [re.split(r"[=,.;:)]", word)[0] for word in words[2:] if re.match(r"--?[a-z]", word)]
        if words[1] in parsed:
            known = {option for parameter in parsed[words[1]].params for option in parameter.opts} | {"--help"}
            assert set(options) <= known, match[1]


@pytest.mark.parametrize("name", _names([*PAGES, ROOT / "CHANGELOG.md"]))
def test_links_and_files_of_a_page_exist(name: str) -> None:
    text = (ROOT / name).read_text()
    for match in _LINK.finditer(text):
        link = (match["link"] or match["source"]).partition("#")[0]
        if link and not link.startswith(("http:", "https:")):
            assert ((ROOT / name).parent / link).exists(), link
    for path in _PATH.findall(text) if name != "CHANGELOG.md" else []:
        assert (ROOT / path).exists() or (ROOT / "torchdof" / path).exists(), path


def test_readme_is_short_and_names_extras_that_exist() -> None:
    readme = (ROOT / "README.md").read_text()
    assert len(readme.splitlines()) <= 120
    extras = importlib.metadata.metadata("torchdof").get_all("Provides-Extra") or []
    named = set(re.findall(r"`\.\[([a-z]+)\]`", readme))
    assert named and named <= set(extras)


_GALLERY = runpy.run_path(str(ROOT / "examples" / "gallery.py"))["GALLERY"]
_QUICK = ("lenses.jpg", "truth_lamps.jpg", "truth_bars.jpg")


def test_every_picture_of_the_documentation_has_a_script() -> None:
    elsewhere = {"worst_places.jpg", "phone_sheet.jpg"}  # of other scenes, and of a simulated phone
    assert {*_GALLERY, *elsewhere} == {path.name for path in (ROOT / "docs" / "pictures").iterdir()}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in _QUICK else pytest.mark.sweep) for n in _GALLERY if n.endswith(".jpg")]
)
def test_a_picture_of_the_documentation_matches_its_script(name: str, tmp_path: Path) -> None:
    _GALLERY[name](tmp_path / name)
    drawn, shown = (display(read_image(folder / name).pixels) for folder in (tmp_path, ROOT / "docs" / "pictures"))
    assert psnr(drawn, shown) > _ALIKE_DB
