"""What fuzzing found stays mended, and the mutators do what they say."""

import random
from pathlib import Path

import pytest

from tests.fuzz import targets
from tests.fuzz.mutate import mutated
from tests.fuzz.targets import TARGETS
from torchdof.io.images import read_image

pytestmark = pytest.mark.hard


FOUND = sorted(path for path in Path(__file__).with_name("found").glob("*/*") if path.is_file())


@pytest.mark.parametrize("path", FOUND, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_what_was_found_is_taken_or_refused(path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert targets.finding(TARGETS[path.parent.name], path) is None
    printed = [line for text in capfd.readouterr() for line in text.splitlines() if not line.startswith("libpng ")]
    assert printed == []


@pytest.mark.parametrize("name", TARGETS)
def test_whole_inputs_and_changed_ones_are_no_finding(name: str, tmp_path: Path) -> None:
    target, rng = TARGETS[name], random.Random(0)
    count = 20 if target.suffix == ".scene" else 100  # of scenes each takes long
    corpus = list(targets.seeds(target, tmp_path))
    path = tmp_path / f"input{target.suffix}"
    inputs = corpus + [mutated(rng.choice(corpus), corpus, target.suffix, rng) for _ in range(count)]
    for content in inputs:
        path.write_bytes(content)
        assert targets.finding(target, path) is None
    assert len(set(inputs)) > len(corpus) + 10


def test_changed_chunks_of_a_png_can_have_right_checksums(tmp_path: Path) -> None:
    corpus = list(targets.seeds(TARGETS["png"], tmp_path))
    path, rng, said = tmp_path / "x.png", random.Random(0), []
    for _ in range(200):
        content = mutated(corpus[0], corpus, ".png", rng)
        if not content:  # refused before its parts are looked at
            continue
        path.write_bytes(content)
        try:
            read_image(path)
        except (OSError, ValueError) as error:
            said.append(str(error))
    assert any("filter" in line for line in said) or any("invalid" in line for line in said)
    assert sum("checksum" in line for line in said) < len(said) / 2
