"""Shards of a data set: what is in them, what is left out, and that they do not depend on who makes them when."""

import io
import json
import tarfile
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


def made(out: Path, rows: list[dict[str, Any]], **changes: Any) -> dict[str, np.ndarray]:
    out.mkdir(exist_ok=True)
    return RenderShards(out, RandomDepthOfField(**BLUR), **changes)(batch(rows))


def members(path: Path) -> dict[str, bytes]:
    with tarfile.open(path) as tar:
        return {member.name: tar.extractfile(member).read() for member in tar}  # type: ignore[union-attr]


def picture(data: bytes, tmp_path: Path, suffix: str = ".png") -> Tensor:
    (tmp_path / f"read{suffix}").write_bytes(data)
    return read_image(tmp_path / f"read{suffix}").pixels


def test_a_shard_holds_each_sample_with_its_parameters(pairs: list[Pair], tmp_path: Path) -> None:
    told = made(tmp_path / "out", shard_rows(pairs, per_shard=5), picture=".exr")
    files = members(tmp_path / "out" / "shard-000000.tar")
    assert [*files][:4] == [f"00000000.{name}" for name in ("blurred.exr", "sharp.exr", "depth.npy", "json")]
    assert len(files) == 4 * 5 and told["error"].tolist() == [""] * 5
    for k, pair in enumerate(pairs):
        key = f"{k:08d}"
        facts = json.loads(files[f"{key}.json"])
        depth = torch.from_numpy(np.load(io.BytesIO(files[f"{key}.depth.npy"])))
        assert facts["image"] == pair.image and torch.equal(depth, torch.from_numpy(np.load(str(pair.depth))).float())
        camera = Camera(facts["focal_length_mm"], facts["f_number"], facts["focus_m"], facts["sensor_width_mm"])
        sharp = read_image(pair.image).pixels
        right = depth_of_field(sharp, depth[None, None], camera, tolerance=facts["tolerance"], check=False)
        torch.testing.assert_close(
            picture(files[f"{key}.blurred.exr"], tmp_path, ".exr"), right.half().float(), rtol=2e-3, atol=1e-6
        )
    assert len({json.loads(files[f"{k:08d}.json"])["focus_m"] for k in range(5)}) == 5


def test_what_is_in_a_shard_depends_on_its_row_and_the_seed_alone(pairs: list[Pair], tmp_path: Path) -> None:
    rows = shard_rows(pairs, per_shard=2, copies=2)
    assert len(rows) == 5
    made(tmp_path / "forwards", rows)
    torch.manual_seed(99)
    made(tmp_path / "backwards", rows[::-1])
    made(tmp_path / "other", rows, seed=1)
    for row in rows:
        name = f"shard-{row['shard']:06d}.tar"
        whole = (tmp_path / "forwards" / name).read_bytes()
        assert whole == (tmp_path / "backwards" / name).read_bytes()
        assert whole != (tmp_path / "other" / name).read_bytes()


def test_a_shard_that_is_there_is_not_made_again(pairs: list[Pair], tmp_path: Path) -> None:
    rows = shard_rows(pairs, per_shard=3)
    first = made(tmp_path / "out", rows)
    times = [path.stat().st_mtime_ns for path in sorted((tmp_path / "out").iterdir())]
    again = made(tmp_path / "out", rows)
    assert [path.stat().st_mtime_ns for path in sorted((tmp_path / "out").iterdir())] == times
    assert again["key"].tolist() == first["key"].tolist() and again["shard"].tolist() == [0, 0, 0, 1, 1]


def test_broken_inputs_are_left_out_and_listed(pairs: list[Pair], tmp_path: Path) -> None:
    Path(pairs[1].image).write_bytes(b"no picture")
    np.save(str(pairs[3].depth), np.zeros((12, 16)))
    told = made(tmp_path / "out", shard_rows(pairs, per_shard=5), depth={"unknown": 0.0})
    assert ["cannot be read" in told["error"][1], bool(told["error"][3])] == [True, True]
    names = {name.split(".")[0] for name in members(tmp_path / "out" / "shard-000000.tar")}
    assert names == {"00000000", "00000002", "00000004"}
    summary = summary_of(tmp_path / "out")
    assert (summary.samples, summary.shards) == (3, 1) and summary.seconds > 0
    assert [image for image, _ in summary.broken] == [pairs[1].image, pairs[3].image]


def test_a_shard_is_written_whole_or_not_at_all(
    pairs: list[Pair], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(path: Path, records: Any) -> None:
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(torchdof.distributed.shards, "_write_tar", stopped)
    with pytest.raises(KeyboardInterrupt):
        made(tmp_path / "out", shard_rows(pairs))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["shard-000000.json"]
    assert summary_of(tmp_path / "out").shards == 0
    monkeypatch.undo()
    assert made(tmp_path / "out", shard_rows(pairs))["error"].tolist() == [""] * 5
    assert summary_of(tmp_path / "out").shards == 1


def test_cameras_may_be_given(pairs: list[Pair], tmp_path: Path) -> None:
    given = [Pair(pairs[0].image, pairs[0].depth, focus_m=1.25, f_number=2.0), Pair(pairs[1].image, pairs[1].depth)]
    made(tmp_path / "out", shard_rows(given), keep=["blurred"])
    files = members(tmp_path / "out" / "shard-000000.tar")
    first, second = (json.loads(files[f"0000000{k}.json"]) for k in range(2))
    assert (first["focus_m"], first["f_number"]) == (1.25, 2.0) and second["focus_m"] != 1.25
    assert [*files][:2] == ["00000000.blurred.png", "00000000.json"]


def test_depth_without_a_scale_lies_between_two_distances(pairs: list[Pair], tmp_path: Path) -> None:
    made(tmp_path / "out", shard_rows(pairs), depth={"kind": "relative", "near_m": 1.0, "far_m": 8.0})
    depth = np.load(io.BytesIO(members(tmp_path / "out" / "shard-000000.tar")["00000000.depth.npy"]))
    values = torch.from_numpy(np.load(str(pairs[0].depth)))[None, None].float()
    np.testing.assert_allclose(depth, from_relative(values, 1.0, 8.0)[0, 0].numpy(), rtol=1e-5)


def test_a_lens_is_drawn_and_named(pairs: list[Pair], tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    blur = RandomDepthOfField(**{**BLUR, "table": [BlurTable.disc(), BlurTable.gaussian()]})
    RenderShards(tmp_path / "out", blur)(batch(shard_rows(pairs, copies=3)))
    files = members(tmp_path / "out" / "shard-000000.tar")
    assert {json.loads(data)["table"] for name, data in files.items() if name.endswith("json")} == {"disc", "gaussian"}


def test_parquet_holds_the_same(pairs: list[Pair], tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    rows = shard_rows(pairs)
    made(tmp_path / "tar", rows)
    made(tmp_path / "parquet", rows, format="parquet")
    table = parquet.read_table(tmp_path / "parquet" / "shard-000000.parquet").to_pylist()
    files = members(tmp_path / "tar" / "shard-000000.tar")
    for row in table:
        assert row["blurred.png"] == files[f"{row['key']}.blurred.png"]
        assert row["focus_m"] == json.loads(files[f"{row['key']}.json"])["focus_m"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # it leaves its files to be closed
def test_webdataset_reads_the_shards(pairs: list[Pair], tmp_path: Path) -> None:
    webdataset = pytest.importorskip("webdataset", reason="webdataset is not installed")
    made(tmp_path / "out", shard_rows(pairs, per_shard=5))
    read = list(
        webdataset.WebDataset(str(tmp_path / "out" / "shard-000000.tar"), shardshuffle=False).decode("torchrgb")
    )
    assert [sample["__key__"] for sample in read] == [f"{k:08d}" for k in range(5)]
    assert read[0]["blurred.png"].shape == (3, 12, 16) and read[0]["depth.npy"].shape == (12, 16)
    assert read[0]["json"]["f_number"] > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"format": "zip"}, "format must be 'webdataset' or 'parquet'"),
        ({"keep": []}, "keep must be some of blurred, sharp, depth"),
        ({"keep": "blurred"}, "keep must be some of"),
        ({"picture": ".jpg"}, "picture must be"),
        ({"blur": "disc"}, "blur must be a RandomDepthOfField"),
        ({"depth": {"scal": 2.0}}, "depth must be some of kind, scale, offset, .* got scal"),
        ({"depth": {"kind": "relative"}}, "depth must be some of kind, near_m, .*, with near_m and far_m, got kind"),
        ({"seed": -1}, "seed must be a whole number"),
        ({"threads": 0}, "threads must be a whole number"),
    ],
)
def test_wrong_arguments_are_refused_by_name(arguments: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        RenderShards(tmp_path, **arguments)


def test_a_folder_must_be_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no such folder; make it first"):
        RenderShards(tmp_path / "none")


def test_pairs_are_found_by_their_names(pairs: list[Pair], tmp_path: Path) -> None:
    assert [Path(pair.image).stem for pair in pairs] == [Path(str(pair.depth)).stem for pair in pairs] == [*"01234"]
    assert pairs_in(tmp_path / "images")[0].depth is None
    (tmp_path / "depths" / "2.npy").rename(tmp_path / "depths" / "3.npz")
    with pytest.raises(ValueError, match=r"2.png: needs one depth map 2\.\* in .*, found none"):
        pairs_in(tmp_path / "images", tmp_path / "depths")
    (tmp_path / "images" / "2.png").unlink()
    with pytest.raises(ValueError, match=r"3.png: .*found 3.npy and 3.npz"):
        pairs_in(tmp_path / "images", tmp_path / "depths")
    with pytest.raises(FileNotFoundError, match="no images here"):
        pairs_in(tmp_path)
    with pytest.raises(ValueError, match="focus_m must be a number"):
        Pair("a.png", focus_m=-1.0)
    with pytest.raises(ValueError, match="pairs must be at least one"):
        shard_rows([])
