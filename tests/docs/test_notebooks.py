"""The notebooks run from top to bottom, with the assertions in their cells, and give the outputs that are stored."""

import base64
import io
import json
import re
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.docs.notebooks import NOTEBOOKS, code_cells, run


def picture(output: dict[str, Any]) -> Image.Image:
    return Image.open(io.BytesIO(base64.b64decode(output["data"]["image/jpeg"])))


@pytest.mark.parametrize("name", sorted(path.name for path in NOTEBOOKS.glob("*.ipynb")))
def test_a_notebook_gives_its_stored_outputs(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(NOTEBOOKS)
    notebook = json.loads((NOTEBOOKS / name).read_text())
    pictures = 0
    for cell, outputs in zip(code_cells(notebook), run(notebook), strict=True):
        assert [o["output_type"] for o in cell["outputs"]] == [o["output_type"] for o in outputs]
        for stored, new in zip(cell["outputs"], outputs, strict=True):
            if new["output_type"] == "stream":  # digits may differ from processor to processor
                words = [re.sub(r"[\d.]+", "0", "".join(o["text"])) for o in (stored, new)]
                assert words[0] == words[1]
                continue
            ours, theirs = (np.asarray(picture(o), dtype=float) for o in (new, stored))
            assert ours.shape == theirs.shape and np.abs(ours - theirs).mean() < 2.0
            pictures += 1
    assert pictures >= 2, "a reader sees pictures without running anything"
