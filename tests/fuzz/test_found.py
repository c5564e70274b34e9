"""Findings of the fuzzer stay fixed, and a short run of every target finds nothing new."""

import random
from pathlib import Path

import pytest

from tests.fuzz import targets
from tests.fuzz.mutate import mutated
from tests.fuzz.targets import TARGETS

pytestmark = pytest.mark.hard


FOUND = sorted(path for path in Path(__file__).with_name("found").glob("*/*") if path.is_file())


@pytest.mark.parametrize("path", FOUND, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_earlier_findings_are_read_or_refused(path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert targets.finding(TARGETS[path.parent.name], path) is None
    printed = [line for text in capfd.readouterr() for line in text.splitlines() if not line.startswith("libpng ")]
    assert printed == []


@pytest.mark.parametrize("name", TARGETS)
def test_valid_and_mutated_inputs_give_no_finding(name: str, tmp_path: Path) -> None:
    target, rng = TARGETS[name], random.Random(0)
    count = 20 if target.suffix == ".scene" else 100  # rendering is slow
    corpus = list(targets.seeds(target, tmp_path))
    path = tmp_path / f"input{target.suffix}"
    inputs = corpus + [mutated(rng.choice(corpus), corpus, target.suffix, rng) for _ in range(count)]
    for content in inputs:
        path.write_bytes(content)
        assert targets.finding(target, path) is None
    assert len(set(inputs)) > len(corpus) + 10
