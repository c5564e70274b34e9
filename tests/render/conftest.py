import pytest


@pytest.fixture(autouse=True)
def _plain_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    """This room's own engine; `tests/native` holds the compiled one to it."""
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
