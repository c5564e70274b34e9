"""Python in a process of its own."""

import subprocess
import sys
from typing import Any


def output_of(code: str, *arguments: object, **options: Any) -> str:
    """What code prints in a new process, which must not fail; ``options`` are those of :func:`subprocess.run`."""
    call = [sys.executable, *options.pop("flags", ()), "-c", code, *map(str, arguments)]
    run = subprocess.run(call, capture_output=True, text=True, **{"timeout": 300, **options})
    assert run.returncode == 0, run.stdout[-1000:] + run.stderr[-2000:]
    return run.stdout
