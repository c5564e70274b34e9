import importlib.util
import os
from pathlib import Path
from types import ModuleType

import pytest
import torch
from hypothesis import HealthCheck, settings

settings.register_profile("local", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", parent=settings.get_profile("local"), derandomize=True, print_blob=True)
settings.register_profile("many", parent=settings.get_profile("local"), max_examples=5000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE") or ("ci" if os.environ.get("CI") else "local"))


@pytest.fixture(autouse=True)
def _same_random_numbers() -> None:
    torch.manual_seed(0)


def _beside(name: str) -> ModuleType:
    """A module of shared helpers in this folder: tests are imported one by one, not as a package."""
    spec = importlib.util.spec_from_file_location(f"torchdof_tests_{name}", Path(__file__).with_name(f"{name}.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def loops() -> ModuleType:
    """The slow references of `loops.py`."""
    return _beside("loops")


@pytest.fixture(scope="session")
def tolerances() -> dict[torch.dtype, dict[str, float]]:
    """Type -> rtol and atol, for `assert_close(a, b, **tolerances[a.dtype])`."""
    return _beside("tolerances").TOLERANCES
