"""``torchdof tables``: the list of tables."""

import json
from collections.abc import Callable
from pathlib import Path

from torchdof import BlurTable


def test_every_table_that_ships_is_listed(run: Callable[..., str]) -> None:
    lines = run("tables").splitlines()
    assert [line.split()[0] for line in lines[:2]] == ["disc", "gaussian"]
    folder = Path(BlurTable.load.__code__.co_filename).parent / "tables"
    assert [line.split()[0] for line in lines[2:]] == sorted(path.stem for path in folder.glob("*.json"))


def test_json_has_the_printed_facts(run: Callable[..., str]) -> None:
    facts = json.loads(run("tables double_gauss_50mm_f2 --json"))
    name = "double_gauss_50mm_f2"
    assert [facts[key] for key in ("table", "family", "nodes", "unit")] == [name, "radial", 41, "mm"]
    assert facts["coc"][0] < 0 < facts["coc"][1] and facts["aperture"] is None
