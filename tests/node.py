"""Node and its packages, for the tests of samples and files in JavaScript; skipped where they are not installed."""

import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

ROOT = Path(__file__).parents[1]
NODE_FOLDER = Path(os.environ.get("TORCHDOF_NODE_FOLDER", ROOT / "build" / "node"))
ENVIRONMENT = {**os.environ, "TORCHDOF_NODE_FOLDER": str(NODE_FOLDER)}
NEEDS_NODE = pytest.mark.skipif(shutil.which("node") is None, reason="Node is not installed")


def needs(*packages: str) -> pytest.MarkDecorator:
    """Skips a test where packages of Node are missing."""
    missing = not all((NODE_FOLDER / "node_modules" / name).is_dir() for name in packages)
    reason = f"packages are missing: npm install --prefix build/node {' '.join(packages)}"
    return pytest.mark.skipif(shutil.which("node") is None or missing, reason=reason)


def run(call: Sequence[object], environment: Mapping[str, str] = ENVIRONMENT) -> str:
    """What a program prints, which must not fail."""
    done = subprocess.run(list(map(str, call)), capture_output=True, text=True, env=environment, timeout=240)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def pixels(path: Path) -> np.ndarray:
    """Values of a picture as stored, 0 to 1."""
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT))


def linear(encoded: np.ndarray) -> np.ndarray:
    """Linear light of sRGB."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)


def srgb_codes(light: np.ndarray) -> np.ndarray:
    """8-bit sRGB of linear light."""
    value = np.clip(light, 0, 1)
    return np.rint(255 * np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055))
