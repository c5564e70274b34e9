import csv
import math
import shutil
from pathlib import Path

import pytest
import torch
import typer
from torch import Tensor
from typer.testing import CliRunner, Result

from examples.benchmarks import peers
from examples.benchmarks.peers import CaseTiming, Peer
from torchdof.bench.accuracy import layered_fft
from torchdof.optics.camera import Camera
from torchdof.reference import metrics
from torchdof.reference.scenes import Scene

ROOT = Path(__file__).parents[2]
SHIPPED = ROOT / "examples" / "benchmarks" / "tools"
DATA = ROOT / "tests" / "data" / "scenes"

TOY = """
NAME = "toy"
NOTE = "a note"
def available(): return None
def version(): return "7"
def blur(image, coc_px):
    from torchdof.bench.accuracy import layered_fft
    return layered_fft(image, coc_px), 1000.0
"""

app = typer.Typer()
app.command()(peers.main)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [*map(str, arguments)], env={"COLUMNS": "200"})


def write(folder: Path, **files: str) -> Path:
    folder.mkdir()
    for name, text in files.items():
        (folder / f"{name}.py").write_text(text)
    return folder


@pytest.mark.parametrize("peer", peers.ours(), ids=lambda peer: peer.name)
def test_ours_pass_the_check_of_peers(peer: Peer) -> None:
    assert peers.check(peer) is None


@pytest.mark.parametrize("name", ["blender", "ffmpeg", "gegl", "ikoma", "kornia_bins"])
def test_a_shipped_peer_blurs_by_the_circle_of_confusion_that_it_is_given(name: str, tmp_path: Path) -> None:
    for path in SHIPPED.glob(f"*{name}*.py"):
        shutil.copy(path, tmp_path)
    (peer,) = (p for p in peers.read_peers(tmp_path))
    if peer.missing is not None:
        pytest.skip(f"{peer.name} is not installed: {peer.missing}")
    assert peers.check(peer, radius_px=6.0) is None
    assert peers.check(peer, radius_px=11.3) is None
    assert peer.note and peer.version


@pytest.mark.parametrize(
    "blur, wrong",
    [
        (lambda image, coc: image, "a dot at 6 px is blurred as by a disc of 0.00 px"),
        (lambda image, coc: layered_fft(image, 1.3 * coc), "a dot at 6 px is blurred as by a disc of 7.78"),
        (lambda image, coc: layered_fft(image, coc.clamp_min(0)), "a dot at -6 px is blurred as by a disc of 0.00 px"),
        (
            lambda image, coc: layered_fft(image, torch.full_like(coc, 6)),
            "a dot at 0 px is blurred as by a disc of 5.98",
        ),
        (lambda image, coc: 0.9 * layered_fft(image, coc), "a dot at 0 px keeps 0.9"),
        (lambda image, coc: layered_fft(image, coc).roll(1, -1), "a dot at 0 px moves by 1.00, 0.00 px"),
        (lambda image, coc: layered_fft(image, coc).roll(-1, -2), "a dot at 0 px moves by 0.00, -1.00 px"),
        (lambda image, coc: layered_fft(image, coc)[..., 1:], r"returned \[1, 3, 65, 194\]"),
        (lambda image, coc: image * math.nan, "not finite"),
    ],
)
def test_a_peer_that_does_something_else_fails_its_check(blur: object, wrong: str) -> None:
    assert peers.check(Peer("peer", layered_fft)) is None
    with pytest.raises(AssertionError, match=wrong):
        assert not (found := peers.check(Peer("peer", blur))), found  # type: ignore[arg-type]


def test_times_are_medians_and_errors_are_display_encoded() -> None:
    taken = iter([9.0, 9.0, 3.0, 1.0, 2.0, 20.0, 30.0, 10.0])
    truth = torch.rand(1, 3, 20, 30)
    camera = Camera(50.0, 2.0, focus_m=2.0)
    scene = Scene("flat/0", truth, torch.ones(1, 1, 20, 30), camera, truth)
    seen = []

    def blur(image: Tensor, coc_px: Tensor, error: float) -> tuple[Tensor, float]:
        seen.append((error, coc_px))
        return image * error, next(taken)

    both = [Peer(str(e), lambda image, coc, e=e: blur(image, coc, e)) for e in (1.0, 0.5)]  # type: ignore[misc]
    rows = peers.measure_case(scene, both, repeat=3)
    assert [error for error, _ in seen] == 4 * [1.0, 0.5]  # in turns
    assert all(torch.equal(coc, scene.coc_px) for _, coc in seen)
    wanted = metrics.psnr(metrics.display(0.5 * truth), metrics.display(truth))
    assert rows == [CaseTiming("flat/0", "1.0", 3.0, 14.0, math.inf), CaseTiming("flat/0", "0.5", 10.0, 9.5, wanted)]


def test_ratios_are_of_the_same_case() -> None:
    rows = [CaseTiming("a", "x", 1.0, 0.0, 30.0), CaseTiming("b", "y", 6.0, 0.0, 20.0)]
    rows += [CaseTiming("a", "y", 4.0, 0.0, 33.0), CaseTiming("b", "x", 3.0, 0.0, 25.0)]
    assert peers.ratios(rows, "y", "x") == ([4.0, 2.0], [-3.0, 5.0])


def test_peers_are_measured_beside_torchdof(tmp_path: Path) -> None:
    shutil.copytree(DATA / "room", tmp_path / "scenes" / "room")
    absent = "def available(): return 'apt install absent'\ndef blur(image, coc_px): return image\n"
    folder = write(
        tmp_path / "peers",
        toy=TOY,
        absent=absent,
        lazy=absent.replace("'apt install absent'", "None"),
        needs="import a_package_that_is_not_there\n",
        _helper="raise RuntimeError('left alone')\n",
    )
    (tmp_path / "out").mkdir()
    result = run(tmp_path / "scenes", "--peers-folder", folder, "--repeat", 1, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["peers.csv", "peers.md"]
    with (tmp_path / "out" / "peers.csv").open() as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["ours 8/255", "ours 4/255", "ours 1/255", "toy"]
    assert float(rows["toy"]["median_s"]) == 1000.0
    gain = float(rows["ours 1/255"]["psnr_db"]) - float(rows["toy"]["psnr_db"])
    ratio = 1000.0 / float(rows["ours 1/255"]["median_s"])
    text = (tmp_path / "out" / "peers.md").read_text()
    (line,) = (line for line in text.splitlines() if line.startswith("| toy |"))
    name, times, gains, faster, nearer = line.strip("| ").split(" | ")
    assert float(times.split()[0]) == pytest.approx(ratio, rel=0.01)
    assert float(gains.split()[0]) == pytest.approx(gain, abs=0.01)
    assert (faster, nearer) == ("1 of 1", f"{int(gain > 0)} of 1")
    assert f"threads for each renderer: {torch.get_num_threads()};" in text and "after one more: 1." in text
    for said in (
        "toy (7): a note",
        "absent: not installed: apt install absent",
        "needs: not installed: pip install a_package_that_is_not_there",
        "lazy: left out, as it fails its check: a dot at 6 px is blurred as by a disc of 0.00 px",
    ):
        assert f"- {said}" in text
        assert said in result.output


def test_a_folder_without_peers_is_refused(tmp_path: Path) -> None:
    result = run(DATA, "--peers-folder", tmp_path)
    assert result.exit_code == 2
    assert "there are no peers here; a peer is a Python file" in result.output


def test_it_refuses_a_file_that_is_no_peer(tmp_path: Path) -> None:
    result = run(DATA, "--peers-folder", write(tmp_path / "peers", empty="x = 1\n"))
    assert result.exit_code == 2
    assert "empty.py: a peer defines available() and blur(image, coc_px)" in result.output
