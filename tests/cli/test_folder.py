"""``torchdof render`` of a folder of photographs."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from tests.io.test_portraits import HEIC
from torchdof.cli.folder import pictures_in
from torchdof.cli.main import app
from torchdof.io.images import Picture, read_image, write_image

Run = Callable[..., str]
RENDER = "render photos depths -o out"


@pytest.fixture
def photographs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, image: torch.Tensor, depth: torch.Tensor) -> Path:
    """Two photographs, one of which has relative depth, and their maps; the working folder."""
    monkeypatch.chdir(tmp_path)
    Path("depths").mkdir()
    nearness = torch.linspace(0.0, 1.0, depth.shape[-2])[:, None].expand(depth.shape)
    for name, values in (("a", depth), ("b", nearness)):
        write_image(f"photos/{name}.png", Picture(image))
        np.save(f"depths/{name}.npy", values.numpy())
    return tmp_path


def told(command: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, command.split(), catch_exceptions=False)
    return result.exit_code, result.stdout, result.stderr


def names(*found: str) -> list[tuple[str, str | None, str]]:
    Path("p").mkdir(exist_ok=True)
    for name in found:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    return [
        (p.image.name, str(p.depth) if p.depth else None, p.out.name)
        for p in pictures_in(Path("p"), Path("d"), Path("o"))
    ]


def test_maps_are_matched_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    maps = ["d/a.npy", "d/a_depth.png", "d/b-depth.png", "d/depth_c.exr", "d/e_2.npy", "d/f/depth.exr", "d/G_DISP.pfm"]
    expected = [*maps[:1], *maps[2:4], None, *maps[5:]]
    found = names(*(f"p/{stem}.png" for stem in "abcefg"), "p/notes.txt", "p/.hidden.png", *maps)
    assert [depth for _, depth, _ in found] == expected


def test_results_have_the_names_of_the_photographs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("d").mkdir()
    found = names("p/a.HEIC", "p/b.jpg", "p/b.png", "p/c.heic", "p/c.jpg", "p/d.TIF")
    assert [out for *_, out in found] == ["a.jpg", "b.jpg", "b.png", "c.heic.jpg", "c.jpg.jpg", "d.TIF"]


def test_maps_beside_the_photographs_are_no_photographs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("p").mkdir()
    for name in ("a.jpg", "a_depth.png", "b.jpg"):
        Path("p", name).touch()
    found = pictures_in(Path("p"), Path("p"), Path("o"))
    assert [(p.image.name, p.depth and p.depth.name) for p in found] == [("a.jpg", "a_depth.png"), ("b.jpg", None)]


def test_each_photograph_of_a_folder_is_rendered_with_its_own_guesses(photographs: Path, run: Run) -> None:
    code, lines, notes = told(RENDER)
    assert code == 0 and [line.partition(":")[0] for line in lines.splitlines()] == ["out/a.png", "out/b.png"]
    assert notes.count("taken for metres") == 1 and notes.count("taken for relative depth") == 1
    np.save("depths/b.npy", np.load("depths/a.npy"))
    assert "\nnote: the same for 1 more: taken for metres" in told(RENDER)[2]
    for name in "ab":
        run(f"render photos/{name}.png depths/{name}.npy -o one.png")
        assert torch.equal(read_image(f"out/{name}.png").pixels, read_image("one.png").pixels)


def test_a_photograph_that_fails_is_listed_and_the_others_are_rendered(photographs: Path, image: torch.Tensor) -> None:
    Path("photos/0.png").write_bytes(b"text")
    write_image("photos/c.png", Picture(image))
    code, lines, errors = told(RENDER)
    assert code == 2 and lines.count("out/") == 2, errors
    assert sorted(os.listdir("out")) == ["a.png", "b.png"]
    listed = errors.partition("error: 2 of 4 pictures failed:\n")[2].splitlines()
    assert listed[0].startswith("  photos/0.png: cannot be read")
    assert (
        listed[1].startswith("  photos/c.png: has no depth channel") and "depths holds no map of this name" in listed[1]
    )


def test_resume_renders_what_is_missing_or_older_than_its_files_or_options(photographs: Path) -> None:
    def rendered(options: str = "") -> list[str]:
        _, lines, _ = told(f"{RENDER} --resume --json {options}")
        return [Path(fact["out"]).name for fact in map(json.loads, lines.splitlines()) if "camera" in fact]

    assert rendered() == ["a.png", "b.png"] and rendered() == []
    Path("out/b.png").unlink()
    assert rendered() == ["b.png"]
    os.utime("depths/a.npy")
    assert rendered() == ["a.png"]
    assert rendered("--blur 3%") == ["a.png", "b.png"]


def test_masks_are_matched_by_name_and_one_that_is_missing_is_listed(photographs: Path, run: Run) -> None:
    cover = np.zeros((16, 24), np.uint8)
    cover[:, :12] = 255
    Path("masks").mkdir()
    np.save("masks/a_mask.npy", cover)
    Path("photos/own.heic").write_bytes(HEIC.read_bytes())
    code, lines, errors = told(f"{RENDER} --matte masks --blur 10%")
    assert code == 2 and lines.count("out/") == 2, errors
    assert sorted(os.listdir("out")) == ["a.png", "own.jpg"]
    assert errors.endswith("1 of 3 pictures failed:\n  photos/b.png: masks holds no mask of this name\n")
    run("render photos/a.png depths/a.npy -o one.png --matte masks/a_mask.npy --blur 10%")
    run("render photos/a.png depths/a.npy -o without.png --blur 10%")
    matted, one, without = (read_image(name).pixels for name in ("out/a.png", "one.png", "without.png"))
    assert torch.equal(matted, one) and not torch.equal(matted, without)
    np.save("masks/mask_b.npy", cover)
    _, lines, _ = told(f"{RENDER} --matte masks --blur 10% --resume")
    assert "2 of 3 pictures are there already" in lines and Path("out/b.png").is_file()
    os.utime("masks/a_mask.npy")
    assert told(f"{RENDER} --matte masks --blur 10% --resume --json")[1].count("camera") == 1


def test_portraits_need_no_folder_of_maps(photographs: Path, run: Run) -> None:
    Path("phone").mkdir()
    Path("phone/IMG_1.HEIC").write_bytes(HEIC.read_bytes())
    assert "5.7 mm" in run("render phone/ -o out/ --tolerance draft") and Path("out/IMG_1.jpg").is_file()


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("render photos depths/a.npy -o out", "DEPTH is the folder of their maps"),
        ("render photos depths -o out.png", "OUT is a folder"),
        ("render photos depths -o photos", "write to another folder"),
        ("render depths -o out", "holds no image that can be read"),
        (f"{RENDER} --sheet s.png", "--sheet is of one picture"),
        (f"{RENDER} --steady", "are for sequences"),
        (f"{RENDER} --matte depths/a.npy", "--matte is the folder of their masks"),
        (f"{RENDER} --focus-m 1:2,3:4", "takes one distance"),
    ],
)
def test_what_makes_no_sense_for_a_folder_is_refused(photographs: Path, run: Run, command: str, message: str) -> None:
    assert message in run(command, code=2)
