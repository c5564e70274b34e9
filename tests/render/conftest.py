import pytest


@pytest.fixture(autouse=True)
def _plain_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    """These tests use the plain engine; `tests/test_engines.py` compares the compiled one with it."""
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
