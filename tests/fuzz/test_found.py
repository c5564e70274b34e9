"""Findings of the fuzzer stay fixed, and mutations of valid files by a seeded generator find nothing new."""

import base64
import binascii
import itertools
import os
import random
import re
import struct
import time
import zlib
from pathlib import Path

import pytest

from tests.fuzz.targets import REFUSED, TARGETS

pytestmark = pytest.mark.hard

FOUND = sorted(path for path in Path(__file__).with_name("found").glob("*/*") if path.is_file())
_WORDS = [b"", b"0", b"-1", b"1", b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e-320", b"9" * 400, b"null", b"true",
          b'"x"', b"[]", b"{}", b"[[1]]", b"\x00", b"\xff\xfe", b"../x", b"/dev/null", b"/"]  # fmt: skip
_NUMBERS = [0, 1, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1]
_PACKED = re.compile(rb'"light": "([A-Za-z0-9+/=]+)"')
_TOKEN = re.compile(rb'-?\d[\d.eE+-]*|"[^"]*"|[a-z_]+')


def mutated(content: bytes, others: list[bytes], suffix: str, rng: random.Random) -> bytes:
    """`content` after 1 to 6 random changes of bytes or, in formats with a structure, of tokens and numbers."""
    made = content
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        kinds = [_bytes, _bytes, _piece, _piece]
        if suffix in (".json", ".toml", ".txt", ".zmx"):
            kinds += [_token] * 12
        if suffix == ".json" and _PACKED.search(made):
            kinds += [_packed] * 3
        made = rng.choice(kinds)(made, others, rng)
    if suffix == ".png" and rng.random() < 0.8:
        made = _with_checksums(made)
    return made[: 2**18]


def _bytes(content: bytes, _: list[bytes], rng: random.Random) -> bytes:
    made = bytearray(content or b"\0")
    limit = len(made) if rng.random() < 0.5 else min(len(made), 400)  # half hit headers, with sizes and offsets
    for _change in range(rng.choice((1, 1, 2, 4))):
        place = rng.randrange(limit)
        made[place] = rng.choice((0, 255, 1 << rng.randrange(8) ^ made[place], rng.randrange(256)))
    return bytes(made)


def _piece(content: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """Replaces a piece by a number, nothing, the rest of another file, or repetitions."""
    start = rng.randrange(len(content) + 1)
    end = min(len(content), start + rng.randrange(1, 64))
    kind = rng.choice(("number", "cut", "splice", "repeat"))
    if kind == "number":
        form, start = rng.choice(("<I", ">I", "<H", ">H", "<Q")), min(start, rng.randrange(1000))
        number = struct.pack(form, rng.choice(_NUMBERS) % 256 ** struct.calcsize(form))
        return content[:start] + number + content[start + len(number) :]
    if kind == "repeat":
        return content[:end] + content[start:end] * rng.choice((1, 2, 50)) + content[end:]
    other = rng.choice(others) if kind == "splice" else b""
    return content[:start] + other[rng.randrange(len(other) + 1) :]


def _token(content: bytes, _: list[bytes], rng: random.Random) -> bytes:
    tokens = list(_TOKEN.finditer(content))
    if not tokens:
        return content
    token = rng.choice(tokens)
    word = rng.choice([*_WORDS, rng.choice(tokens).group()])
    return content[: token.start()] + word + content[token.end() :]


def _packed(content: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """Changes the bytes of a deflated, base64-encoded array."""
    found = _PACKED.search(content)
    try:
        assert found is not None
        numbers = zlib.decompress(base64.b64decode(found.group(1), validate=True))
    except (AssertionError, binascii.Error, zlib.error):  # changed before
        return content
    numbers = rng.choice((_bytes, _piece))(numbers, others, rng)
    return content[: found.start(1)] + base64.b64encode(zlib.compress(numbers)) + content[found.end(1) :]


def _with_checksums(content: bytes) -> bytes:
    """The PNG with the checksums of its changed chunks corrected, so that readers get past them."""
    made, place = bytearray(content), 8
    while place + 12 <= len(made):
        end = place + 12 + int.from_bytes(made[place : place + 4], "big")
        if end > len(made):
            break
        made[end - 4 : end] = struct.pack(">I", zlib.crc32(made[place + 4 : end - 4]))
        place = end
    return bytes(made)


def assert_no_finding(name: str, path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Every reader of a target reads a file or refuses it by its name, and prints nothing (libpng may)."""
    for run in TARGETS[name].runs:
        try:
            run(path)
        except REFUSED as error:
            # errors of a manifest name the pictures that are missing instead
            assert name == "manifest" or path.name in str(error), f"{path}: refused without its name: {error}"
    lines = [line for text in capfd.readouterr() for line in text.splitlines() if not line.startswith("libpng ")]
    assert not lines, path


@pytest.mark.parametrize("path", FOUND, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_earlier_findings_are_read_or_refused(path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert_no_finding(path.parent.name, path, capfd)


@pytest.mark.parametrize("name", TARGETS)
def test_valid_and_mutated_inputs_give_no_finding(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """FUZZ_SECONDS in the environment is the time in seconds for all targets, with other mutations each time.

    The file of a finding stays in the folder that pytest names; copied to ``found/TARGET/`` it becomes a test.
    """
    seconds = float(os.environ.get("FUZZ_SECONDS", 0.0)) / len(TARGETS)
    seed, end = time.time_ns() if seconds else 0, time.monotonic() + seconds
    target, rng = TARGETS[name], random.Random(seed)
    (tmp_path / "seeds").mkdir()
    target.seeds(tmp_path / "seeds")
    corpus, contents = [path.read_bytes() for path in sorted((tmp_path / "seeds").iterdir())], set[int]()
    path = tmp_path / ("capture.toml" if name == "manifest" else f"input{target.suffix}")
    for number in itertools.count():
        if number >= len(corpus) + 100 and time.monotonic() >= end:
            break
        content = corpus[number] if number < len(corpus) else mutated(rng.choice(corpus), corpus, target.suffix, rng)
        contents.add(hash(content))
        path.write_bytes(content)
        assert_no_finding(name, path, capfd)
    assert len(contents) > len(corpus) + 10
