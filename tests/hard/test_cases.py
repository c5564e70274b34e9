"""Every hard case within its limit, in float32 and float16, by both engines."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

_spec = importlib.util.spec_from_file_location("torchdof_hard_cases", Path(__file__).with_name("cases.py"))
assert _spec is not None and _spec.loader is not None
_module = importlib.util.module_from_spec(_spec)
sys.modules[_spec.name] = _module
_spec.loader.exec_module(_module)

pytestmark = pytest.mark.hard


@pytest.mark.parametrize("engine", ["torch", "native"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16], ids=["float32", "float16"])
@pytest.mark.parametrize("case", _module.CASES, ids=lambda case: f"{case.group}: {case.name}")
def test_error_is_within_the_limit(case: Any, dtype: torch.dtype, engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", engine)
    assert case.measure(dtype) <= case.limit[dtype]


def test_names_of_cases_differ() -> None:
    names = [(case.group, case.name) for case in _module.CASES]
    assert len(set(names)) == len(names) > 40
