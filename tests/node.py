"""Node and its packages, for the tests of samples and files in JavaScript; skipped where they are not installed."""

import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

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
