"""Measures every hard case and writes the table of errors: `python tests/hard/write_table.py [out/hard_cases.md]`."""

import argparse
import importlib.util
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import onnxruntime
import torch

from torchdof import DepthOfField
from torchdof.export import to_onnx

TYPES = {"float32": torch.float32, "float16": torch.float16}
ENGINES = ("torch", "native")
HEAD = """# Hard cases and their measured errors

Each row renders one hostile input, 32 x 24 pixels, and compares it with the truth named: a closed form where there is
one, else the same rendering in float64 of the same (rounded) input. The number is the largest difference of a pixel,
relative to that pixel. A picture in float16 cannot be nearer than half a unit in its last place: {half:.1e}. Depth and
circle of confusion are in float32 throughout; only the light is in the type of the column.

*torch* is the plain engine, *native* the compiled one; what it does not serve (`method="fold"`) is the plain engine's.
The column *onnxruntime* is the exported file ({layers} layers up to 6 px) on the same input in float32, against the
module with the same layers in float64.

Made by `python tests/hard/write_table.py` with PyTorch {torch} and onnxruntime {onnxruntime} on
{machine}, {threads} threads. `pytest -m hard` holds every number to its limit (float32, float16, onnxruntime).

Tried: {count} cases, {measured} errors measured. Beside them `pytest -m hard` takes {tests} tests of hostile arguments,
files, light, gradients and command lines, those of Hypothesis with 50 to 100 examples each.
"""


def beside(name: str) -> ModuleType:
    """A module beside this file."""
    spec = importlib.util.spec_from_file_location(f"torchdof_hard_{name}", Path(__file__).with_name(f"{name}.py"))
    if spec is None or spec.loader is None:
        raise ImportError(f"{name}.py must lie beside this file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def table(cases: ModuleType, through_onnx: Callable[[Any], float]) -> str:
    """All measurements as Markdown, one section a group of cases."""
    lines, group = [], ""
    for number, case in enumerate(cases.CASES, 1):
        if case.group != group:
            group = case.group
            columns = [*(f"{name} {engine}" for name in TYPES for engine in ENGINES), "onnxruntime"]
            lines += ["", f"## {group.capitalize()}", "", f"| case | truth | {' | '.join(columns)} | limits |"]
            lines.append("| --- | --- |" + " ---: |" * (len(columns) + 1))
        start = time.perf_counter()
        errors = [by_engine(case, dtype, engine) for dtype in TYPES.values() for engine in ENGINES]
        errors.append(through_onnx(case))
        shown = " | ".join(f"{error:.1e}" if error else "0" for error in errors)
        bounds = [*(case.limit[dtype] for dtype in TYPES.values()), case.onnx_limit]
        limits = ", ".join(f"{bound:.0e}" if bound else "0" for bound in bounds)
        lines.append(f"| {case.name} | {case.truth} | {shown} | {limits} |")
        seconds = time.perf_counter() - start
        print(f"{number}/{len(cases.CASES)} {case.group}: {case.name}: {shown} ({seconds:.1f} s)", file=sys.stderr)
    return "\n".join(lines) + "\n"


def by_engine(case: Any, dtype: torch.dtype, engine: str) -> float:
    """The error of a case by one engine."""
    os.environ["TORCHDOF_ENGINE"] = engine
    try:
        return case.measure(dtype)
    finally:
        del os.environ["TORCHDOF_ENGINE"]


def count_of_tests() -> int:
    """How many tests are marked as hard."""
    call = [sys.executable, "-m", "pytest", "-q", "--collect-only", "-m", "hard"]
    said = subprocess.run(call, cwd=Path(__file__).parents[2], capture_output=True, text=True).stdout
    found = re.search(r"(\d+)(?:/\d+)? tests collected", said)
    if found is None:
        raise ValueError(f"pytest collects no tests: {said[-500:]}")
    return int(found.group(1))


def main() -> None:
    """Writes the file named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, nargs="?", default=Path("out/hard_cases.md"))
    out = parser.parse_args().out
    cases, exported = beside("cases"), beside("exported")
    with tempfile.TemporaryDirectory() as folder:
        path, dof = (
            Path(folder) / "dof.onnx",
            DepthOfField(cases.CAMERA, tolerance=8 / 255, max_coc_px=6.0, check=False),
        )
        to_onnx(dof, path)
        file = exported.Exported(path, dof)
    rows = table(cases, lambda case: exported.worst_error(file, cases, case))
    head = HEAD.format(
        half=2**-11,
        layers=len(file.portable.plan.nodes),
        torch=torch.__version__,
        onnxruntime=onnxruntime.__version__,
        machine=platform.machine(),
        threads=torch.get_num_threads(),
        count=len(cases.CASES),
        measured=len(cases.CASES) * (len(TYPES) * len(ENGINES) + 1),
        tests=count_of_tests(),
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(head + rows, encoding="utf-8")


if __name__ == "__main__":
    main()
