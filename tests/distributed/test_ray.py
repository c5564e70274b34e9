"""A data set on a local Ray cluster of two workers, killed and resumed."""

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from torchdof.distributed import RenderShards, make_dataset, pairs_in, shard_rows
from torchdof.io.images import Picture, write_image

ROOT = Path(__file__).parents[2]
_RAY = importlib.util.find_spec("ray")
HAS_RAY = _RAY is not None and _RAY.origin is not None  # a plain folder named "ray" has no origin
NEEDS_RAY = pytest.mark.skipif(not HAS_RAY, reason="Ray is not installed: pip install '.[ray]'")


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    for folder in ("images", "depths"):
        (tmp_path / folder).mkdir()
    for k in range(24):
        write_image(tmp_path / "images" / f"{k:02d}.png", Picture(torch.rand(1, 3, 60, 80)))
        np.save(tmp_path / "depths" / f"{k:02d}.npy", np.random.default_rng(k).uniform(0.6, 4, (60, 80)))
    (tmp_path / "images" / "05.png").write_bytes(b"no picture")
    return tmp_path


@NEEDS_RAY
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="two workers need two cores")
def test_a_killed_and_resumed_job_makes_the_same_shards(photos: Path) -> None:
    command = [sys.executable, str(ROOT / "examples" / "defocus_dataset.py"), "--workers", "2", "--per-shard", "2"]
    command += ["--images", str(photos / "images"), "--depths", str(photos / "depths"), "--out", str(photos / "out")]
    home = {**os.environ, "HOME": str(photos), "PYTHONPATH": str(ROOT), "RAY_DISABLE_IMPORT_WARNING": "1"}
    with (photos / "first.log").open("w") as log:
        first = subprocess.Popen(command, env=home, start_new_session=True, stdout=log, stderr=log)
    shards = photos / "out"
    wait_until = time.monotonic() + 180
    while len(list(shards.glob("shard-*.tar"))) < 2 and first.poll() is None and time.monotonic() < wait_until:
        time.sleep(0.02)
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    time.sleep(2)  # workers of the dead cluster may still finish a shard
    done = {path.name: path.stat().st_mtime_ns for path in shards.glob("shard-*.tar")}
    assert 2 <= len(done) < 12
    cut = sorted(done)[0]
    os.truncate(shards / cut, 1000)  # a damaged shard is made again
    del done[cut]
    output = subprocess.run(command, env=home, capture_output=True, text=True, timeout=240, check=True).stdout
    assert f"{len(done)} of 12 shards are there already" in output and len(list(shards.glob("shard-*.tar"))) == 12
    assert "left out: " in output and "05.png" in output and "images/s" in output
    assert all((shards / name).stat().st_mtime_ns == made for name, made in done.items())
    assert "23 samples in 12 shards; 1 inputs left out" in output
    assert (shards / "broken.txt").read_text().count("05.png") >= 1

    (photos / "alone").mkdir()
    alone = RenderShards(photos / "alone")
    for row in shard_rows(pairs_in(photos / "images", photos / "depths"), per_shard=2):
        alone({name: np.array([value]) for name, value in row.items()})
    for path in shards.glob("shard-*.tar"):
        assert path.read_bytes() == (photos / "alone" / path.name).read_bytes()

    shutil.copy(photos / "images" / "01.png", photos / "images" / "05.png")
    refused = subprocess.run([*command, "--seed", "3"], env=home, capture_output=True, text=True, timeout=240)
    assert "was begun with other settings (seed)" in refused.stderr


@pytest.mark.skipif(HAS_RAY, reason="Ray is installed")
def test_without_ray_the_error_states_how_to_install_it(photos: Path) -> None:
    with pytest.raises(ModuleNotFoundError, match=r"run: pip install '\.\[ray\]'"):
        make_dataset(pairs_in(photos / "images", photos / "depths"), photos / "out")
