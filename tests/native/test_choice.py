"""Choice of the engine by ``TORCHDOF_ENGINE``."""

import pytest
import torch

from torchdof import blur_by_coc, native


def test_an_engine_of_another_version_is_not_used_and_gives_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TORCHDOF_ENGINE", raising=False)
    monkeypatch.setattr(native, "_REVISION", -1)
    native._library.cache_clear()
    try:
        with pytest.warns(RuntimeWarning, match="of another version of torchdof, and is not used: install"):
            assert not native.chosen()
        assert native.describe() == "torch (the compiled engine is of another version of torchdof)"
        monkeypatch.setenv("TORCHDOF_ENGINE", "native")
        with pytest.raises(ValueError, match="is native, but the compiled engine is of another version"):
            native.chosen()
    finally:
        native._library.cache_clear()


def test_an_unknown_engine_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "numpy")
    with pytest.raises(ValueError, match="must be auto, native or torch, got 'numpy'"):
        native.describe()
    with pytest.raises(ValueError, match="must be auto, native or torch, got 'numpy'"):
        blur_by_coc(torch.rand(1, 3, 3, 4), torch.full((1, 1, 3, 4), 3.0))
