"""``torchdof render``: files in, files out, and one line that summarizes each picture."""

import json
import math
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from torch import Tensor

import torchdof
from tests.files import store
from torchdof.cli.frame import coc_of, read_frame
from torchdof.cli.main import app
from torchdof.cli.options import Scene
from torchdof.cli.output import Notices, rounded
from torchdof.cli.renderer import Renderer
from torchdof.io.highlights import expand_highlights
from torchdof.io.images import Picture, read_image, read_values, write_image
from torchdof.optics.field import Field

pytestmark = pytest.mark.usefixtures("scene")  # its files lie in the working folder

Run = Callable[..., str]
LENS = "--focal-length-mm 50 --f-number 1.2 --sensor-width-mm 4"  # blurs by 2.1 px
ONE = "render image.exr depth.npy -o out.exr --focus-m 2"
OLDER = "older than their files or options"
RECORD = Path("out.####.exr.json")
NO_RECORD = f"{RECORD}, which has the options of existing frames, is missing"
PULL = "--focus-m 1:2,3:6 --sensor-width-mm 4 --table lens.json"
SEQUENCE = "render shot.####.exr depth.####.npy -o out.####.exr"


def inside(value: object) -> str:
    """The text of a camera or an opening without its brackets."""
    return repr(value).partition("(")[2].removesuffix(")")


CAMERA = torchdof.Camera(focal_length_mm=50.0, f_number=1.2, focus_m=2.0, sensor_width_mm=4.0)
RENDERED = torchdof.Camera.from_fov(40.0, 0.2, 2.0)
SLIT = torch.zeros(8, 8)
SLIT[1:7, 1:3] = 1.0


def pixels(path: str) -> Tensor:
    return read_image(path).pixels


def with_tags(image: Tensor, sample: Any = "half", **tags: float) -> Picture:
    """A picture with EXIF tags; the f-number is ``FNumber``."""
    names = {name: name if name == "FNumber" else f"Exif:{name}" for name in tags}
    return Picture(image, sample=sample, metadata={names[name]: ("float", value) for name, value in tags.items()})


def told(command: str) -> tuple[str, str]:
    """Standard output of a command, and its notes on standard error."""
    result = CliRunner().invoke(app, command.split(), catch_exceptions=False)
    assert result.exit_code == 0
    return result.stdout, result.stderr


def numbers_in(lines: str, pattern: str) -> list[float]:
    """The numbers that a pattern finds, in order."""
    return [float(number) for number in re.findall(pattern, lines)]


def cut(path: str, byte_count: int) -> None:
    """Takes bytes from the end of a file."""
    content = Path(path).read_bytes()
    Path(path).write_bytes(content[:-byte_count])


SHAPED = CAMERA.replace(focus_range_m=(1.5, 1.8), tilt_deg=3.0, swing_deg=-1.0)
GAUSSIAN_SUM = {"table": torchdof.BlurTable.gaussian(), "occlusion": False, "tolerance": 0.0}
SATO_DRAFT = {"table": torchdof.BlurTable.load("sato_j15"), "tolerance": 8 / 255}
BLADES = "--blades 5 --rotation 15 --curvature 0.2 --squeeze 1.5 --vignetting 0.3"
PENTAGON = torchdof.BlurTable.polygon(5, 15.0, 0.2, squeeze=1.5, vignetting=0.3)


@pytest.mark.parametrize(
    ("options", "camera", "arguments"),
    [
        (f"--focus-m 2 {LENS}", CAMERA, {}),
        (f"--focus-at 21,5 {LENS}", CAMERA.replace(focus_m=6.0), {}),
        ("--focus-m 2 --fov-deg 40 --aperture-radius-m 0.2", RENDERED, {}),
        (f"--focus-m 2 --fov-deg 40 --f-number {RENDERED.f_number}", RENDERED, {}),
        (f"--focus-range 1.5,1.8 --tilt 3 --swing -1 {LENS}", SHAPED, {}),
        (f"--focus-m 2 {LENS} --method fold", CAMERA, {"method": "fold"}),
        (f"--focus-m 2 {LENS} --table gaussian --no-occlusion --tolerance 0", CAMERA, GAUSSIAN_SUM),
        (f"--focus-m 2 {LENS} --table sato_j15 --tolerance draft", CAMERA, SATO_DRAFT),
        (f"--focus-m 2 {LENS} --attention 18,8,4", CAMERA, {"attention": (18.0, 8.0, 4.0)}),
        (f"--focus-m 2 {LENS} --depth-edges as-given", CAMERA, {"depth_edges": "as given"}),
        (f"--focus-m 2 {LENS} {BLADES}", CAMERA, {"table": PENTAGON}),
        (f"--focus-m 2 {LENS} --aperture slit.png", CAMERA, {"table": torchdof.BlurTable.from_aperture(SLIT)}),
    ],
)
def test_render_equals_the_function_on_tensors(
    image: Tensor,
    depth: Tensor,
    run: Run,
    monkeypatch: pytest.MonkeyPatch,
    options: str,
    camera: torchdof.Camera,
    arguments: dict[str, Any],
) -> None:
    write_image("slit.png", Picture(SLIT.expand(1, 3, 8, 8), sample="8", transfer="srgb"))
    passed: dict[str, Any] = {}

    def record(*tensors: Tensor, **others: Any) -> Tensor:
        passed.update(others)
        return torchdof.blur_by_coc(*tensors, **others)

    monkeypatch.setattr("torchdof.cli.renderer.blur_by_coc", record)
    line = run(f"render image.exr depth.npy -o out.exr --device cpu {options}")
    expected = torchdof.depth_of_field(image, depth, camera, **arguments)
    torch.testing.assert_close(pixels("out.exr"), expected, rtol=0, atol=1e-6)
    assert not torch.equal(expected, image)
    plain = {name: value for name, value in arguments.items() if name in ("method", "depth_edges", "attention")}
    assert plain.items() <= passed.items()
    radius = float(camera.coc_px(depth, depth.shape[-1]).abs().max())
    assert line.startswith(f"out.exr: {rounded(inside(camera))}; ") and f"; blur radius up to {radius:.1f} px; " in line
    assert "[" not in line and line.count("\n") == 1


@pytest.mark.parametrize("points", ["--focus-at 21,5 --focus-at 9,12 --focus-at 20,3", "--focus-range-at 9,12,21,5"])
def test_several_points_focus_on_all_between_the_nearest_and_the_farthest(depth: Tensor, run: Run, points: str) -> None:
    depth[..., :6] = 1.0
    np.save("depth.npy", depth.numpy())
    line = run(f"render image.exr depth.npy -o out.exr {points} {LENS}")
    assert line.startswith(f"out.exr: {inside(CAMERA.replace(focus_range_m=(2.0, 6.0)))}; ")
    out, sharp = pixels("out.exr"), pixels("image.exr")
    assert torch.equal(out[..., 12:], sharp[..., 12:])
    assert not torch.equal(out[..., :6], sharp[..., :6])


def test_lights_expand_clipped_lamps_of_a_photograph_and_alpha_is_premultiplied(depth: Tensor, run: Run) -> None:
    night = torch.full((1, 4, 16, 24), 0.01)
    night[:, :3, 8, 18], night[:, 3] = 1.0, 1.0
    night[..., 21:] = 0.0
    write_image("night.png", Picture(night, ("R", "G", "B", "A"), sample="8", transfer="srgb"))
    line = run(f"render night.png depth.npy -o out.exr --focus-m 2 --lights 3 --bits float {LENS}")
    assert "lights up to 3 stops above white" in line
    light = pixels("night.png")
    light = torch.cat([expand_highlights(light[:, :3], 3.0), light[:, 3:]], 1)
    torch.testing.assert_close(pixels("out.exr"), torchdof.depth_of_field(light, depth, CAMERA), rtol=0, atol=1e-5)
    assert float(light.max()) > 2.0
    assert bool(((pixels("out.exr")[:, 3] > 0.01) & (pixels("out.exr")[:, 3] < 0.99)).any())


def test_the_line_states_camera_blur_and_table(run: Run) -> None:
    line = run(f"{ONE} {LENS} --resume --no-occlusion {BLADES}")
    assert run(f"{ONE} {LENS} --resume --no-occlusion {BLADES}") == "out.exr: is there already\n"
    assert line.startswith(f"out.exr: {rounded(inside(CAMERA))}; blur radius up to 2.1 px; disc, layered; ")
    assert f"layered; {inside(PENTAGON.aperture)}; no occlusion; 24 x 16; " in line


def test_the_camera_is_read_from_the_file_and_the_line_names_the_source(image: Tensor, run: Run) -> None:
    tags = {"FocalLength": 85.0, "FNumber": 1.8, "SubjectDistance": 3.0, "FocalLengthIn35mmFilm": 85.0}
    write_image("photo.exr", with_tags(image, **tags))
    line = run("render photo.exr depth.npy -o out.exr")
    assert ": 85 mm, f/1.8, focus 3 m, sensor 36 mm; " in line
    assert line.splitlines()[1:] == [
        "  focus         3 m, from the file    --focus-at, --focus-m",
        "  focal length  85 mm, from the file  --focal-length-mm, --equivalent",
        "  f-number      f/1.8, from the file  --blur, --f-number",
        "  sensor width  36 mm, from the file  --sensor-width-mm, --equivalent",
    ]
    line = run("render photo.exr depth.npy -o out.exr --f-number 4 --focus-m 2")
    assert "85 mm, f/4, focus 2 m" in line and "f-number from" not in line
    assert re.findall(r"\n  (.*?)  +(.*?)  +--", run(ONE)) == [
        ("focal length", "50 mm, assumed"),
        ("f-number", "f/2.8, assumed"),
        ("sensor width", "36 mm, assumed"),
    ]
    write_image("photo.exr", with_tags(image, **tags | {"FNumber": 64.0}))  # hardly any blur
    assert ", for a blur of 2% of the width" in run("render photo.exr depth.npy -o out.exr")


def test_every_kind_of_depth_converts_to_the_same_metres(image: Tensor, depth: Tensor, run: Run) -> None:
    both = torch.cat([image, depth], dim=1)[0].permute(1, 2, 0).contiguous().numpy()
    store(Path("zed.exr"), both, "float", ("R", "G", "B", "Z"))
    near = depth[0, 0].numpy() == 2.0
    store(Path("relative.png"), np.where(near, 200, 10).astype(np.uint8), "uint8", ("Y",))
    disparity = np.where(near, 300, 100).astype(np.uint16)
    disparity[3, 4] = disparity[9, 20] = 0
    store(Path("disparity.png"), disparity, "uint16", ("Y",))
    y, x = np.mgrid[:16, :24] + 0.5
    focal_px = 24 / 2 / math.tan(math.radians(20))
    np.save("ray.npy", depth[0, 0].numpy() * np.sqrt(1 + ((x - 12) ** 2 + (y - 8) ** 2) / focal_px**2))
    np.save("millimetres.npy", 1000 * depth.numpy() - 7)
    np.save("inverse.npy", 1 / depth.numpy())
    np.savez("two.npz", depth=depth.numpy(), other=depth.numpy())
    camera = "--focus-m 2 --fov-deg 40 --aperture-radius-m 0.2"
    run(f"render image.exr depth.npy -o expected.exr {camera}")
    relative = "relative.png --depth-kind relative --near-m 2 --far-m 6"
    for arguments in (
        relative,
        f"{relative} --value-range 10,200",
        "depth.npy --depth-kind relative --near-m 2 --far-m 6 --relative-kind depth",
        "disparity.png --depth-kind disparity --depth-scale 600 --depth-unknown 0 --fill-depth nearest",
        "ray.npy --depth-kind distance",
        "millimetres.npy --depth-scale 0.001 --depth-offset 7",
        "inverse.npy --depth-kind inverse",
        "two.npz --depth-channel other",
        "zed.exr",  # an image with a depth channel
    ):
        line = run(f"render {'image.exr' if arguments != 'zed.exr' else ''} {arguments} -o out.exr {camera}")
        torch.testing.assert_close(pixels("out.exr"), pixels("expected.exr"), rtol=0, atol=1e-4)
        assert ("2 px of depth filled (nearest)" in line) == ("disparity.png" in arguments)
    run(f"render image.exr {relative} -o out.exr {camera} --relative-kind depth")
    assert not torch.allclose(pixels("out.exr"), pixels("expected.exr"), atol=1e-2)


def test_a_map_of_circles_of_confusion_needs_no_camera(image: Tensor, run: Run) -> None:
    coc_px = torch.linspace(-3, 3, 24).expand(1, 1, 16, 24)
    np.save("coc.npy", coc_px.numpy())
    line = run("render image.exr coc.npy -o out.exr --depth-kind coc")
    torch.testing.assert_close(pixels("out.exr"), torchdof.blur_by_coc(image, coc_px), rtol=0, atol=1e-6)
    assert "focus" not in line and "blur radius up to 3.0 px" in line


def test_likely_mistakes_are_one_warning_per_sequence_or_with_strict_an_error(scene: Path, run: Run) -> None:
    relative = f"{SEQUENCE} --focus-m 2 {LENS} --depth-kind relative --near-m 2 --far-m 6 --relative-kind depth"
    warned = told(relative)[1]
    assert warned.count("warning: ") == 1 and "--value-range LOW,HIGH" in warned
    assert told(f"{relative} --value-range 2,6")[1] == ""
    for path in scene.glob("out.*"):
        path.unlink()
    kilometres = f"{SEQUENCE} --focus-m 3 {LENS} --depth-scale 1000"
    assert run(f"{kilometres} --strict", code=2).startswith("error: depth.0001.npy: nothing is in focus")
    assert list(scene.glob("out.*")) == []
    warned = told(kilometres)[1]
    assert warned.startswith("warning: depth.0001.npy: nothing is in focus") and warned.count("\n") == 1
    assert len(list(scene.glob("out.*.exr"))) == 3


@pytest.mark.parametrize("place", ["same everywhere", "across the field"])
def test_table_of_three_colours_blurs_alpha_like_green(image: Tensor, run: Run, place: str) -> None:
    table = torchdof.BlurTable("gaussian", coc=[1.0], params={"sigma": [[0.2], [0.5], [0.9]]})
    if place == "across the field":
        sizes = torch.tensor([0.2, 0.1, 0.3, 0.2]).reshape(2, 2, 1).expand(2, 2, 3)
        light = torch.rand(3, 2, 2, 8, 4, generator=torch.Generator().manual_seed(1))
        field = Field(torch.tensor([-0.1, 0.1]), torch.tensor([0.0, 0.6]), sizes, light)
        table = table.replace(unit="fraction", field=field)
    table.save("colours.json")
    write_image("cut.exr", Picture(image[:, :1].expand(-1, 4, -1, -1), ("R", "G", "B", "A"), sample="float"))
    run(f"render cut.exr depth.npy -o out.exr --focus-m 1 {LENS} --table colours.json")
    out = pixels("out.exr")
    torch.testing.assert_close(out[:, 3], out[:, 1])
    assert not torch.allclose(out[:, 0], out[:, 1], atol=1e-3)


def test_show_focus_tints_by_zone_and_keeps_light_and_shade(run: Run) -> None:
    colours = torch.tensor([0.3, 0.1, 0.2])[:, None, None].expand(1, 3, 16, 24).clone()
    colours[..., 8:, :] *= 0.2
    write_image("photo.exr", Picture(colours, sample="float"))
    write_image("grey.png", Picture(torch.full((1, 1, 16, 24), 0.3), ("Y",)))
    np.save("coc.npy", np.tile(np.repeat([-4.0, 0.0, 4.0], 8), (16, 1)))
    line = run("render photo.exr coc.npy -o tint.exr --depth-kind coc --show-focus")
    tinted = pixels("tint.exr")
    assert tinted[0].argmax(dim=0).tolist() == [[0] * 8 + [1] * 8 + [2] * 8] * 16
    assert bool((tinted.amax(1) < 1.5 * colours.amax(1)).all()), "too strong"
    lit, dark = tinted[..., :8, :].mean((1, 2)), tinted[..., 8:, :].mean((1, 2))
    assert bool((lit > 3.5 * dark).all())
    assert "focus shown" in line
    run("render grey.png coc.npy -o tint.png --depth-kind coc --show-focus")
    assert pixels("tint.png")[0, :, 0, [0, 8, 16]].argmax(dim=0).tolist() == [0, 1, 2]


def test_json_has_the_facts_of_the_line(depth: Tensor, run: Run) -> None:
    line = f"{SEQUENCE} --focus-m inf {LENS} --attention 18,8,4"
    run(f"{line} --frames 1-1")
    there, *frames = [json.loads(printed) for printed in run(f"{line} --resume --json").splitlines()]
    assert there == {"out": "out.0001.exr", "is_there_already": True}
    assert [frame["out"] for frame in frames] == ["out.0002.exr", "out.0003.exr"]
    assert frames[0].pop("seconds") > 0 and frames[0].pop("device") in ("cpu", "cuda")
    camera: dict[str, Any] = {"focus_m": "inf", "f_number": 1.2, "focal_length_mm": 50.0, "sensor_width_mm": 4.0}
    radius = float(CAMERA.replace(focus_m=math.inf).coc_px(depth, 24).abs().max())
    expected: dict[str, Any] = {"out": "out.0002.exr", "assumed": [], "largest_coc_px": pytest.approx(radius)}
    expected |= {"camera": camera | {"focus_range_m": None, "tilt_deg": 0.0, "swing_deg": 0.0, "focus_breathing": True}}
    expected |= {"width": 24, "height": 16, "filled_px": 0, "show_focus": False, "table": "disc", "aperture": None}
    expected |= {"method": "layered", "occlusion": True, "tolerance": 1 / 255, "attention": [18.0, 8.0, 4.0]}
    assert frames[0] == expected | {"lights": 0.0}


def test_metadata_are_copied_and_bits_and_transfer_follow_the_options(image: Tensor, run: Run) -> None:
    write_image("photo.jpg", Picture(image, metadata={"Make": ("string", "Maker"), "FNumber": ("float", 2.0)}))
    run("render photo.jpg depth.npy -o out.jpg --focus-m 2")
    metadata = read_image("out.jpg").metadata
    assert metadata["Make"][1] == "Maker" and metadata["FNumber"][1] == 2.0
    np.save("depth.npy", np.full((16, 24), 2.0))
    run("render image.exr depth.npy -o out.png --focus-m 2 --bits 16 --out-transfer linear")
    back = read_image("out.png", transfer="linear")
    assert back.sample == "16"
    torch.testing.assert_close(back.pixels, image, rtol=0, atol=1e-5)
    run("render out.png depth.npy -o again.exr --focus-m 2 --transfer linear --bits float")
    torch.testing.assert_close(pixels("again.exr"), image, rtol=0, atol=1e-5)


def test_a_phones_lens_without_a_sensor_is_wide_and_an_impossible_distance_is_no_focus(image: Tensor, run: Run) -> None:
    write_image("phone.png", with_tags(image, "8", FocalLength=4.0, SubjectDistance=0.001))
    line = run("render phone.png depth.npy -o out.png")
    assert ": 4 mm, f/" in line and "sensor 5.54 mm" in line and "5.54 mm, assumed" in line  # 36 / 26 * 4 mm
    assert "on what is nearest the middle" in line
    assert "sensor 8 mm" in run("render phone.png depth.npy -o out.png --sensor-width-mm 8 --focus-m 2")


@pytest.mark.parametrize(("suffix", "notes"), [(".webp", 0), (".hdr", 1), (".jpg", 0), (".exr", 0)])
def test_a_note_states_that_a_type_of_file_holds_no_exif(image: Tensor, suffix: str, notes: int) -> None:
    write_image("photo.png", with_tags(image, "8", FocalLength=50.0))
    note = told(f"render photo.png depth.npy -o out{suffix} --focus-m 2 {LENS}")[1]
    assert note.count(f"out{suffix}: EXIF data are lost in a {suffix} file; write .jpg, .png or .tif") == notes
    assert ("Exif:FocalLength" in read_image(f"out{suffix}").metadata) != bool(notes)


def test_a_note_names_the_layers_of_an_exr_that_are_not_copied(image: Tensor, depth: Tensor) -> None:
    channels = torch.cat([image, depth, image, image[:, :1]], 1)[0].permute(1, 2, 0).numpy()
    store(Path("shot.exr"), channels, "float", ("R", "G", "B", "Z", "dif.R", "dif.G", "dif.B", "N.Z"))
    note = told("render shot.exr -o out.exr --focus-m 2")[1]
    assert "note: out.exr: is without the other layers of the image: N, dif (--keep-layers)\n" in note
    assert "layers" not in told("render shot.exr -o kept.exr --focus-m 2 --keep-layers")[1]
    assert torch.equal(pixels("kept.exr"), pixels("out.exr"))
    assert torch.equal(read_values("kept.exr", "Z"), depth) and read_values("kept.exr", "dif.R").shape == depth.shape
    for options in ("shot.exr -o out.png", "image.exr depth.npy -o out.exr"):
        assert "layers" not in told(f"render {options} --focus-m 2")[1]


def test_a_sequence_interpolates_the_focus_between_keyframes(image: Tensor, depth: Tensor, run: Run) -> None:
    assert numbers_in(run(f"{SEQUENCE} --focus-m 1:2,3:6 {LENS}"), r"focus ([\d.]+) m") == [2, 3, 6]
    for n, focus_m in ((1, 2.0), (2, 3.0), (3, 6.0)):
        expected = torchdof.depth_of_field(image * n, depth, CAMERA.replace(focus_m=focus_m))
        torch.testing.assert_close(pixels(f"out.{n:04d}.exr"), expected, rtol=0, atol=1e-5)


def test_steady_depth_flickers_less_and_resumed_or_partial_runs_give_the_same_frames(
    scene: Path, image: Tensor, depth: Tensor, run: Run
) -> None:
    generator = torch.Generator().manual_seed(2)
    for n in range(1, 13):
        write_image(f"shot.{n:04d}.exr", Picture(image, sample="float"))
        edge = torch.roll(depth, n % 3 - 1, -1)
        np.save(f"depth.{n:04d}.npy", (edge * (1 + 0.01 * torch.randn(edge.shape, generator=generator))).numpy())

    def rendered(name: str, options: str = "", first: int = 1, last: int = 12) -> Tensor:
        run(f"{SEQUENCE} -o {name}.####.exr --focus-m 2 {LENS} {options}")
        return torch.cat([pixels(f"{name}.{n:04d}.exr") for n in range(first, last + 1)])

    given, steady = rendered("given"), rendered("out", "--steady")
    assert (steady[6:] - steady[5:-1]).square().mean() < (given[6:] - given[5:-1]).square().mean() / 9
    for n in (3, 8, 12):
        (scene / f"out.{n:04d}.exr").unlink()
    assert torch.equal(rendered("out", "--steady --resume"), steady)
    assert torch.equal(rendered("part", "--steady --frames 7-9", 7, 9), steady[6:9])


@pytest.mark.parametrize(
    ("change", "options", "again", "reason"),
    [
        (lambda: None, "--f-number 4", 3, "--f-number changed"),
        (lambda: np.save("depth.0002.npy", np.full((16, 24), 5.0)), "", 1, OLDER),
        (lambda: write_image("shot.0003.exr", Picture(torch.ones(1, 3, 16, 24))), "", 1, OLDER),
        (lambda: np.save("depth.0002.npy", np.full((16, 24), 5.0)), "--steady", 2, OLDER),
        (lambda: torchdof.BlurTable.gaussian().save("lens.json"), "", 3, OLDER),
        (lambda: RECORD.unlink(), "", 3, NO_RECORD),
        (lambda: RECORD.write_text(""), "", 3, NO_RECORD),
        (lambda: cut("out.0002.exr", 1), "", 1, "or they are cut short"),
        (lambda: told(f"{SEQUENCE} --f-number 4 {PULL} --frames 1"), "", 3, "--f-number changed"),
        (lambda: told(f"{SEQUENCE} --f-number 4 {PULL} --frames 1"), "--f-number 4", 2, OLDER),
    ],
)
def test_resume_renders_frames_again_whose_options_or_files_changed(
    change: Callable[[], object], options: str, again: int, reason: str
) -> None:
    torchdof.BlurTable.disc().save("lens.json")
    line = f"{SEQUENCE} {PULL} {options if options == '--steady' else ''}"
    told(line)
    kept = "3 of 3 frames are there already\n"
    assert told(f"{line} --resume") == (kept, "")
    change()
    line = f"{SEQUENCE} {PULL} {options}"
    printed, noted = told(f"{line} --resume")
    assert printed.count("; blur radius") == again and f"{again} of 3 frames" in noted and reason in noted
    assert told(f"{line} --resume") == (kept, "")
    told(line.replace("-o out.", "-o new."))
    for n in (1, 2, 3):
        assert torch.equal(pixels(f"out.{n:04d}.exr"), pixels(f"new.{n:04d}.exr"))


def test_a_run_ends_if_another_one_renders_its_frames_with_other_options(
    scene: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    torchdof.BlurTable.disc().save("lens.json")
    render, rendered = Renderer.render, list[int]()

    def render_second_after_another_run(self: Renderer, *arguments: Any) -> Any:
        rendered.append(arguments[2])
        if rendered == [1, 2]:
            monkeypatch.setattr(Renderer, "render", render)
            run(f"{SEQUENCE} {PULL} --f-number 4")
        return render(self, *arguments)

    monkeypatch.setattr(Renderer, "render", render_second_after_another_run)
    message = run(f"{SEQUENCE} {PULL}", code=2)
    assert "out.####.exr.json: another run renders the same frames with other options (--f-number" in message
    assert told(f"{SEQUENCE} {PULL} --f-number 4 --resume")[0] == "3 of 3 frames are there already\n"


def test_frames_that_another_run_replaced_are_named_at_the_end(
    scene: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame that an earlier run with other options was still writing when this one began."""
    torchdof.BlurTable.disc().save("lens.json")
    render, rendered = Renderer.render, list[int]()

    def render_after_a_late_write(self: Renderer, *arguments: Any) -> Any:
        rendered.append(arguments[2])
        if rendered == [1, 2, 3]:
            shutil.copy("image.exr", "late.exr")
            Path("late.exr").replace("out.0001.exr")
        return render(self, *arguments)

    monkeypatch.setattr(Renderer, "render", render_after_a_late_write)
    message = run(f"{SEQUENCE} {PULL}", code=2)
    assert "another run replaced 1 of 3 frames, out.0001.exr first, while this one went on" in message


def test_the_first_run_ends_even_if_the_other_begins_with_its_last_frame(
    scene: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    torchdof.BlurTable.disc().save("lens.json")
    write, written = Renderer.write, list[Path]()

    def write_before_another_run(self: Renderer, out: Path, *arguments: Any, **named: Any) -> None:
        write(self, out, *arguments, **named)
        written.append(out)
        if len(written) == 3:
            record = json.loads(Path(RECORD).read_text()) | {"--f-number": 4.0}
            Path(RECORD).write_text(json.dumps(record))

    monkeypatch.setattr(Renderer, "write", write_before_another_run)
    assert "another run renders the same frames with other options (--f-number" in run(f"{SEQUENCE} {PULL}", code=2)


def test_resume_removes_what_killed_runs_left(scene: Path, run: Run) -> None:
    torchdof.BlurTable.disc().save("lens.json")
    run(f"{SEQUENCE} {PULL}")
    old, young, other = [Path(f".{c * 32}.part.exr") for c in "0a"], Path(f".{'b' * 32}.part.exr"), Path(".my.part.exr")
    for path in [*old, young, other]:
        path.write_bytes(b"half")
    for path in old:
        os.utime(path, (1.0, 1.0))
    notes = told(f"{SEQUENCE} {PULL} --resume")[1]
    assert "removed 2 unfinished files (.part) of killed runs" in notes and "1 unfinished files (.part) stay" in notes
    assert young.is_file() and other.is_file() and not any(path.exists() for path in old)


# Names


@pytest.mark.parametrize("name", ["take #1/x.exr", "50%done/x.exr", "IMG #1.exr", "a##b.exr", "%d.exr", "x %03d.exr"])
def test_an_existing_file_named_like_a_pattern_is_one_image(scene: Path, image: Tensor, run: Run, name: str) -> None:
    path = scene / name
    path.parent.mkdir(exist_ok=True)
    write_image(path, Picture(image))
    out = path.with_name(f"out {path.name}")
    run("render --focus-m 2", name, "depth.npy", "-o", out)
    assert pixels(str(out)).shape == image.shape


def test_the_subject_of_an_inverted_map_is_the_same(run: Run) -> None:
    """A person, at 0.8 of the range of nearness, stands on the ground before a wall."""
    nearness = torch.linspace(0.0, 1.0, 16)[:, None].repeat(1, 24)
    nearness[:8] = 0.1
    nearness[4:14, 8:16] = 0.8
    np.save("near.npy", nearness.numpy())
    np.save("far.npy", (1.0 - nearness).numpy())
    near_m, far_m = (
        json.loads(run(f"render image.exr {name}.npy -o out.exr --json"))["camera"]["focus_m"]
        for name in ("near", "far")
    )
    place = (1 / near_m - 1 / 8) / (1 - 1 / 8)
    assert place == pytest.approx(0.8, abs=0.05) and far_m == pytest.approx(8 - 7 * place, rel=1e-3)


@pytest.mark.parametrize(("height", "width", "share"), [(132, 194, "2.1%"), (96, 96, "50%")])
def test_depth_of_another_shape_is_stretched_as_the_line_states(
    run: Run, image: Tensor, depth: Tensor, height: int, width: int, share: str
) -> None:
    write_image("large.exr", Picture(torch.nn.functional.interpolate(image, (64, 96)), sample="float"))
    stretched = torch.nn.functional.interpolate(depth, (height, width), mode="nearest")
    np.save("stretched.npy", stretched.numpy())
    line = run(f"render large.exr stretched.npy -o out.exr --focus-m 2 {LENS}")
    assert f"depth  of {width} x {height} px stretched by {share}" in line and "96 x 64" in line
    with pytest.warns(UserWarning, match="stretched"):
        expected = torchdof.depth_of_field(pixels("large.exr"), stretched, CAMERA)
    torch.testing.assert_close(pixels("out.exr"), expected, rtol=0, atol=1e-5)


def test_the_folder_of_the_output_is_made(run: Run) -> None:
    run(f"render image.exr depth.npy -o new/folder/out.exr --focus-m 2 {LENS}")
    assert read_image("new/folder/out.exr").pixels.shape[-1] == 24


# The first command

GREY = (
    "taken for relative depth (else --depth-kind), larger is nearer (else --relative-kind depth), from 1 to 8 m (else "
    "--near-m, --far-m)"
)


@pytest.mark.parametrize(
    ("low", "high", "sample", "noted"),
    [(20, 250, "uint8", GREY), (3000, 65500, "uint16", GREY), (900, 5000, "uint16", "taken for millimetres")],
)
def test_the_first_command_needs_no_option(run: Run, low: int, high: int, sample: str, noted: str) -> None:
    """A subject in front of a slope: the subject is sharp, and the largest blur is 2 % of the width."""
    size = (80, 120)
    image = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(3))
    write_image("photo.png", Picture(image, sample="8", transfer="srgb"))
    far, near = (high, low) if "millimetres" in noted else (low, high)
    values = np.repeat(np.linspace(far, (far + near) / 2, size[0])[:, None], size[1], 1)
    values[20:, 40:80] = near
    store(Path("depth.png"), values.astype(sample), sample, ("Y",))
    line, note = told("render photo.png depth.png -o out.png")
    assert note.count("\n") == 1 and note.startswith(f"note: depth.png: {noted}")
    assert "blur radius up to 2.4 px" in line and ", for a blur of 2% of the width" in line
    assert "on what is nearest the middle" in line
    before, after = pixels("photo.png"), pixels("out.png")
    torch.testing.assert_close(after[..., 45:, 50:70], before[..., 45:, 50:70], rtol=0, atol=0.01)
    assert float((after - before)[..., :12, :].abs().mean()) > 0.05


def test_a_guess_of_metres_is_noted_unless_the_focus_is_in_metres(depth: Tensor, run: Run) -> None:
    line, note = told("render image.exr depth.npy -o out.exr")
    assert note.startswith("note: depth.npy: taken for metres") and "focus 2 m" in line
    assert told(f"{ONE} {LENS}")[1] == ""
    np.save("estimate.npy", np.linspace(2.0, 30.0, 16, dtype=np.float32)[:, None].repeat(24, 1))
    line, note = told("render image.exr estimate.npy -o out.exr --focus-m 2")
    assert "2 m, " in line and "taken for metres, as the options are in metres, but its numbers grow downwards" in note
    assert "taken for relative depth" in told("render image.exr estimate.npy -o out.exr")[1]
    holed = depth.clone()
    holed[..., 3, 4:6] = 0.0
    np.save("depth.npy", holed.numpy())
    assert "2 px of depth filled (far)" in told("render image.exr depth.npy -o out.exr")[0]
    assert "no depth" in run(f"{ONE} {LENS}", code=2)


# How much blur


@pytest.mark.parametrize("value", [65535, 65504, 32767])
def test_stray_sentinels_change_neither_the_guess_nor_the_other_pixels(run: Run, depth: Tensor, value: int) -> None:
    metres = torch.linspace(2.0, 6.0, 24).expand(1, 1, 16, 24)
    mm = (1000 * metres[0, 0]).round().numpy().astype(np.uint16)
    given = mm.copy()
    given[3, 5:8], mm[3, 5:8] = value, 0  # 0 is not measured too
    store(Path("a.png"), given, "uint16")
    store(Path("b.png"), mm, "uint16")
    for options in ("", "--depth-scale 0.001 --fill-depth far "):
        (line, notes), _ = (told(f"render image.exr {name} {options}-o {name}.exr") for name in ("a.png", "b.png"))
        assert f"3 px of {value} without depth" in line and "3 px of depth filled (far)" in line
        assert options or "taken for millimetres" in notes
        assert torch.equal(pixels("a.png.exr"), pixels("b.png.exr"))


def test_what_is_too_near_to_measure_is_the_nearest_and_not_the_farthest(run: Run, image: Tensor) -> None:
    metres = np.linspace(2.0, 6.0, 24, dtype=np.float32)[None].repeat(16, 0)
    metres[:, 10] = -np.inf
    np.save("near.npy", metres)
    of_kinds: list[dict[str, Any]] = [{"depth_kind": "z", "fill_depth": "far"}]
    of_kinds += [{"depth_kind": "relative", "relative_kind": "depth", "near_m": 2.0, "far_m": 6.0}]
    for options in of_kinds:
        scene = Scene(focus_m=[(0, 2.0)], **options)
        frame = read_frame(Path("image.exr"), Path("near.npy"), scene)
        assert bool((frame.values[..., 10] == 2.0).all()), options


def test_a_guess_that_is_not_safe_names_both_directions(run: Run) -> None:
    values = np.full((16, 24), 0.9, np.float32) + np.linspace(0, 0.1, 24, dtype=np.float32)
    values[5:, 8:16] = np.linspace(0.0, 0.05, 8, dtype=np.float32)
    np.save("marigold.npy", values)
    notes = told("render image.exr marigold.npy -o out.exr")[1]
    assert "larger is farther by a guess that is not safe: --relative-kind depth if larger is farther" in notes
    assert "--relative-kind disparity if larger is nearer" in notes


def test_a_sequence_of_relative_depth_is_not_taken_for_metres_in_silence(run: Run) -> None:
    disparity = torch.linspace(0.3, 12.0, 16)[None, None, :, None].repeat(1, 1, 1, 24)
    for n in range(1, 4):
        write_image(f"video.{n:04d}.exr", Picture(disparity, ("Y",), sample="float"))
    command = "render shot.####.exr video.####.exr -o out.####.exr --focus-m 2"
    warning = told(command)[1]
    assert warning.count("taken for metres, as in every sequence without --depth-kind") == 1
    assert "--relative-kind disparity if larger is nearer" in warning and "--depth-kind z if they are" in warning
    assert "taken for metres" not in told(f"{command} --depth-kind z")[1]
    assert "but its numbers grow downwards" in told("render image.exr video.0001.exr -o out.exr")[1]


def test_blur_sets_the_largest_radius_as_a_share_of_the_width(depth: Tensor, run: Run) -> None:
    for focus in ("--focus-m 2", "--focus-m 5", "--focus-at 21,5"):
        for lens in ("", " --focal-length-mm 85", " --fov-deg 40"):
            line = run(f"render image.exr depth.npy -o out.exr {focus}{lens} --blur 10%")
            assert "blur radius up to 2.4 px" in line and "f-number" not in line
    f_number = json.loads(run(f"{ONE} --blur 10% --json"))["camera"]["f_number"]
    assert float(torchdof.Camera(50.0, f_number, 2.0).coc_px(depth, 24).max()) == pytest.approx(2.4, rel=0.01)
    run(f"{ONE} --blur 40% --strict")  # a large blur that is stated is no mistake


@pytest.mark.parametrize(("size", "sensor_mm"), [((16, 24), 36.0), ((24, 16), 24.0)])
def test_an_equivalent_lens_is_for_full_frame_either_way_up(run: Run, size: tuple[int, int], sensor_mm: float) -> None:
    image, depth = torch.rand(1, 3, *size), torch.full((1, 1, *size), 6.0)
    depth[..., : size[0] // 2, :] = 1.5
    write_image("phone.exr", with_tags(image, "float", FocalLength=5.7, FNumber=1.8, FocalLengthIn35mmFilm=26.0))
    np.save("metres.npy", depth.numpy())
    camera = torchdof.Camera(85.0, 1.4, 1.5, sensor_mm)
    for said in ("85mm,1.4", "85,f1.4", "'85mm f/1.4'"):
        line = run(f"render phone.exr metres.npy -o out.exr --bits float --focus-m 1.5 --equivalent {said}")
        assert f": {rounded(inside(camera))}; " in line and "[" not in line
    expected = torchdof.depth_of_field(image, depth, camera)
    torch.testing.assert_close(pixels("out.exr"), expected, rtol=0, atol=1e-6)
    line = run("render phone.exr metres.npy -o out.exr --depth-kind relative --relative-kind depth --equivalent 85,1.4")
    assert "f/1.4, focus 1 m" in line and "from 1 to 8 m assumed" in line


def test_lens_and_points_are_those_of_the_display_window(image: Tensor, depth: Tensor, run: Run) -> None:
    """The file holds half the width of the frame, from 4 px left of it; the surface at 6 m starts at 8 px."""
    write_image("part.exr", Picture(image, sample="float", window=(-4, 3, 0, 0, 48, 40)))
    run(f"render part.exr depth.npy -o out.exr --focus-at 10,11 --attention 14,11,4 {LENS}")
    camera = CAMERA.replace(focus_m=6.0, sensor_width_mm=2.0)
    expected = torchdof.depth_of_field(image, depth, camera, attention=(18.0, 8.0, 4.0))
    torch.testing.assert_close(pixels("out.exr"), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("left", "top"), [(9, 3), (0, 17), (24, 20), (12, 12)])
def test_a_part_of_the_frame_has_the_blur_that_it_has_in_the_whole(left: int, top: int) -> None:
    """A tilted lens and lengths of rays have their centre in the middle of the display window."""
    rays = 2 + torch.rand(1, 1, 40, 48, generator=torch.Generator().manual_seed(4))
    rows, columns = slice(top, top + 16), slice(left, left + 24)
    found = []
    for area in ((slice(0, 40), slice(0, 48)), (rows, columns)):
        light = torch.ones(1, 3, 40, 48)[(..., *area)]
        place = (area[1].start - 7, area[0].start + 4, -7, 4, 48, 40)
        write_image("part.exr", Picture(light, sample="float", window=place))
        np.save("part.npy", rays[(0, 0, *area)].numpy())
        lens: dict[str, Any] = {"focal_length_mm": 30.0, "sensor_width_mm": 36.0, "f_number": 1.0}
        lens |= {"tilt": 0.4, "swing": -0.3, "focus_at": ((left + 8, top + 9),)}
        scene = Scene(**lens, depth_kind="distance")
        frame = read_frame(Path("part.exr"), Path("part.npy"), scene)
        found.append((frame.values, *coc_of(frame, Notices())[:2]))
    (whole_m, whole_px, camera), (part_m, part_px, part_camera) = found
    torch.testing.assert_close(part_m, whole_m[..., rows, columns])
    torch.testing.assert_close(part_px, whole_px[..., rows, columns], rtol=1e-4, atol=1e-5)
    assert camera is not None and part_camera is not None
    assert part_camera.focus_m == pytest.approx(camera.focus_m)


def test_a_note_advises_to_increase_a_hardly_visible_blur(run: Run) -> None:
    for options in (f"{ONE} --f-number 8", f"{ONE} --blur 2%", ONE, f"{SEQUENCE} --focus-m 2 --f-number 8"):
        note = told(options)[1]
        assert note.startswith("note: out.") and "px, which is hardly seen; open the lens wider" in note
        assert note.count("\n") == 1
    np.save("flat.npy", np.full((16, 24), 3.0))
    line, note = told("render image.exr flat.npy -o out.exr")
    assert "nothing is blurred, for all depth is in focus" in note and "f/2.8, assumed" in line
    assert told(f"{ONE} {LENS}")[1] == ""


# More than one picture of a still


def test_a_sheet_shows_before_depth_and_after(image: Tensor, depth: Tensor, run: Run) -> None:
    large = {"mode": "bilinear", "size": (160, 240)}
    image = torch.nn.functional.interpolate(image, **large)  # type: ignore[arg-type]
    write_image("photo.png", Picture(image, sample="8", transfer="srgb"))
    np.save("metres.npy", torch.nn.functional.interpolate(depth, (160, 240)).numpy())
    line = run("render photo.png metres.npy -o out.png --focus-m 2 --blur 2% --sheet look/sheet.png")
    assert "sheet look/sheet.png" in line
    sheet = pixels("look/sheet.png")
    assert sheet.shape[-1] == 3 * 240 + 4 * 8
    before, middle, after = (sheet[..., 34:194, 8 + k * 248 : 248 + k * 248] for k in range(3))
    torch.testing.assert_close(before, pixels("photo.png"), rtol=0, atol=0.01)
    torch.testing.assert_close(after, pixels("out.png"), rtol=0, atol=0.01)
    assert float(middle[..., :118].min()) > 0.99 and float(middle[..., 122:].max()) < 0.01
    coc_px = np.tile(np.repeat([-4.0, 4.0], 120), (160, 1))
    np.save("coc.npy", coc_px)
    run("render photo.png coc.npy -o out.png --depth-kind coc --sheet sheet.png")
    colours = pixels("sheet.png")[0, :, 100, 256:496]
    assert colours[:, :120].argmax(0).eq(0).all() and colours[:, 120:].argmax(0).eq(2).all()


def test_a_focus_pull_of_a_still_writes_frames_with_one_aperture(image: Tensor, depth: Tensor, run: Run) -> None:
    line = f"render image.exr depth.npy -o pull.##.exr --focus-m 2:2,4:6 {LENS}"
    assert numbers_in(run(line), r"pull.0(\d).exr: .*focus ") == [2, 3, 4]
    for n, focus_m in ((2, 2.0), (3, 3.0), (4, 6.0)):
        expected = torchdof.depth_of_field(image, depth, CAMERA.replace(focus_m=focus_m))
        torch.testing.assert_close(pixels(f"pull.{n:02d}.exr"), expected, rtol=0, atol=1e-5)
    Path("pull.03.exr").unlink()
    assert run(f"{line} --resume").splitlines()[0] == "2 of 3 frames are there already"
    assert len(run(f"{line} --frames 3-4").splitlines()) == 2
    lines = run("render image.exr depth.npy -o pull.##.exr --focus-m 1:2,3:6 --blur 10%")
    assert len(set(numbers_in(lines, r"f/([\d.]+)"))) == 1
    radii = numbers_in(lines, r"up to ([\d.]+) px")
    assert max(radii) == 2.4 and radii[1] < 2.4
    assert told("render image.exr depth.npy -o pull.##.exr --focus-m 1:2,3:6 --f-number 9")[1].count("note:") == 1
    wide = "render image.exr depth.npy -o pull.##.exr --focus-m 1:2,3:6 --blur 15%"  # between the two depths at frame 2
    assert "nothing is in focus" not in told(wide)[1]
    assert "nothing is in focus" in told(wide.replace("1:2,3:6", "1:20,3:60"))[1]


def test_a_stray_pixel_does_not_reduce_the_blur_of_the_others(image: Tensor, depth: Tensor, run: Run) -> None:
    large = torch.nn.functional.interpolate(depth, (80, 120))
    write_image("large.exr", Picture(torch.nn.functional.interpolate(image, (80, 120)), sample="float"))
    openings = list[float]()
    for stray_m in (2.0, 0.1):
        large[..., 40, 90] = stray_m
        np.save("large.npy", large.numpy())
        line = run("render large.exr large.npy -o out.exr --focus-m 2 --blur 4% --depth-edges as-given")
        openings += numbers_in(line, r"f/([\d.]+)")
    assert openings[0] == openings[1]


def test_a_depth_map_with_one_value_is_named_as_such(depth: Tensor) -> None:
    np.save("flat.npy", np.full(depth.shape[-2:], 128.0))
    note = "note: flat.npy: has one value everywhere, 128, so nothing is nearer"
    assert note in told("render image.exr flat.npy -o out.png")[1]


def test_an_exr_without_depth_lists_its_channels(run: Run) -> None:
    store(
        Path("x.exr"), np.ones((4, 6, 4), np.float32) * np.arange(4, dtype=np.float32), "float", ("R", "G", "B", "N.X")
    )
    error = run("render x.exr -o y.exr --focus-m 2 --fov-deg 40 --blur 2%", code=2)
    assert "which of the channels R, G, B, N.X is depth? name it (--depth-channel)" in error


def test_a_file_with_a_map_for_each_image_is_read_map_by_map(run: Run, depth: Tensor) -> None:
    stack = torch.cat([depth, depth * 2, depth * 3])[:, 0].numpy()
    np.savez("all.npz", depth=stack, conf=stack)
    options = "--focus-m 2 --fov-deg 40 --aperture-radius-m 0.1"
    run(f"render shot.####.exr all.npz -o out.####.exr --frames 2-3 {options}")
    for number in (2, 3):
        np.save("one.npy", stack[number - 1])
        run(f"render shot.{number:04d}.exr one.npy -o one.exr --depth-kind z {options}")
        assert torch.equal(pixels(f"out.{number:04d}.exr"), pixels("one.exr"))
    np.save("two.npy", stack[:2])
    error = run(f"render shot.####.exr two.npy -o out.####.exr {options}", code=2)
    assert "holds 2 maps (an array [2, 16, 24]); the sequence has 3 images" in error


def test_the_camera_of_an_estimator_is_used_unless_options_or_exif_state_it(image: Tensor, depth: Tensor) -> None:
    np.savez("pro.npz", depth=depth[0, 0].numpy(), focallength_px=12.0)  # 90 degrees
    out, _ = told("render image.exr pro.npz -o out.png --focus-m 2")
    assert "18 mm," in out and "sensor 36 mm" in out and "18 mm, from the depth file" in out
    out, _ = told("render image.exr pro.npz -o out.png --focus-m 2 --focal-length-mm 36")
    assert "36 mm," in out and "sensor 72 mm" in out
    write_image("image.exr", with_tags(image, FocalLength=50.0, FocalLengthIn35mmFilm=50.0))
    out, _ = told("render image.exr pro.npz -o out.png --focus-m 2")
    assert "50 mm," in out and "sensor 36 mm" in out and "from the depth file" not in out


def test_the_scale_of_depth_anything_3_is_offered(image: Tensor, depth: Tensor) -> None:
    matrix = np.diag([60.0, 60.0, 1.0])
    np.savez("three.npz", depth=depth[0].numpy(), conf=depth[0].numpy(), intrinsics=matrix[None])
    assert (
        "of the metric model of Depth Anything 3: --depth-scale 0.2" in told("render image.exr three.npz -o o.png")[1]
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("50 mm, f/1.26491, focus 1.20681 m", "50 mm, f/1.3, focus 1.21 m"),
        ("f/1.02344, focus 2.2987 m", "f/1.0, focus 2.3 m"),
        ("f/2.0, f/0.172291, f/16.4", "f/2, f/0.17, f/16"),
        ("focus 12345.6 m, 0.00123456 m, inf m, 3 layers", "focus 12346 m, 0.00123 m, inf m, 3 layers"),
    ],
)
def test_numbers_are_printed_as_a_person_writes_them(text: str, expected: str) -> None:
    assert rounded(text) == expected


def test_numbers_are_read_as_a_person_writes_them(run: Run) -> None:
    options = "--focal-length-mm 50 --sensor-width-mm 4"
    run(f"render image.exr depth.npy -o a.exr {options} --focus-m 2.3 --f-number 1.2")
    run(f"render image.exr depth.npy -o b.exr {options} --focus-m '2.3 m' --f-number f/1.2")
    assert torch.equal(pixels("a.exr"), pixels("b.exr"))
    run("render image.exr depth.npy -o a.exr --blur 5%")
    run("render image.exr depth.npy -o b.exr --blur 5")
    assert torch.equal(pixels("a.exr"), pixels("b.exr"))


def test_a_strict_sequence_refuses_numbers_that_look_relative_unless_they_are_stated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    monkeypatch.chdir(tmp_path)
    for n in (1, 2):
        write_image(f"s.{n}.exr", Picture(torch.rand(1, 3, 32, 48)))
        write_image(f"d.{n}.exr", Picture((torch.rand(1, 1, 32, 48) * 20 + 0.5).sort(2).values, ("Y",)))
    line = "render s.#.exr d.#.exr -o o.#.exr --focus-m 5 --strict"
    assert "its numbers grow downwards" in run(line, code=2)
    assert "o.2.exr" in run(f"{line} --depth-kind z")
