"""The capture simulator, for every test of the fits."""

import importlib.util
import sys
from pathlib import Path

import pytest


def _load():
    spec = importlib.util.spec_from_file_location("capture_simulator", Path(__file__).with_name("simulator.py"))
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def simulator():
    """The module `simulator.py` beside this file."""
    return _load()
