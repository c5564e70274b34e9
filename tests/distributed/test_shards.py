"""Shards of a data set: their contents, omitted inputs, and independence of the worker and of the time."""

import io
import json
import os
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchdof.distributed.shards
from torchdof import BlurTable, Camera, depth_of_field
from torchdof.augmentation import RandomDepthOfField
from torchdof.depth import from_relative
from torchdof.distributed import Pair, RenderShards, pairs_in, shard_rows, summary_of
from torchdof.io.images import Picture, read_image, write_image

BLUR: dict[str, Any] = {"camera": Camera(sensor_width_mm=4.0), "tolerance": "preview", "p": 0.0}


@pytest.fixture
def pairs(tmp_path: Path) -> list[Pair]:
    (tmp_path / "images").mkdir()
    (tmp_path / "depths").mkdir()
    for k in range(5):
        write_image(tmp_path / "images" / f"{k}.png", Picture(torch.rand(1, 3, 12, 16)))
        np.save(tmp_path / "depths" / f"{k}.npy", np.random.default_rng(k).uniform(0.6, 4, (12, 16)))
    return pairs_in(tmp_path / "images", tmp_path / "depths")


def batch(rows: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def make_shards(out: Path, rows: list[dict[str, Any]], **changes: Any) -> dict[str, np.ndarray]:
    out.mkdir(exist_ok=True)
    return RenderShards(out, RandomDepthOfField(**BLUR), **changes)(batch(rows))


def members(path: Path) -> dict[str, bytes]:
    with tarfile.open(path) as tar:
        return {member.name: tar.extractfile(member).read() for member in tar}  # type: ignore[union-attr]


def test_a_shard_has_each_sample_with_its_parameters(pairs: list[Pair], tmp_path: Path) -> None:
    report = make_shards(tmp_path / "out", shard_rows(pairs, per_shard=5), picture=".exr")
    files = members(tmp_path / "out" / "shard-000000.tar")
    assert {*files} == {
        f"{k:08d}.{name}" for k in range(5) for name in ("blurred.exr", "sharp.exr", "depth.npy", "json")
    }
    assert report["error"].tolist() == [""] * 5
    for k, pair in enumerate(pairs):
        key = f"{k:08d}"
        facts = json.loads(files[f"{key}.json"])
        depth = torch.from_numpy(np.load(io.BytesIO(files[f"{key}.depth.npy"])))
        assert facts["image"] == pair.image and torch.equal(depth, torch.from_numpy(np.load(str(pair.depth))).float())
        camera = Camera(facts["focal_length_mm"], facts["f_number"], facts["focus_m"], facts["sensor_width_mm"])
        sharp = read_image(pair.image).pixels
        expected = depth_of_field(sharp, depth[None, None], camera, tolerance=facts["tolerance"], check=False)
        (tmp_path / "blurred.exr").write_bytes(files[f"{key}.blurred.exr"])
        blurred = read_image(tmp_path / "blurred.exr").pixels
        torch.testing.assert_close(blurred, expected.half().float(), rtol=2e-3, atol=1e-6)
    assert len({json.loads(files[f"{k:08d}.json"])["focus_m"] for k in range(5)}) == 5


def test_a_shard_depends_only_on_its_row_and_the_seed(pairs: list[Pair], tmp_path: Path) -> None:
    rows = shard_rows(pairs, per_shard=2, copies=5)
    assert len(rows) == 13
    make_shards(tmp_path / "alone", rows)
    make_shards(tmp_path / "other", rows, seed=1)
    torch.manual_seed(99)
    before = torch.get_rng_state()
    make_shards(tmp_path / "again", rows[::-1])
    assert torch.equal(torch.get_rng_state(), before)
    for path in (tmp_path / "alone").glob("*.tar"):
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()
    drawn = (members(tmp_path / name / "shard-000000.tar")["00000000.json"] for name in ("alone", "other"))
    assert len({json.loads(facts)["focus_m"] for facts in drawn}) == 2


def test_broken_inputs_are_omitted_and_listed(
    pairs: list[Pair], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path(pairs[1].image).write_bytes(b"no picture")
    np.save(str(pairs[3].depth), np.zeros((12, 16)))

    def allocate(image: Tensor, *arguments: Any, **options: Any) -> Tensor:
        if torch.equal(image, read_image(pairs[4].image).pixels):
            torch.empty(2**50)  # torch's allocator raises RuntimeError
        if torch.equal(image, read_image(pairs[2].image).pixels):
            raise MemoryError  # numpy and the compiled engine raise this
        return depth_of_field(image, *arguments, **options)

    monkeypatch.setattr(torchdof.distributed.shards, "depth_of_field", allocate)
    report = make_shards(tmp_path / "out", shard_rows(pairs, per_shard=5), depth={"unknown": 0.0})
    for k, error in {1: "cannot be read", 2: "MemoryError", 3: "no pixel has a depth", 4: "allocate"}.items():
        assert error in report["error"][k]
    names = {name.split(".")[0] for name in members(tmp_path / "out" / "shard-000000.tar")}
    assert names == {"00000000"}
    summary = summary_of(tmp_path / "out")
    assert (summary.samples, summary.shards) == (1, 1) and summary.seconds > 0
    assert [image for image, _ in summary.broken] == [pairs[k].image for k in (1, 2, 3, 4)]


def test_names_that_are_not_utf_8_are_listed_with_escaped_bytes(pairs: list[Pair], tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    (tmp_path / "images").rename(folder)
    (folder / "1.png").write_bytes(b"no picture")
    report = make_shards(tmp_path / "out", shard_rows(pairs_in(folder, tmp_path / "depths")))
    assert report["image"][0] == f"{tmp_path}/caf\\xe9/0.png"
    assert [error == "" for error in report["error"]] == [True, False, True, True, True] and report["error"][1].encode()
    assert summary_of(tmp_path / "out").broken[0][0].endswith("caf\\xe9/1.png")


@pytest.mark.parametrize(
    ("damage", "suffix"),
    [
        (lambda path: path.write_bytes(b""), ".json"),
        (lambda path: path.write_text("[]"), ".json"),
        (lambda path: path.unlink(), ".json"),
        (lambda path: path.write_bytes(path.read_bytes()[:-600]), ".tar"),
        (lambda path: path.write_bytes(b""), ".tar"),
    ],
    ids=["empty notes", "other notes", "no notes", "cut", "empty"],
)
def test_a_damaged_shard_is_made_again_and_a_complete_one_is_not(
    damage: Callable[[Path], object], suffix: str, pairs: list[Pair], tmp_path: Path
) -> None:
    out, rows = tmp_path / "out", shard_rows(pairs, per_shard=3)
    first = make_shards(out, rows)
    whole, times = sorted(out.glob("*.tar"))[0], [path.stat().st_mtime_ns for path in sorted(out.iterdir())]
    before = whole.read_bytes()
    damage(whole.with_suffix(suffix))
    assert (summary_of(out).shards, summary_of(out).samples) == (1, 2)
    again = make_shards(out, rows)
    assert again["key"].tolist() == first["key"].tolist() and again["shard"].tolist() == [0, 0, 0, 1, 1]
    assert again["error"].tolist() == [""] * 5 and whole.read_bytes() == before and summary_of(out).samples == 5
    assert [path.stat().st_mtime_ns for path in sorted(out.iterdir())][2:] == times[2:]


def test_a_shard_is_made_again_if_its_settings_or_files_have_changed(pairs: list[Pair], tmp_path: Path) -> None:
    rows = shard_rows(pairs, per_shard=3)
    Path(pairs[4].image).unlink()

    def remade(**changes: Any) -> list[int]:
        before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("*.tar")}
        make_shards(tmp_path / "out", rows, **changes)
        after = {path.name: path.stat().st_mtime_ns for path in sorted((tmp_path / "out").glob("*.tar"))}
        return [k for k, name in enumerate(after) if after[name] != before.get(name)]

    assert (remade(), remade()) == ([0, 1], [])
    assert (remade(seed=1), remade(seed=1)) == ([0, 1], [])
    np.save(str(pairs[0].depth), np.full((12, 16), 2.0))
    assert (remade(seed=1), remade(seed=1)) == ([0], [])
    write_image(pairs[4].image, Picture(torch.rand(1, 3, 12, 16)))  # it was missing
    assert remade(seed=1) == [1] and summary_of(tmp_path / "out").broken == []
    rows = shard_rows(pairs[::-1], per_shard=3)
    assert (remade(seed=1), remade(seed=1)) == ([0, 1], [])


@pytest.mark.parametrize("suffix", [".tar", ".json"])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_shard_whose_process_ends_between_its_two_files_is_made_again(
    pairs: list[Pair], tmp_path: Path, suffix: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Shards of other settings often have the same size, because it is a multiple of 10 kB."""

    def stopped(source: Any, target: Path) -> None:
        if target.suffix == suffix:
            raise SystemExit
        renamed(source, target)

    renamed, rows = os.replace, shard_rows(pairs[:1])
    make_shards(tmp_path / "out", rows)
    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(os, "replace", stopped)
        make_shards(tmp_path / "out", rows, seed=1)
    make_shards(tmp_path / "out", rows, seed=seed)
    make_shards(tmp_path / "new", rows, seed=seed)
    made, expected = (members(tmp_path / name / "shard-000000.tar") for name in ("out", "new"))
    assert made == expected and summary_of(tmp_path / "out").samples == 1


def test_cameras_may_be_given(pairs: list[Pair], tmp_path: Path) -> None:
    given = [Pair(pairs[0].image, pairs[0].depth, focus_m=1.25, f_number=2.0), Pair(pairs[1].image, pairs[1].depth)]
    make_shards(tmp_path / "out", shard_rows(given), keep=["blurred"])
    files = members(tmp_path / "out" / "shard-000000.tar")
    first, second = (json.loads(files[f"0000000{k}.json"]) for k in range(2))
    assert (first["focus_m"], first["f_number"]) == (1.25, 2.0) and second["focus_m"] != 1.25
    assert [*files][:2] == ["00000000.blurred.png", "00000000.json"]


def test_relative_depth_is_scaled_and_a_lens_is_chosen_at_random_and_named(pairs: list[Pair], tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    blur = RandomDepthOfField(**{**BLUR, "table": [BlurTable.disc(), BlurTable.gaussian()]})
    depth_options = {"kind": "relative", "near_m": 1.0, "far_m": 8.0}
    RenderShards(tmp_path / "out", blur, depth=depth_options)(batch(shard_rows(pairs, copies=3)))
    files = members(tmp_path / "out" / "shard-000000.tar")
    assert {json.loads(data)["table"] for name, data in files.items() if name.endswith("json")} == {"disc", "gaussian"}
    values = torch.from_numpy(np.load(str(pairs[0].depth)))[None, None].float()
    depth = np.load(io.BytesIO(files["00000000.depth.npy"]))
    np.testing.assert_allclose(depth, from_relative(values, 1.0, 8.0)[0, 0].numpy(), rtol=1e-5)


def test_parquet_has_the_same_data(pairs: list[Pair], tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    rows = shard_rows(pairs)
    make_shards(tmp_path / "tar", rows)
    make_shards(tmp_path / "parquet", rows, format="parquet")
    files = members(tmp_path / "tar" / "shard-000000.tar")
    for row in parquet.read_table(tmp_path / "parquet" / "shard-000000.parquet").to_pylist():
        key = row.pop("key")
        for name in ("blurred.png", "sharp.png", "depth.npy"):
            assert row.pop(name) == files[f"{key}.{name}"]
        assert row == json.loads(files[f"{key}.json"])


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # webdataset does not close its files
def test_webdataset_reads_the_shards(pairs: list[Pair], tmp_path: Path) -> None:
    webdataset = pytest.importorskip("webdataset", reason="webdataset is not installed")
    make_shards(tmp_path / "out", shard_rows(pairs, per_shard=5))
    shard = str(tmp_path / "out" / "shard-000000.tar")
    read = list(webdataset.WebDataset(shard, shardshuffle=False).decode("torchrgb"))
    assert [sample["__key__"] for sample in read] == [f"{k:08d}" for k in range(5)]
    assert read[0]["blurred.png"].shape == (3, 12, 16) and read[0]["depth.npy"].shape == (12, 16)
    assert read[0]["json"]["f_number"] > 0


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda f: RenderShards(f, format="zip"), ValueError, "format must be one of webdataset, parquet"),  # type: ignore[arg-type]
        (lambda f: RenderShards(f, keep=[]), ValueError, "keep must be some of blurred, sharp, depth"),
        (lambda f: RenderShards(f, keep="blurred"), ValueError, "keep must be some of"),
        (lambda f: RenderShards(f, picture=".jpg"), ValueError, "picture must be"),  # type: ignore[arg-type]
        (lambda f: RenderShards(f, "disc"), ValueError, "blur must be a RandomDepthOfField"),  # type: ignore[arg-type]
        (lambda f: RenderShards(f, depth={"scal": 2.0}), ValueError, "depth must be some of kind, scale, .*'scal'"),
        (
            lambda f: RenderShards(f, depth={"kind": "relative"}),
            ValueError,
            "needs near_m and far_m in metres, got",
        ),
        (lambda f: RenderShards(f, seed=-1), ValueError, "seed must be a whole number"),
        (lambda f: RenderShards(f, threads=0), ValueError, "threads must be a whole number"),
        (lambda f: RenderShards(f / "none"), FileNotFoundError, "there is no such folder; make it first"),
        (lambda f: summary_of(f / "none"), FileNotFoundError, "No such file or directory: '.*none'"),
        (lambda f: pairs_in(f), FileNotFoundError, "no images here"),
        (lambda f: Pair("a.png", focus_m=-1.0), ValueError, "focus_m must be a number"),
        (lambda f: shard_rows([]), ValueError, "pairs must be at least one"),
    ],
)
def test_errors_name_the_argument(
    call: Callable[[Path], object], error: type[Exception], message: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=message):
        call(tmp_path)


def test_a_missing_package_of_a_format_is_reported_before_rendering(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"parquet needs pyarrow; .*pip install '\.\[ray\]'"):
        RenderShards(tmp_path, format="parquet")


def test_pairs_are_found_by_their_names(pairs: list[Pair], tmp_path: Path) -> None:
    assert [Path(pair.image).stem for pair in pairs] == [Path(str(pair.depth)).stem for pair in pairs] == [*"01234"]
    assert pairs_in(tmp_path / "images")[0].depth is None
    (tmp_path / "depths" / "2.npy").unlink()
    with pytest.raises(ValueError, match=r"2.png: needs a depth map 2\.\* in .*, found none"):
        pairs_in(tmp_path / "images", tmp_path / "depths")
    (tmp_path / "depths" / "3.npz").touch()
    with pytest.raises(ValueError, match=r"3.npy: there is 3.npz of the same name; keep one of them"):
        pairs_in(tmp_path / "images", tmp_path / "depths")
    (tmp_path / "images" / "4.webp").touch()
    with pytest.raises(ValueError, match="4.png: there is 4.webp of the same name; keep one of them"):
        pairs_in(tmp_path / "images")


def test_a_mask_decides_the_coverage_in_a_shard(tmp_path: Path) -> None:
    random = torch.Generator().manual_seed(0)
    write_image(tmp_path / "images" / "a.png", Picture(torch.rand(1, 3, 32, 48, generator=random)))
    depth, cover = np.full((32, 48), 6.0, np.float32), np.zeros((32, 48), np.float32)
    depth[:, :20], cover[:, :22], cover[:, 22] = 1.0, 1.0, 0.5
    for folder, values in (("depths", depth), ("masks", cover)):
        (tmp_path / folder).mkdir()
        np.save(tmp_path / folder / "a.npy", values)
    folders = [tmp_path / name for name in ("images", "depths", "masks")]
    [pair] = pairs_in(*folders)
    camera = Camera(focus_m=6.0, f_number=1.0, sensor_width_mm=4.0)
    blur = RandomDepthOfField((6.0, 6.0), (1.0, 1.0), camera, p=1.0)
    (tmp_path / "out").mkdir()
    RenderShards(tmp_path / "out", blur, picture=".exr")(batch(shard_rows([pair])))
    for name, content in members(tmp_path / "out" / "shard-000000.tar").items():
        (tmp_path / name).write_bytes(content)
    blurred, sharp = (read_image(tmp_path / f"00000000.{name}.exr").pixels for name in ("blurred", "sharp"))
    metres, matte = (torch.from_numpy(values)[None, None] for values in (depth, cover))
    expected = depth_of_field(sharp, metres, camera, matte=matte)
    torch.testing.assert_close(blurred, expected, rtol=2e-3, atol=2e-3)  # half precision
    assert float((expected - depth_of_field(sharp, metres, camera)).abs().max()) > 0.02
    (tmp_path / "masks" / "a.npy").unlink()
    with pytest.raises(ValueError, match=r"needs a mask a\.\* in .*masks, found none"):
        pairs_in(*folders)
