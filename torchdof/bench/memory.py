"""Memory that this process holds, as Linux tells it; NaN where a system does not."""

import contextlib
import ctypes
import math
from pathlib import Path

__all__ = ["peak_mb", "reset_peak"]


def peak_mb() -> float:
    """Most memory this process has held since it started or since :func:`reset_peak`, in MiB.

    Unlike ``ru_maxrss`` it leaves out what a parent held when it started the process.
    """
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return math.nan
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:")), math.nan)


def reset_peak() -> float:
    """Forget the peak; returns what the process holds now, in MiB."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)  # else what was freed before would serve unseen
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return math.nan
    return peak_mb()
