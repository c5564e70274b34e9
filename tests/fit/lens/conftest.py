from collections.abc import Callable
from pathlib import Path

import pytest

from torchdof.fit.lens import Lens


@pytest.fixture
def lens_of(tmp_path: Path) -> Callable[..., Lens]:
    """Reads a lens from text."""

    def read(text: str, name: str = "lens.txt", encoding: str = "utf-8") -> Lens:
        (tmp_path / name).write_text(text, encoding=encoding)
        return Lens.read(tmp_path / name)

    return read
