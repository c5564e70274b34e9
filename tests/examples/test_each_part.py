import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from examples.benchmarks import each_part

SCENES = Path(__file__).parents[1] / "data" / "scenes" / "planes"


def test_what_parts_are_worth_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    kept = ["everything", "no matting of mixed pixels", "nothing filled in behind blurred foregrounds"]
    monkeypatch.setattr(each_part, "PARTS", {part: each_part.PARTS[part] for part in kept})
    monkeypatch.setattr(sys, "argv", ["each_part.py", str(SCENES), "--made", "0"])
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")  # is set anyway, and is to be taken back
    each_part.main()
    head, _, whole, *rows = capsys.readouterr().out.splitlines()
    assert head == "| | all read | planes |"
    assert [row.split(" | ")[0] for row in (whole, *rows)] == [f"| {part}" for part in kept]
    assert float(whole.split(" | ")[1]) > 20.0 and all(float(row.split(" | ")[1]) < 0.0 for row in rows)


@pytest.mark.parametrize("part", each_part.PARTS)
def test_a_part_is_switched_off_only_as_long_as_is_asked_for(part: str) -> None:
    before = [getattr(owner, name) for owner, name, _ in each_part.PARTS[part]]
    with each_part.switched_off(part):
        for owner, name, stand_in in each_part.PARTS[part]:
            assert getattr(owner, name) is stand_in
    assert [getattr(owner, name) for owner, name, _ in each_part.PARTS[part]] == before


@pytest.mark.parametrize("make", [each_part.made_scene, each_part.strand_scene])
def test_a_made_scene_has_several_surfaces_of_which_one_is_in_focus(monkeypatch: pytest.MonkeyPatch, make: Any) -> None:
    monkeypatch.setattr(each_part, "SIZE", (16, 40))
    monkeypatch.setattr(each_part, "SAMPLES", 4)
    blurs = make(1).coc_px.unique()
    assert len(blurs) > 1 and float(blurs.abs().min()) < 1e-3
    assert torch.equal(make(1).truth, make(1).truth)
