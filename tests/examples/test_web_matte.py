"""The page of ``examples/web`` reads a subject's mask as ``--matte`` does."""

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch

from tests.node import NEEDS_NODE, ROOT, run
from torchdof.io.matte import matte_of_size, read_matte

pytestmark = NEEDS_NODE


def masks() -> dict[str, np.ndarray]:
    """Masks of every kind, ``[H, W, C]``, as programs write them."""
    random = np.random.default_rng(0)
    grey = random.integers(0, 256, (12, 20, 1)).astype(np.uint8)
    opaque = np.full_like(grey, 255)
    colours = random.integers(0, 256, (12, 20, 3)).astype(np.uint8)
    return {
        "grey.png": grey,
        "words.png": (257 * grey.astype(np.uint16) + 3 * (grey < 200)).astype(np.uint16),
        "labels.png": (grey > 127).astype(np.uint8),
        "equal.png": grey.repeat(3, 2),
        "opaque.png": np.concatenate([grey.repeat(3, 2), opaque], 2),
        "cut_out.png": np.concatenate([colours, grey], 2),
        "colours.png": colours,
        "opaque_colours.png": np.concatenate([colours, opaque], 2),
    }


def test_coverage_is_that_of_the_command_at_every_size(tmp_path: Path) -> None:
    for name, values in masks().items():
        buffer = oiio.ImageBuf(np.ascontiguousarray(values))
        buffer.specmod().attribute("oiio:UnassociatedAlpha", 1)
        assert buffer.write(str(tmp_path / name))
    got = json.loads(run(["node", ROOT / "tests" / "examples" / "matte.mjs", tmp_path]))
    for name in masks():
        if "colours" in name:
            assert got[name] == (
                "the mask is in colour. Save it as shades of grey, white where the subject is, or as transparency."
            )
            continue
        expected = read_matte(tmp_path / name)
        for size in got[name]:
            ours = torch.tensor(size["values"], dtype=torch.float32).view(1, 1, size["height"], size["width"])
            of_size = torch.nn.functional.interpolate(expected, ours.shape[-2:], mode="bilinear", antialias=True)
            torch.testing.assert_close(ours, of_size, atol=1e-5, rtol=0)
    assert torch.equal(matte_of_size(read_matte(tmp_path / "grey.png"), (12, 20)), read_matte(tmp_path / "grey.png"))


def test_a_file_gets_the_matte_or_zeros_and_one_without_the_input_says_so(tmp_path: Path) -> None:
    got = json.loads(run(["node", ROOT / "tests" / "examples" / "matte.mjs", tmp_path]))
    assert got["image matte"] == [[0, 0], [0.25, 1], "2 x 1 pixels need 2 values of the matte, got 1"]
    refused = "the file takes no matte: write it with torchdof export --inputs depth+matte"
    assert got["image"] == [[], refused, refused]
