"""Which engine renders: ``TORCHDOF_ENGINE``."""

import pytest

from torchdof import native


def test_the_compiled_engine_is_chosen_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "native")
    assert native.describe() in ("native (avx2)", "native (baseline)")
    monkeypatch.delenv("TORCHDOF_ENGINE")
    assert native.describe().startswith("native (")


def test_the_plain_engine_can_be_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    assert native.describe().startswith("torch (")


def test_an_unknown_engine_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "numpy")
    with pytest.raises(ValueError, match="must be auto, native or torch, got 'numpy'"):
        native.describe()
