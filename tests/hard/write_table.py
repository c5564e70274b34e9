"""Measures every hard case and writes the table of errors: `python tests/hard/write_table.py docs/hard_cases.md`."""

import argparse
import importlib.util
import platform
import sys
import time
from pathlib import Path
from types import ModuleType

import torch

TYPES = {"float32": torch.float32, "float16": torch.float16}
HEAD = """# Hard cases and their measured errors

Each row renders one hostile input, 32 x 24 pixels, and compares it with the truth named: a closed form where there is
one, else the same rendering in float64 of the same (rounded) input. The number is the largest difference of a pixel,
relative to that pixel. A picture in float16 cannot be nearer than half a unit in its last place: {half:.1e}. Depth and
circle of confusion are in float32 throughout; only the light is in the type of the column.

Made by `python tests/hard/write_table.py docs/hard_cases.md` with PyTorch {torch} on {machine}, {threads} threads.
`pytest -m hard` holds every number to its limit.
"""


def load_cases() -> ModuleType:
    """The cases beside this file."""
    spec = importlib.util.spec_from_file_location("torchdof_hard_cases", Path(__file__).with_name("cases.py"))
    if spec is None or spec.loader is None:
        raise ImportError("cases.py must lie beside this file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def table(cases: ModuleType) -> str:
    """All measurements as Markdown, one section a group of cases."""
    lines, group = [], ""
    for number, case in enumerate(cases.CASES, 1):
        if case.group != group:
            group = case.group
            lines += ["", f"## {group.capitalize()}", "", f"| case | truth | {' | '.join(TYPES)} | limits |"]
            lines.append("| --- | --- |" + " ---: |" * len(TYPES) + " ---: |")
        start = time.perf_counter()
        errors = [case.measure(dtype) for dtype in TYPES.values()]
        shown = " | ".join(f"{error:.1e}" if error else "0" for error in errors)
        limits = ", ".join(f"{case.limit[dtype]:.0e}" if case.limit[dtype] else "0" for dtype in TYPES.values())
        lines.append(f"| {case.name} | {case.truth} | {shown} | {limits} |")
        seconds = time.perf_counter() - start
        print(f"{number}/{len(cases.CASES)} {case.group}: {case.name}: {shown} ({seconds:.1f} s)", file=sys.stderr)
    return "\n".join(lines) + "\n"


def main() -> None:
    """Writes the file named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    head = HEAD.format(
        half=2**-11, torch=torch.__version__, machine=platform.machine(), threads=torch.get_num_threads()
    )
    out.write_text(head + table(load_cases()), encoding="utf-8")


if __name__ == "__main__":
    main()
