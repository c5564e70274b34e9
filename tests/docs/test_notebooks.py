"""Notebooks run and give their stored outputs, which ``python -m tests.docs.test_notebooks`` stores anew."""

import ast
import base64
import contextlib
import io
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

NOTEBOOKS = Path(__file__).parents[2] / "examples" / "notebooks"


def code_cells(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def run(notebook: dict[str, Any]) -> Iterator[list[dict[str, Any]]]:
    """Outputs of each cell with code, as notebooks store them: the printed text, and the picture of its last line."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for cell in code_cells(notebook):
        body = ast.parse("".join(cell["source"])).body
        last = body.pop() if body and isinstance(body[-1], ast.Expr) else None
        printed, shown = io.StringIO(), None
        with contextlib.redirect_stdout(printed):
            exec(compile(ast.Module(body, []), "<cell>", "exec"), names)
            if isinstance(last, ast.Expr):
                shown = eval(compile(ast.Expression(last.value), "<cell>", "eval"), names)
        outputs: list[dict[str, Any]] = []
        if printed.getvalue():
            outputs.append({"name": "stdout", "output_type": "stream", "text": printed.getvalue().splitlines(True)})
        if isinstance(shown, Image.Image):
            file = io.BytesIO()
            shown.save(file, "JPEG", quality=90)
            data = {"image/jpeg": base64.b64encode(file.getvalue()).decode()}
            outputs.append({"data": data, "metadata": {}, "output_type": "display_data"})
        yield outputs


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


def store() -> None:
    os.chdir(NOTEBOOKS)
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        notebook = json.loads(path.read_text())
        for number, (cell, outputs) in enumerate(zip(code_cells(notebook), run(notebook), strict=True), 1):
            cell["outputs"], cell["execution_count"] = outputs, number
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    store()
