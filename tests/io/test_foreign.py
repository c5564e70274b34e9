"""Phones' HEIC and cameras' raw files: read where OpenImageIO has their readers, else how to convert them."""

from pathlib import Path

import pytest
import torch

from torchdof.io import foreign
from torchdof.io.images import Picture, read_image, write_image


@pytest.mark.parametrize(
    ("name", "how"),
    [("a.heic", "convert it to JPEG or 16-bit TIFF"), ("a.AVIF", "convert it"), ("a.dng", "develop it to linear")],
)
def test_without_a_reader_it_says_how_to_convert(monkeypatch: pytest.MonkeyPatch, name: str, how: str) -> None:
    monkeypatch.setattr(foreign, "readable", lambda: ())
    with pytest.raises(ValueError, match=rf"{name}: {Path(name).suffix.lower()} is not read here: {how}"):
        read_image(name)


def test_with_a_reader_it_is_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    # OpenImageIO goes by what is in a file: a JPEG stands for what its reader of HEIC would give
    write_image(tmp_path / "a.jpg", Picture(torch.full((1, 3, 8, 8), 0.2159)))
    (tmp_path / "a.jpg").rename(tmp_path / "a.heic")
    monkeypatch.setattr(foreign, "readable", lambda: (".heic",))
    assert float(read_image(tmp_path / "a.heic").pixels.mean()) == pytest.approx(0.2159, abs=0.002)


def test_other_types_are_none_of_its_business() -> None:
    assert foreign.refusal("a.png") is None and foreign.refusal(None) is None
    assert set(foreign.readable()) <= set(foreign.SUFFIXES)
