"""`examples/run_onnx.py` renders the shipped photograph where PyTorch cannot be imported."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

ROOT = Path(__file__).parents[2]
DATA = ROOT / "examples" / "data" / "motorcycle"


def test_the_example_needs_no_torch(layered: Any, tmp_path: Path) -> None:
    (tmp_path / "torch.py").write_text("raise ImportError('torch was imported')")
    (tmp_path / "torchdof.py").write_text("raise ImportError('torchdof was imported')")
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    check = subprocess.run([sys.executable, "-c", "import torch"], env=environment, capture_output=True, text=True)
    assert "torch was imported" in check.stderr
    call = [sys.executable, str(ROOT / "examples" / "run_onnx.py"), str(layered.path)]
    call += [str(DATA / "motorcycle_left.png"), str(DATA / "motorcycle_disp.npz"), str(tmp_path / "out.png")]
    call += ["--focus-m", "2.3", "--f-number", "1.2", "--disparity-scale", "192.03", "--disparity-offset", "31.086"]
    done = subprocess.run(call, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "741 x 500" in done.stdout and "'disc'" in done.stdout
    sharp, blurred = (
        np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT))[..., :3]
        for path in (DATA / "motorcycle_left.png", tmp_path / "out.png")
    )
    assert sharp.shape == blurred.shape
    assert 0.005 < np.abs(sharp - blurred).mean() < 0.2
