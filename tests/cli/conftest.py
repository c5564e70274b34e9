"""The capture simulator of the fits' tests."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def simulator() -> ModuleType:
    """The module `tests/fit/simulator.py`."""
    path = Path(__file__).parents[1] / "fit" / "simulator.py"
    spec = importlib.util.spec_from_file_location("capture_simulator", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
