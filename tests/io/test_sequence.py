from functools import partial
from pathlib import Path

import pytest

from tests.refused import refuses
from torchdof.io.sequence import FramePattern, focus_at_frame, parse_focus, parse_frames


@pytest.mark.parametrize(
    ("pattern", "frame", "name"),
    [
        ("a.####.exr", 7, "a.0007.exr"),
        ("a.####.exr", 12345, "a.12345.exr"),
        ("a_%03d.png", 7, "a_007.png"),
        ("%d/take #1/%d.exr", 7, "%d/take #1/7.exr"),
        ("%d.png", 7, "7.png"),
        ("#.png", 12, "12.png"),
    ],
)
def test_pattern_names_frames(pattern: str, frame: int, name: str) -> None:
    assert FramePattern(pattern).name(frame) == Path(name)


def test_frames_are_found_in_order_and_only_with_their_padding(tmp_path: Path) -> None:
    for name in ("a.0010.exr", "a.0002.exr", "a.10000.exr", "a.3.exr", "b.0001.exr", "a.0004.exr.part"):
        (tmp_path / name).touch()
    assert FramePattern(tmp_path / "a.####.exr").frames() == [2, 10, 10000]
    assert FramePattern(tmp_path / "missing" / "a.####.exr").frames() == []
    # dots and brackets are taken literally
    for name in ("a+[x].01.exr", "aa[x]x01.exr"):
        (tmp_path / name).touch()
    assert FramePattern(tmp_path / "a+[x].##.exr").frames() == [1]


@pytest.mark.parametrize(("text", "expected"), [("1-48", (1, 48)), ("7", (7, 7)), (" 3 - 3 ", (3, 3))])
def test_frame_ranges_are_read(text: str, expected: tuple[int, int]) -> None:
    assert parse_frames(text) == expected


# the command line says what ranges and keyframes should be
test_invalid_patterns_ranges_and_keyframes_are_refused = refuses(
    *((partial(FramePattern, text), "expected one place for the frame number")
      for text in ("a.exr", "a.##.##.exr", "shot.##/a.exr")),
    *((partial(parse_frames, text), "^") for text in ("", "a", "1-", "5-1", "1,2", "1.5")),
    *((partial(parse_focus, text), "^")
      for text in ("", "near", "0", "-1", "nan", "1:2,", "1:2,1:3", "1:2,3", "2,3", "1:0", "x:2", "1.5:2", "1:2:3")),
)  # fmt: skip


def test_focus_is_linear_in_dioptres_between_keyframes_and_constant_outside() -> None:
    keys = parse_focus("20:4.0,10:2.0")
    assert [focus_at_frame(keys, n) for n in (0, 10, 20, 99)] == [2.0, 2.0, 4.0, 4.0]
    assert focus_at_frame(keys, 15) == pytest.approx(1 / 0.375)
    keys = parse_focus("0:1,4:inf,8:inf")
    assert [focus_at_frame(keys, n) for n in (0, 2, 4, 6)] == [1.0, 2.0, float("inf"), float("inf")]
