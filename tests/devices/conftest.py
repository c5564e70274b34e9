"""The kernels of GPUs for tensors on the CPU: their C++ build, with the host code that a GPU has."""

from collections.abc import Iterator
from typing import Any

import pytest

from tests import on_cpu
from torchdof.kernels import layers
from torchdof.render import on_gpu


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Names of the kernels that were launched; tensors on the CPU are rendered as those on a GPU are."""
    if on_cpu.COMPILER is None:
        pytest.skip("there is no C++ compiler")
    names: list[str] = []

    def module(*variant: Any) -> layers.Launch:
        launch = on_cpu.module(*variant)

        def recorded(kernel: str, *arguments: Any) -> None:
            names.append(kernel)
            launch(kernel, *arguments)

        return recorded

    monkeypatch.setattr(on_gpu, "DEVICE", "cpu")
    monkeypatch.setattr(layers, "module", module)
    monkeypatch.setenv("TORCHDOF_ENGINE", "gpu")
    forget()
    yield names
    forget()


def forget() -> None:
    """Forgets which kernels were tried, and the warnings."""
    on_gpu.why_missing.cache_clear()
    on_gpu._warn.cache_clear()
