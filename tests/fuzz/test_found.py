"""Findings of the fuzzer stay fixed, and a short run of every target finds nothing new."""

import itertools
import os
import random
import time
from pathlib import Path

import pytest

from tests.fuzz import targets
from tests.fuzz.mutate import mutated
from tests.fuzz.targets import TARGETS

pytestmark = pytest.mark.hard


FOUND = sorted(path for path in Path(__file__).with_name("found").glob("*/*") if path.is_file())


def printed(capfd: pytest.CaptureFixture[str]) -> list[str]:
    """Lines on the terminal, except those of libpng."""
    return [line for text in capfd.readouterr() for line in text.splitlines() if not line.startswith("libpng ")]


@pytest.mark.parametrize("path", FOUND, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_earlier_findings_are_read_or_refused(path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert targets.finding(TARGETS[path.parent.name], path) is None
    assert printed(capfd) == []


@pytest.mark.parametrize("name", TARGETS)
def test_valid_and_mutated_inputs_give_no_finding(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """FUZZ_SECONDS in the environment is the time in seconds for all targets, with other mutations each time.

    The file of a finding stays in the folder that pytest names; copied to ``found/TARGET/`` it becomes a test.
    """
    seconds = float(os.environ.get("FUZZ_SECONDS", 0.0)) / len(TARGETS)
    seed, end = time.time_ns() if seconds else 0, time.monotonic() + seconds
    target, rng = TARGETS[name], random.Random(seed)
    (tmp_path / "seeds").mkdir()
    corpus, contents = list(targets.seeds(target, tmp_path / "seeds")), set[int]()
    path = tmp_path / ("capture.toml" if name == "manifest" else f"input{target.suffix}")
    for number in itertools.count():
        if number >= len(corpus) + 100 and time.monotonic() >= end:
            break
        content = corpus[number] if number < len(corpus) else mutated(rng.choice(corpus), corpus, target.suffix, rng)
        contents.add(hash(content))
        path.write_bytes(content)
        assert targets.finding(target, path) is None, path
        assert not printed(capfd), path
    assert len(contents) > len(corpus) + 10
