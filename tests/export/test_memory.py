"""A file that was traced at 64 x 64 renders 1080p in bounded memory."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.processes import output_of
from torchdof import blur_by_coc

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


def test_1080p_is_rendered_correctly_with_less_than_0_7_gb(layered: Any, tmp_path: Path) -> None:
    """Runs in a process with onnxruntime and numpy but without PyTorch, as in a deployment."""
    assert layered.dof.max_coc_px == 8.0
    camera, (height, width) = layered.dof.camera, SIZE
    fraction = np.zeros((1, 1, *SIZE), np.float32)  # of the largest radius
    fraction[..., width // 2 :] = np.linspace(0.0, 0.95, width - width // 2, dtype=np.float32)
    wide = camera.replace(focus_m=2.0, f_number=1.0).coc_px(torch.full((1, 1, 1, 1), torch.inf), width)
    feed: dict[str, Any] = {
        "image": np.random.default_rng(0).random((1, 3, height, width), dtype=np.float32),
        "depth": 2.0 / (1.0 - fraction),
        "focus_m": np.full(1, 2.0, np.float32),
        "f_number": wide.flatten().numpy().astype(np.float32) / 8.0,  # infinity has the largest radius
    }
    np.savez(tmp_path / "feed.npz", **feed)
    printed = output_of(RENDER, layered.path, tmp_path / "feed.npz", tmp_path / "out.npy")
    report = json.loads(printed.splitlines()[-1])
    print(f"peak memory {report['peak_gb']:.2f} GB")
    assert not report["torch"]
    assert 0.3 < report["peak_gb"] < LIMIT_GB

    data = {name: torch.from_numpy(value) for name, value in feed.items()}
    out, image = torch.from_numpy(np.load(tmp_path / "out.npy")), data["image"]
    assert out.shape == (1, 3, *SIZE)
    assert torch.equal(out[..., :900], image[..., :900]), "the left half is in focus"
    coc = layered.dof.coc_px(image, data["depth"], data["focus_m"], data["f_number"])
    assert 7.5 < coc.max() <= 8.0
    rows, columns = slice(400, 640), slice(1280, 1600)  # in the blurred half, at multiples of the coarse layers' pixels
    part = [tensor[..., rows, columns].contiguous() for tensor in (image, coc)]
    with torch.no_grad():
        expected = blur_by_coc(*part, plan=layered.plan, **layered.dof.options.arguments())
    inner = (..., slice(80, -80), slice(80, -80))  # pixels that the border of the part does not influence
    assert (expected - part[0])[inner].abs().max() > 0.3
    torch.testing.assert_close(out[..., rows, columns][inner], expected[inner], atol=1e-5, rtol=0)
