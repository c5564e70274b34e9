from pathlib import Path

import pytest
from torch import Tensor

from examples.benchmarks import augmentation
from torchdof.augmentation import RandomDepthOfField

DATA = Path(__file__).parents[2] / "examples" / "data" / "motorcycle"


def test_it_prints_a_line_for_each_blur(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(augmentation, "_SIDE_PX", 32)
    monkeypatch.setattr("sys.argv", ["augmentation.py", "--data", str(DATA), "--batch", "2", "--repeat", "1"])
    augmentation.main()
    printed = capsys.readouterr().out
    lines = [line for line in printed.splitlines() if line.startswith("| torchdof") or line.startswith("| kornia")]
    assert len(lines) == 4 and "1 threads" in printed
    assert all(float(line.split("|")[2]) > 0 for line in lines)


def test_a_wrong_picture_is_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    def brighter(self: RandomDepthOfField, image: Tensor, depth: Tensor) -> Tensor:
        self._params = self.forward_parameters(tuple(image.shape))
        return image + 0.1

    monkeypatch.setattr(augmentation, "_SIDE_PX", 32)
    monkeypatch.setattr(RandomDepthOfField, "forward", brighter)
    with pytest.raises(RuntimeError, match="final: the picture is not the rendering of its parameters"):
        augmentation.works(*augmentation.crops(DATA, 2))
