"""The command from the outside: files in, files out, one line that says what was done, exit code 2 for wrong input."""

import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from typer.testing import CliRunner

import torchdof
from torchdof.cli.main import app
from torchdof.io.images import Picture, read_image, write_image
from torchdof.optics.field import Field

HEIGHT, WIDTH = 16, 24
LENS = ("--focal-length-mm", "50", "--f-number", "1.4", "--sensor-width-mm", "4")  # blurs by 1.8 px


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with image.exr, depth.npy (2 m left, 6 m right) and both in zed.exr; it is the working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    write_image("image.exr", Picture(image(), sample="float"))
    np.save("depth.npy", depth().numpy())
    return tmp_path


def store(path: str, array: np.ndarray, sample: str, names: tuple[str, ...]) -> None:
    spec = oiio.ImageSpec(array.shape[1], array.shape[0], array.shape[2], sample)
    spec.channelnames = names
    output = oiio.ImageOutput.create(path)
    assert output is not None and output.open(path, spec) and output.write_image(array) and output.close()


def image() -> torch.Tensor:
    return torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))


def depth() -> torch.Tensor:
    metres = torch.full((1, 1, HEIGHT, WIDTH), 2.0)
    metres[..., WIDTH // 2 :] = 6.0
    return metres


def lens(focus_m: float) -> torchdof.Camera:
    return torchdof.Camera(focal_length_mm=50.0, f_number=1.4, focus_m=focus_m, sensor_width_mm=4.0)


def run(*arguments: str, code: int = 0) -> str:
    """Runs ``torchdof render`` and gives its standard output, or its standard error where it should fail."""
    result = CliRunner().invoke(app, ["render", *arguments], catch_exceptions=False)
    assert result.exit_code == code, result.output
    return result.stdout if code == 0 else result.stderr


def pixels(path: str) -> torch.Tensor:
    return read_image(path).pixels


def test_render_is_the_function_on_files(scene: Path) -> None:
    line = run("image.exr", "depth.npy", "-o", "out.exr", "--focus-m", "2", *LENS, "--device", "cpu")
    camera = lens(2.0)
    expected = torchdof.depth_of_field(image(), depth(), camera)
    torch.testing.assert_close(pixels("out.exr"), expected, rtol=0, atol=1e-6)
    assert not torch.equal(expected, image())
    radius = float(camera.coc_px(depth(), WIDTH).abs().max())
    assert line.startswith(
        f"out.exr: focus 2 m, f/1.4, 50 mm on 4 mm; blur radius up to {radius:.1f} px; disc, layered"
    )
    assert "[" not in line and line.count("\n") == 1


def test_depth_channel_of_the_image_is_used_when_no_depth_is_named(scene: Path) -> None:
    both = torch.cat([image(), depth()], dim=1)[0].permute(1, 2, 0).contiguous().numpy()
    store("zed.exr", both, "float", ("R", "G", "B", "Z"))
    run("zed.exr", "-o", "a.exr", "--focus-m", "2", *LENS)
    run("image.exr", "depth.npy", "-o", "b.exr", "--focus-m", "2", *LENS)
    assert torch.equal(pixels("a.exr"), pixels("b.exr"))


def test_scene_in_focus_comes_back_bit_exact(scene: Path) -> None:
    np.save("depth.npy", np.full((HEIGHT, WIDTH), 2.0))
    run("image.exr", "depth.npy", "-o", "out.exr", "--focus-m", "2", *LENS)
    assert torch.equal(pixels("out.exr"), image())


def test_focus_at_a_pixel_is_focus_on_its_depth(scene: Path) -> None:
    line = run("image.exr", "depth.npy", "-o", "a.exr", "--focus-at", f"{WIDTH - 3},5", *LENS)
    assert "focus 6 m" in line
    run("image.exr", "depth.npy", "-o", "b.exr", "--focus-m", "6", *LENS)
    assert torch.equal(pixels("a.exr"), pixels("b.exr"))


def test_field_of_view_and_aperture_radius_are_the_camera_of_a_rendered_image(scene: Path) -> None:
    run("image.exr", "depth.npy", "-o", "out.exr", "--focus-m", "2", "--fov-deg", "40", "--aperture-radius-m", "0.2")
    camera = torchdof.Camera.from_fov(40.0, 0.2, 2.0)
    expected = torchdof.depth_of_field(image(), depth(), camera)
    torch.testing.assert_close(pixels("out.exr"), expected, rtol=0, atol=1e-6)


def test_f_number_with_a_field_of_view_opens_the_equivalent_lens(scene: Path) -> None:
    f_number = torchdof.Camera.from_fov(40.0, 0.2, 2.0).f_number
    run("image.exr", "depth.npy", "-o", "a.exr", "--focus-m", "2", "--fov-deg", "40", "--f-number", str(f_number))
    run("image.exr", "depth.npy", "-o", "b.exr", "--focus-m", "2", "--fov-deg", "40", "--aperture-radius-m", "0.2")
    torch.testing.assert_close(pixels("a.exr"), pixels("b.exr"), rtol=0, atol=1e-6)


def test_camera_comes_from_the_file_when_nobody_states_it_and_that_is_said(scene: Path) -> None:
    tags = {"Exif:FocalLength": 85.0, "FNumber": 1.8, "Exif:SubjectDistance": 3.0, "Exif:FocalLengthIn35mmFilm": 85.0}
    write_image("photo.exr", Picture(image(), metadata={name: ("float", value) for name, value in tags.items()}))
    line = run("photo.exr", "depth.npy", "-o", "out.exr")
    assert "focus 3 m, f/1.8, 85 mm on 36 mm" in line
    assert (
        "[focus from the file, focal length from the file, f-number from the file, sensor width from the file]" in line
    )
    line = run("photo.exr", "depth.npy", "-o", "out.exr", "--f-number", "4", "--focus-m", "2")
    assert "focus 2 m, f/4, 85 mm" in line and "f-number from" not in line


def test_assumed_lens_is_said(scene: Path) -> None:
    line = run("image.exr", "depth.npy", "-o", "out.exr", "--focus-m", "2")
    assert "[focal length assumed, f-number assumed, sensor width assumed]" in line


def test_disparity_in_sixteen_bits_with_holes_is_filled_and_counted(scene: Path) -> None:
    disparity = np.where(depth()[0, 0].numpy() == 2.0, 300, 100).astype(np.uint16)
    disparity[3, 4] = disparity[9, 20] = 0
    store("disparity.png", disparity[..., None], "uint16", ("Y",))
    options = ("--depth-kind", "disparity", "--depth-scale", "600", "--depth-unknown", "0", "--focus-m", "2", *LENS)
    message = run("image.exr", "disparity.png", "-o", "a.exr", *options, code=2)
    assert message.startswith("error: disparity.png: 2 pixels (0.5 %) have no depth")
    line = run("image.exr", "disparity.png", "-o", "a.exr", *options, "--fill-depth", "nearest")
    assert "2 px of depth filled (nearest)" in line
    run("image.exr", "depth.npy", "-o", "b.exr", "--focus-m", "2", *LENS)
    assert torch.equal(pixels("a.exr"), pixels("b.exr"))


def test_distance_along_the_ray_is_made_depth_by_the_field_of_view(scene: Path) -> None:
    focal_px = WIDTH / 2 / math.tan(math.radians(20))
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    ray = np.sqrt(1 + ((x - WIDTH / 2) / focal_px) ** 2 + ((y - HEIGHT / 2) / focal_px) ** 2)
    np.save("ray.npy", depth()[0, 0].numpy() * ray)
    camera = ("--focus-m", "2", "--fov-deg", "40", "--aperture-radius-m", "0.2")
    run("image.exr", "ray.npy", "-o", "a.exr", "--depth-kind", "distance", *camera)
    run("image.exr", "depth.npy", "-o", "b.exr", *camera)
    torch.testing.assert_close(pixels("a.exr"), pixels("b.exr"), rtol=0, atol=1e-4)


def test_ready_circles_of_confusion_need_no_camera(scene: Path) -> None:
    coc_px = torch.linspace(-3, 3, WIDTH).expand(1, 1, HEIGHT, WIDTH)
    np.save("coc.npy", coc_px.numpy())
    line = run("image.exr", "coc.npy", "-o", "out.exr", "--depth-kind", "coc")
    torch.testing.assert_close(pixels("out.exr"), torchdof.blur_by_coc(image(), coc_px), rtol=0, atol=1e-6)
    assert "focus" not in line and "blur radius up to 3.0 px" in line


def test_relative_depth_lies_between_near_and_far(scene: Path) -> None:
    relative = np.where(depth()[0, 0].numpy() == 2.0, 200, 10).astype(np.uint8)
    store("relative.png", relative[..., None], "uint8", ("Y",))
    options = ("--depth-kind", "relative", "--near-m", "2", "--far-m", "6", "--focus-m", "2", *LENS)
    run("image.exr", "relative.png", "-o", "a.exr", *options)
    run("image.exr", "depth.npy", "-o", "b.exr", "--focus-m", "2", *LENS)
    torch.testing.assert_close(pixels("a.exr"), pixels("b.exr"), rtol=0, atol=1e-5)
    run("image.exr", "relative.png", "-o", "c.exr", *options, "--relative-kind", "depth")
    assert not torch.equal(pixels("c.exr"), pixels("a.exr"))
    run("image.exr", "relative.png", "-o", "d.exr", *options, "--value-range", "10,200")
    assert torch.equal(pixels("d.exr"), pixels("a.exr"))


def test_frames_of_relative_depth_without_a_range_are_warned_of_once(scene: Path) -> None:
    sequence()
    options = ("--depth-kind", "relative", "--near-m", "2", "--far-m", "6", "--focus-m", "2", *LENS)
    arguments = ["render", "shot.####.exr", "depth.####.npy", "-o", "o.####.exr", *options, "--relative-kind", "depth"]
    told = CliRunner().invoke(app, arguments)
    assert told.exit_code == 0 and told.stderr.count("warning: ") == 1 and "--value-range LOW,HIGH" in told.stderr
    assert CliRunner().invoke(app, [*arguments, "--value-range", "2,6"]).stderr == ""


def test_unit_mistake_is_one_warning_a_sequence_and_an_error_where_strict(scene: Path) -> None:
    sequence()
    for n in range(1, 4):
        np.save(f"depth.{n:04d}.npy", depth().numpy() * 1000)
    arguments = ["render", "shot.####.exr", "depth.####.npy", "-o", "out.####.exr", "--focus-m", "3", *LENS]
    told = CliRunner().invoke(app, arguments)
    assert told.exit_code == 0 and len(list(scene.glob("out.*"))) == 3
    assert told.stderr.startswith("warning: depth.0001.npy: nothing is in focus") and told.stderr.count("\n") == 1
    assert "is it millimetres (--depth-scale 0.001)" in told.stderr
    for path in scene.glob("out.*"):
        path.unlink()
    message = run(*arguments[1:], "--strict", code=2)
    assert message.startswith("error: depth.0001.npy: nothing is in focus") and list(scene.glob("out.*")) == []
    assert CliRunner().invoke(app, [*arguments, "--depth-scale", "0.001", "--focus-m", "2"]).stderr == ""


def test_warnings_of_depth_can_be_silenced(scene: Path) -> None:
    np.save("depth.npy", depth().numpy() * 1000)
    arguments = ["render", "image.exr", "depth.npy", "-o", "out.exr", "--focus-m", "3", *LENS]
    told = subprocess.run(
        [sys.executable, "-W", "ignore", "-m", "torchdof", *arguments], capture_output=True, text=True
    )
    assert told.returncode == 0 and told.stderr == ""


@pytest.mark.parametrize(
    ("options", "arguments"),
    [
        (("--no-occlusion",), {"occlusion": False}),
        (("--method", "fold"), {"method": "fold"}),
        (("--table", "gaussian"), {"table": torchdof.BlurTable.gaussian()}),
        (("--table", "sato_j15"), {"table": torchdof.BlurTable.load("sato_j15")}),
        (("--tolerance", "0"), {"tolerance": 0.0}),
        (("--tolerance", "draft"), {"tolerance": 8 / 255}),
    ],
)
def test_options_of_the_blur_are_those_of_the_function(
    scene: Path, options: tuple[str, ...], arguments: dict[str, Any]
) -> None:
    run("image.exr", "depth.npy", "-o", "out.exr", "--focus-m", "2", *LENS, *options)
    camera = lens(2.0)
    expected = torchdof.depth_of_field(image(), depth(), camera, **arguments)
    torch.testing.assert_close(pixels("out.exr"), expected, rtol=0, atol=1e-6)


def test_method_reaches_the_function(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    methods = []

    def spy(*arguments: Any, method: Any, **options: Any) -> torch.Tensor:
        methods.append(method)
        return torchdof.depth_of_field(*arguments, method=method, **options)

    monkeypatch.setattr("torchdof.cli.frame.depth_of_field", spy)
    for method in ("fold", "layered"):
        run("image.exr", "depth.npy", "-o", "out.exr", "--focus-m", "2", "--method", method)
    assert methods == ["fold", "layered"]


def test_alpha_goes_through_the_blur_premultiplied(scene: Path) -> None:
    alpha = torch.zeros(1, 1, HEIGHT, WIDTH)
    alpha[..., 4:12, 6:18] = 1.0
    write_image("cut.exr", Picture(torch.cat([image() * alpha, alpha], dim=1), ("R", "G", "B", "A"), sample="float"))
    run("cut.exr", "depth.npy", "-o", "out.exr", "--focus-m", "1", *LENS)
    out = pixels("out.exr")
    camera = lens(1.0)
    expected = torchdof.depth_of_field(torch.cat([image() * alpha, alpha], dim=1), depth(), camera)
    torch.testing.assert_close(out, expected, rtol=0, atol=1e-6)
    assert bool(((out[:, 3] > 0.01) & (out[:, 3] < 0.99)).any())


@pytest.mark.parametrize("place", ["everywhere alike", "across the field"])
def test_table_of_three_colours_blurs_alpha_like_green(scene: Path, place: str) -> None:
    table = torchdof.BlurTable("gaussian", coc=[1.0], params={"sigma": [[0.2], [0.5], [0.9]]})
    if place == "across the field":
        sizes = torch.tensor([0.2, 0.1, 0.3, 0.2]).reshape(2, 2, 1).expand(2, 2, 3)
        light = torch.rand(3, 2, 2, 8, 4, generator=torch.Generator().manual_seed(1))
        field = Field(torch.tensor([-0.1, 0.1]), torch.tensor([0.0, 0.6]), sizes, light)
        table = table.replace(unit="fraction", field=field)
    table.save("colours.json")
    grey = image()[:, :1].expand(-1, 4, -1, -1)
    write_image("cut.exr", Picture(grey, ("R", "G", "B", "A"), sample="float"))
    run("cut.exr", "depth.npy", "-o", "out.exr", "--focus-m", "1", *LENS, "--table", "colours.json")
    out = pixels("out.exr")
    torch.testing.assert_close(out[:, 3], out[:, 1])
    assert not torch.allclose(out[:, 0], out[:, 1], atol=1e-3)


def test_show_focus_draws_outlines_by_zone_and_keeps_all_other_colours(scene: Path) -> None:
    colours = torch.tensor([0.3, 0.1, 0.2])[:, None, None].expand(1, 3, HEIGHT, WIDTH).clone()
    colours[..., 8:, :] *= 0.2  # an outline across all three zones
    write_image("photo.exr", Picture(colours, sample="float"))
    np.save("coc.npy", np.tile(np.repeat([-4.0, 0.0, 4.0], WIDTH // 3), (HEIGHT, 1)))
    line = run("photo.exr", "coc.npy", "-o", "tint.exr", "--depth-kind", "coc", "--show-focus")
    tinted = pixels("tint.exr")
    assert tinted[0, :, 7].argmax(dim=0).tolist() == [0] * 8 + [1] * 8 + [2] * 8
    for columns in (slice(0, 7), slice(9, 15), slice(17, 24)):  # away from where zones meet
        for rows in (slice(0, 7), slice(9, 16)):  # and from the outline
            torch.testing.assert_close(tinted[..., rows, columns], colours[..., rows, columns])
    assert "focus shown" in line


def test_show_focus_makes_a_grey_picture_a_coloured_one(scene: Path) -> None:
    write_image("white.png", Picture(torch.full((1, 1, HEIGHT, WIDTH), 0.3), ("Y",)))
    np.save("coc.npy", np.tile(np.repeat([-4.0, 0.0, 4.0], WIDTH // 3), (HEIGHT, 1)))
    run("white.png", "coc.npy", "-o", "tint.png", "--depth-kind", "coc", "--show-focus")
    tinted = pixels("tint.png")
    assert tinted[0, :, 0, [7, 8, 15, 16]].argmax(dim=0).tolist() == [0, 1, 1, 2]
    assert torch.equal(tinted[0, 0, :, :6], tinted[0, 2, :, :6])


def test_json_says_for_programs_what_the_line_says(scene: Path) -> None:
    sequence()
    run("shot.####.exr", "depth.####.npy", "-o", "out.####.exr", "--focus-m", "2", "--frames", "1-1", *LENS)
    printed = run(
        "shot.####.exr", "depth.####.npy", "-o", "out.####.exr", "--focus-m", "inf", *LENS, "--resume", "--json"
    )
    there, *frames = [json.loads(line) for line in printed.splitlines()]
    assert there == {"out": "out.0001.exr", "is_there_already": True}
    assert [frame["out"] for frame in frames] == ["out.0002.exr", "out.0003.exr"]
    camera = {"focus_m": "inf", "f_number": 1.4, "focal_length_mm": 50.0, "sensor_width_mm": 4.0}
    straight = {"focus_range_m": None, "tilt_deg": 0.0, "swing_deg": 0.0}
    assert frames[0]["camera"] == {**camera, **straight} and frames[0]["assumed"] == []
    radius = float(lens(math.inf).coc_px(depth(), WIDTH).abs().max())
    assert frames[0]["largest_coc_px"] == pytest.approx(radius) and frames[0]["table"] == "disc"


def test_attention_loosens_the_tolerance_elsewhere(scene: Path) -> None:
    slope = torch.linspace(2.0, 9.0, WIDTH).expand(1, 1, HEIGHT, WIDTH)
    np.save("depth.npy", slope.numpy())
    arguments = ("image.exr", "depth.npy", "--focus-m", "2", *LENS)
    printed = run(*arguments, "-o", "out.exr", "--json", "--attention", "18,8,4")
    assert json.loads(printed)["attention"] == [18.0, 8.0, 4.0]
    run(*arguments, "-o", "everywhere.exr")
    expected = torchdof.depth_of_field(image(), slope, lens(2.0), attention=(18.0, 8.0, 4.0))
    torch.testing.assert_close(pixels("out.exr"), expected, rtol=0, atol=1e-6)
    difference = (pixels("out.exr") - pixels("everywhere.exr")).abs()
    assert float(difference[..., 8, 18].max()) < 1e-5 < float(difference[..., :8].max())


def test_jpeg_in_jpeg_out_keeps_metadata(scene: Path) -> None:
    picture = Picture(image(), metadata={"Make": ("string", "Maker"), "FNumber": ("float", 2.0)})
    write_image("photo.jpg", picture)
    run("photo.jpg", "depth.npy", "-o", "out.jpg", "--focus-m", "2")
    metadata = read_image("out.jpg").metadata
    assert metadata["Make"][1] == "Maker" and metadata["FNumber"][1] == 2.0


def test_bits_and_transfer_of_the_result_are_as_asked(scene: Path) -> None:
    np.save("depth.npy", np.full((HEIGHT, WIDTH), 2.0))
    run("image.exr", "depth.npy", "-o", "out.png", "--focus-m", "2", "--bits", "16", "--out-transfer", "linear")
    back = read_image("out.png", transfer="linear")
    assert back.sample == "16"
    torch.testing.assert_close(back.pixels, image(), rtol=0, atol=1e-5)


def sequence(count: int = 3) -> None:
    for n in range(1, count + 1):
        write_image(f"shot.{n:04d}.exr", Picture(image() * n, sample="float"))
        np.save(f"depth.{n:04d}.npy", depth().numpy())


def test_sequence_follows_the_focus_of_its_keyframes(scene: Path) -> None:
    sequence()
    arguments = ("shot.####.exr", "depth.####.npy", "-o", "out.####.exr", "--focus-m", "1:2,3:6", *LENS)
    lines = run(*arguments).splitlines()
    assert [re.search(r"out.(\d+).exr: focus ([\d.]+) m", line).groups() for line in lines] == [  # type: ignore[union-attr]
        ("0001", "2"),
        ("0002", "3"),
        ("0003", "6"),
    ]
    for n, focus_m in ((1, 2.0), (2, 3.0), (3, 6.0)):
        camera = lens(focus_m)
        expected = torchdof.depth_of_field(image() * n, depth(), camera)
        torch.testing.assert_close(pixels(f"out.{n:04d}.exr"), expected, rtol=0, atol=1e-5)


def test_resume_renders_only_what_is_missing(scene: Path) -> None:
    sequence()
    arguments = ("shot.####.exr", "depth.npy", "-o", "out.####.exr", "--focus-m", "2", *LENS)
    run(*arguments)
    (scene / "out.0002.exr").unlink()
    os.utime("out.0001.exr", (1, 1))
    lines = run(*arguments, "--resume").splitlines()
    assert lines[0] == "2 of 3 frames are there already"
    assert len(lines) == 2 and lines[1].startswith("out.0002.exr: ")
    assert os.stat("out.0001.exr").st_mtime == 1


def flickering(count: int) -> None:
    generator = torch.Generator().manual_seed(2)
    for n in range(1, count + 1):
        write_image(f"shot.{n:04d}.exr", Picture(image(), sample="float"))
        edge = torch.roll(depth(), n % 3 - 1, -1)
        np.save(f"depth.{n:04d}.npy", (edge * (1 + 0.01 * torch.randn(edge.shape, generator=generator))).numpy())


def test_steady_depth_flickers_less_and_parts_are_those_of_the_whole(scene: Path) -> None:
    flickering(12)
    arguments = ("shot.####.exr", "depth.####.npy", "-o", "out.####.exr", "--focus-m", "2", *LENS)
    run(*arguments)
    given = torch.cat([pixels(f"out.{n:04d}.exr") for n in range(1, 13)])
    run(*arguments, "--steady")
    steady = torch.cat([pixels(f"out.{n:04d}.exr") for n in range(1, 13)])
    assert (steady[6:] - steady[5:-1]).square().mean() < (given[6:] - given[5:-1]).square().mean() / 9
    run("shot.####.exr", "depth.####.npy", "-o", "part.####.exr", *arguments[4:], "--steady", "--frames", "7-9")
    for n in (3, 8, 12):
        (scene / f"out.{n:04d}.exr").unlink()
    run(*arguments, "--steady", "--resume")
    assert torch.equal(torch.cat([pixels(f"out.{n:04d}.exr") for n in range(1, 13)]), steady)
    assert torch.equal(torch.cat([pixels(f"part.{n:04d}.exr") for n in range(7, 10)]), steady[6:9])


def test_steady_needs_a_sequence_and_metres(scene: Path) -> None:
    sequence()
    message = run("image.exr", "depth.npy", "-o", "out.exr", "--focus-m", "2", "--steady", code=2)
    assert "image.exr: is a single image" in message
    coc = ("shot.####.exr", "depth.####.npy", "-o", "out.####.exr", "--depth-kind", "coc", "--steady")
    assert "--steady filters depth in metres" in run(*coc, code=2)


def test_frames_choose_a_part_of_a_sequence(scene: Path) -> None:
    sequence()
    run("shot.####.exr", "depth.npy", "-o", "out.####.exr", "--focus-m", "2", "--frames", "2-3")
    assert sorted(p.name for p in scene.glob("out.*")) == ["out.0002.exr", "out.0003.exr"]
    message = run("shot.####.exr", "depth.npy", "-o", "o.####.exr", "--focus-m", "2", "--frames", "2-5", code=2)
    assert "shot.0004.exr: there is no such file (2 of 4 frames missing)" in message


def test_missing_depth_frame_is_found_before_anything_is_rendered(scene: Path) -> None:
    sequence()
    (scene / "depth.0003.npy").unlink()
    message = run("shot.####.exr", "depth.####.npy", "-o", "out.####.exr", "--focus-m", "2", code=2)
    assert "depth.0003.npy: there is no such file (1 of 3 depths missing)" in message
    assert list(scene.glob("out.*")) == []


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("none.exr", "depth.npy", "--focus-m", "2"), "none.exr: there is no such file"),
        (("image.exr", "none.npy", "--focus-m", "2"), "none.npy: there is no such file"),
        (("image.exr", "--focus-m", "2"), "image.exr: has no depth channel; name a depth file"),
        (("image.exr", "depth.npy"), "where is the focus? give --focus-m METRES or --focus-at X,Y"),
        (("image.exr", "depth.npy", "--focus-m", "near"), "--focus-m expects metres (2.0) or keyframes"),
        (("image.exr", "depth.npy", "--focus-m", "1:2,5:3"), "--focus-m has keyframes but IMAGE is a single image"),
        (("image.exr", "depth.npy", "--focus-m", "0.01"), "--focus-m must be longer than the focal length"),
        (("image.exr", "depth.npy", "--focus-at", "3"), "--focus-at expects a pixel X,Y such as 320,200, got '3'"),
        (("image.exr", "depth.npy", "--focus-at", "99,5"), "focus point (99.0, 5.0) must lie in the frame of 24 x 16"),
        (("image.exr", "depth.npy", "--focus-m", "2", "--focus-at", "3,3"), "--focus-m and --focus-at both say"),
        (("image.exr", "depth.npy", "--focus-m", "2", "--f-number", "-1"), "--f-number must be positive"),
        (("image.exr", "depth.npy", "--focus-m", "2", "--fov-deg", "40"), "--fov-deg needs the opening of the lens"),
        (("image.exr", "depth.npy", "--focus-m", "2", "--aperture-radius-m", "0.1"), "goes with --fov-deg"),
        (("image.exr", "depth.npy", "--focus-m", "2", "--fov-deg", "40", "--focal-length-mm", "50"), "say the same"),
        (
            ("image.exr", "depth.npy", "--focus-m", "2", "--table", "nowhere"),
            "no blur table 'nowhere': neither a file nor one of disc, gaussian, double_gauss_50mm_f2, ",
        ),
        (("image.exr", "depth.npy", "--focus-m", "2", "--attention", "3,4"), "--attention expects X,Y,RADIUS"),
        (("image.exr", "depth.npy", "--focus-m", "2", "--attention", "3,4,0"), "(x, y, radius) in pixels, radius > 0"),
        (("image.exr", "depth.npy", "--focus-m", "2", "--tolerance", "-1"), "tolerance must be"),
        (("image.exr", "depth.npy", "--focus-m", "2", "--tolerance", "best"), "one of 'draft', 'preview', 'final'"),
        (("image.exr", "depth.npy", "--focus-m", "2", "--device", "warp"), "--device warp: there is no such device"),
        (
            ("image.exr", "depth.npy", "--focus-m", "2", "--fill-depth", "x"),
            "--fill-depth expects nearest, far or metres",
        ),
        (("image.exr", "depth.npy", "--focus-m", "2", "--depth-kind", "disparity"), "disparity needs a scale"),
        (
            ("image.exr", "depth.npy", "--focus-m", "2", "--depth-kind", "distance"),
            "--depth-kind distance needs --fov-deg",
        ),
        (("image.exr", "depth.npy", "--focus-m", "2", "--depth-kind", "coc"), "--depth-kind coc is the blur itself"),
        (
            ("image.exr", "depth.npy", "--focus-m", "2", "--depth-kind", "relative", "--near-m", "1"),
            "--depth-kind relative needs --near-m and --far-m",
        ),
        (("image.exr", "depth.npy", "--focus-m", "2", "--near-m", "1"), "add --depth-kind relative"),
        (
            ("image.exr", "depth.npy", "--focus-m", "2", "--depth-kind", "relative", "--near-m", "5", "--far-m", "1"),
            "depth.npy: near_m must be nearer than far_m",
        ),
        (
            ("image.exr", "depth.npy", "--focus-m", "2", "--value-range", "3"),
            "--value-range expects two numbers such as 0,255",
        ),
        (("image.exr", "depth.npy", "--focus-m", "2", "--layer", "b"), "image.exr: has no layer 'b'"),
        (("image.exr", "small.npy", "--focus-m", "2"), "small.npy: depth is 3 x 4 pixels and the image 24 x 16"),
        (("image.exr", "depth.####.npy", "--focus-m", "2"), "image.exr: is a single image"),
        (("image.exr", "depth.npy", "--focus-m", "2", "--frames", "1-2"), "image.exr: is a single image"),
        (("shot.####.exr", "depth.npy", "--focus-m", "2"), "out.exr: expected one place for the frame number"),
    ],
)
def test_wrong_input_is_one_sentence_and_exit_code_2(scene: Path, arguments: tuple[str, ...], says: str) -> None:
    np.save("small.npy", np.ones((4, 3)))
    message = run(*arguments, "-o", "out.exr", code=2)
    assert message.startswith("error: ") and says in message
    assert message.count("\n") == 1
    assert not (scene / "out.exr").exists()


def test_inputs_are_not_overwritten(scene: Path) -> None:
    before = (scene / "image.exr").read_bytes()
    assert "is one of the inputs" in run("image.exr", "depth.npy", "-o", "./image.exr", "--focus-m", "2", code=2)
    assert (scene / "image.exr").read_bytes() == before


@pytest.mark.parametrize("arguments", [["render", "image.exr"], ["render", "--nonsense"], ["nonsense"]])
def test_wrong_usage_is_exit_code_2(scene: Path, arguments: list[str]) -> None:
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert "Traceback" not in result.output


def test_help_teaches_by_examples() -> None:
    text = CliRunner().invoke(app, ["render", "--help"], env={"COLUMNS": "200"}).output
    for example in ("torchdof render shot.exr -o out.exr", "--focus-m 1:2,48:5.5", "--depth-kind disparity"):
        assert example in text


def test_python_dash_m_is_the_command(scene: Path) -> None:
    result = subprocess.run(
        [sys.executable, "-m", "torchdof", "render", "image.exr", "none.npy", "-o", "out.exr", "--focus-m", "2"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 2
    assert result.stderr == "error: none.npy: there is no such file\n"


def test_options_shape_the_blur_and_the_focus(scene: Path) -> None:
    line = run(
        *("image.exr", "depth.npy", "-o", "out.exr", "--focus-range", "1.5,1.8", "--tilt", "3", "--swing", "-1", *LENS),
        *("--blades", "5", "--rotation", "15", "--curvature", "0.2", "--squeeze", "1.5", "--vignetting", "0.3"),
    )
    assert "focus 1.5 to 1.8 m" in line and "tilt 3 degrees" in line and "swing -1 degrees" in line
    assert "5 blades, curvature 0.2, turned by 15, squeeze 1.5, vignetting 0.3" in line
    camera = lens(1.0).replace(focus_range_m=(1.5, 1.8), tilt_deg=3.0, swing_deg=-1.0)
    table = torchdof.BlurTable.polygon(5, 15.0, 0.2, squeeze=1.5, vignetting=0.3)
    expected = torchdof.depth_of_field(image(), depth(), camera, table=table)
    torch.testing.assert_close(read_image("out.exr").pixels, expected, rtol=0, atol=1e-6)


def test_a_picture_can_be_the_aperture(scene: Path) -> None:
    mask = torch.zeros(1, 3, 8, 8)
    mask[..., 1:7, 1:3] = 1.0
    write_image("slit.png", Picture(mask, sample="8", transfer="srgb"))
    run("image.exr", "depth.npy", "-o", "out.exr", "--focus-m", "6", "--aperture", "slit.png", *LENS)
    table = torchdof.BlurTable.from_aperture(mask[0, 0])
    expected = torchdof.depth_of_field(image(), depth(), lens(6.0), table=table)
    torch.testing.assert_close(read_image("out.exr").pixels, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--focus-m", "2", "--focus-range", "1,2"), "--focus-m and --focus-range both say where to focus"),
        (("--focus-range", "2,1"), "--focus-range must go from near to far"),
        (("--focus-range", "2"), "--focus-range expects two numbers such as 1.5,2.2"),
        (("--focus-m", "2", "--tilt", "95"), "--tilt must be in (-90, 90) degrees"),
        (("--focus-m", "2", "--blades", "2"), "--blades must be a whole number from 3 to 64"),
        (("--focus-m", "2", "--rotation", "5"), "--rotation turns blades or an image"),
        (("--focus-m", "2", "--squeeze", "0"), "--squeeze must be a number from 0.1 to 10"),
        (("--focus-m", "2", "--blades", "5", "--aperture", "a.png"), "--aperture is the whole opening"),
    ],
)
def test_shapes_and_ranges_that_make_no_sense_are_refused(scene: Path, options: tuple[str, ...], message: str) -> None:
    assert message in run("image.exr", "depth.npy", "-o", "out.exr", *options, *LENS, code=2)
