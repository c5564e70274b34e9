"""A file traced at 64 x 64 renders a frame of 1080p in bounded memory."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchdof import blur_by_coc
from torchdof.bench import exported

pytestmark = pytest.mark.hard

LIMIT_GB = 0.7
SIZE = (1080, 1920)

RENDER = """
import json, sys
import numpy as np
import onnxruntime
from torchdof.bench import memory
options = onnxruntime.SessionOptions()
options.intra_op_num_threads, options.enable_mem_pattern = 1, False
session = onnxruntime.InferenceSession(sys.argv[1], options, providers=["CPUExecutionProvider"])
feed = dict(np.load(sys.argv[2]))
for _ in range(2):
    (out,) = session.run(None, feed)
print(json.dumps({"peak_gb": memory.peak_mb() * 2**20 / 1e9, "torch": "torch" in sys.modules}))
np.save(sys.argv[3], out)
"""


def test_1080p_is_rendered_right_with_less_than_0_7_gb(layered: Any, tmp_path: Path) -> None:
    """In a process as those who deploy have it: onnxruntime and numpy, no PyTorch."""
    assert layered.dof.max_coc_px == 16.0
    feed: dict[str, Any] = exported.feed(exported.session(str(layered.path), threads=1), SIZE, "blurred background")
    np.savez(tmp_path / "feed.npz", **feed)
    call = [sys.executable, "-c", RENDER, str(layered.path), str(tmp_path / "feed.npz"), str(tmp_path / "out.npy")]
    done = subprocess.run(call, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    told = json.loads(done.stdout.splitlines()[-1])
    print(f"peak memory {told['peak_gb']:.2f} GB")
    assert not told["torch"]
    assert 0.3 < told["peak_gb"] < LIMIT_GB

    data = {name: torch.from_numpy(value) for name, value in feed.items()}
    out, image = torch.from_numpy(np.load(tmp_path / "out.npy")), data["image"]
    assert out.shape == (1, 3, *SIZE)
    assert torch.equal(out[..., :900], image[..., :900]), "the left half is in focus"
    coc = layered.dof.coc_px(image, data["depth"], data["focus_m"], data["f_number"])
    assert 15.0 < coc.max() <= 16.0
    rows, columns = slice(400, 640), slice(1280, 1600)  # of the blurred half, on the coarse layers' grid
    part = [tensor[..., rows, columns].contiguous() for tensor in (image, coc)]
    with torch.no_grad():
        expected = blur_by_coc(*part, plan=layered.plan, **layered.dof.options.arguments())
    inner = (..., slice(80, -80), slice(80, -80))  # where the part's border is out of reach
    assert (expected - part[0])[inner].abs().max() > 0.3
    torch.testing.assert_close(out[..., rows, columns][inner], expected[inner], atol=1e-5, rtol=0)
