"""Files of a small scene for the tests of the command line."""

import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from torchdof.cli.main import app
from torchdof.io.images import Picture, write_image

HEIGHT, WIDTH = 16, 24


@pytest.fixture
def image() -> torch.Tensor:
    """``[1, 3, 16, 24]``."""
    return torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))


@pytest.fixture
def depth() -> torch.Tensor:
    """``[1, 1, 16, 24]``: 2 m left, 6 m right."""
    metres = torch.full((1, 1, HEIGHT, WIDTH), 2.0)
    metres[..., WIDTH // 2 :] = 6.0
    return metres


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, image: torch.Tensor, depth: torch.Tensor) -> Path:
    """A folder with image.exr and depth.npy, and three frames of both; it is the working folder."""
    monkeypatch.chdir(tmp_path)
    write_image("image.exr", Picture(image, sample="float"))
    np.save("depth.npy", depth.numpy())
    for n in range(1, 4):
        write_image(f"shot.{n:04d}.exr", Picture(image * n, sample="float"))
        np.save(f"depth.{n:04d}.npy", depth.numpy())
    return tmp_path


@pytest.fixture
def run() -> Callable[..., str]:
    """Runs a command and gives its standard output; with `code` other than 0, its standard error."""

    def run(line: str, *arguments: object, code: int = 0) -> str:
        result = CliRunner().invoke(app, [*shlex.split(line), *map(str, arguments)], catch_exceptions=False)
        assert result.exit_code == code, result.output
        return result.stdout if code == 0 else result.stderr

    return run
