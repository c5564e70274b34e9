"""A file that was traced at 64 x 64 renders 1080p in bounded memory."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.processes import output_of

pytestmark = pytest.mark.hard

LIMIT_GB = 0.7
SIZE = (1080, 1920)

RENDER = r"""
import sys
import numpy as np
import onnxruntime
import re
options = onnxruntime.SessionOptions()
options.intra_op_num_threads, options.enable_mem_pattern = 1, False
session = onnxruntime.InferenceSession(sys.argv[1], options, providers=["CPUExecutionProvider"])
feed = dict(np.load(sys.argv[2]))
for _ in range(2):
    (out,) = session.run(None, feed)
peak_kb = int(re.findall(r"VmHWM:\s*(\d+)", open("/proc/self/status").read())[0])
print(peak_kb * 2**10 / 1e9, "torch" in sys.modules)
np.save(sys.argv[3], out)
"""


def test_1080p_is_rendered_with_less_than_0_7_gb(layered: Any, tmp_path: Path) -> None:
    """Runs in a process with onnxruntime and numpy but without PyTorch, as in a deployment."""
    camera, (height, width) = layered.dof.camera, SIZE
    fraction = np.zeros((1, 1, *SIZE), np.float32)  # of the largest radius
    fraction[..., width // 2 :] = np.linspace(0.0, 0.95, width - width // 2, dtype=np.float32)
    wide = camera.replace(focus_m=2.0, f_number=1.0).coc_px(torch.full((1, 1, 1, 1), torch.inf), width)
    feed: dict[str, Any] = {
        "image": np.random.default_rng(0).random((1, 3, height, width), dtype=np.float32),
        "depth": 2.0 / (1.0 - fraction),
        "focus_m": np.full(1, 2.0, np.float32),
        "f_number": wide.flatten().numpy().astype(np.float32) / layered.dof.max_coc_px,  # infinity has the largest
    }
    np.savez(tmp_path / "feed.npz", **feed)
    peak_gb, torch_is_loaded = output_of(RENDER, layered.path, tmp_path / "feed.npz", tmp_path / "out.npy").split()
    assert torch_is_loaded == "False" and 0.3 < float(peak_gb) < LIMIT_GB
    changed = np.abs(np.load(tmp_path / "out.npy") - feed["image"]).max((0, 1, 2))
    assert changed[:900].max() == 0.0 and changed[1280:1600].min() > 0.3, "the left half is in focus"
