import sys
from pathlib import Path

import pytest

from examples.benchmarks import repair_speed

SCENES = Path(__file__).parents[1] / "data" / "scenes" / "planes"


def test_what_the_repair_costs_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(repair_speed, "SIZE", (36, 64))
    monkeypatch.setattr(repair_speed, "KINDS", ("exact", "half-res"))
    monkeypatch.setattr(sys, "argv", ["repair_speed.py", str(SCENES), "--repeat", "1"])
    repair_speed.main()
    head, _, *rows = capsys.readouterr().out.splitlines()
    assert head == "| | exact | half-res |"
    assert rows and all(row.startswith("| planes/") and row.count("(") == 2 for row in rows)
