"""What inexact depth costs, in a table."""

import csv
from pathlib import Path

import pytest

from torchdof.bench import degraded

SCENES = Path(__file__).parents[1] / "data" / "scenes" / "planes"


def test_every_kind_of_depth_is_scored_with_every_renderer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(degraded, "KINDS", {kind: degraded.KINDS[kind] for kind in ("exact", "near -1px")})
    peer = tmp_path / "peer.py"
    peer.write_text("NAME = 'sharp'\ndef blur(image, coc_px):\n    return image, 0.1\n", encoding="utf-8")
    degraded.compare_degraded(SCENES, tmp_path, [peer])
    rows = list(csv.DictReader((tmp_path / "degraded.csv").read_text(encoding="utf-8").splitlines()))
    value = {(row["kind"], row["renderer"]): float(row["psnr_display"]) for row in rows}
    assert len(value) == len(rows) == 2 * 4
    assert value["exact", "torchdof"] == pytest.approx(value["exact", "as given"], abs=0.05)
    assert value["near -1px", "torchdof"] > value["near -1px", "as given"] + 0.3
    assert value["exact", "sharp"] == value["near -1px", "sharp"]
    assert "| near -1px |" in (tmp_path / "degraded.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", "has no function blur"),
        ("def blur(image, coc_px): ...\ndef available(): return 'apt install it'", "cannot run here; apt install it"),
    ],
)
def test_a_peer_that_cannot_run_is_refused(tmp_path: Path, text: str, message: str) -> None:
    peer = tmp_path / "peer.py"
    peer.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        degraded.read_peer(peer)
    with pytest.raises(FileNotFoundError, match="there is no such file"):
        degraded.read_peer(tmp_path / "none.py")
