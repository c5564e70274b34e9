"""Resident memory of this process as Linux reports it; NaN on other systems."""

import contextlib
import ctypes
import math
from pathlib import Path

__all__ = ["peak_mb", "reset_peak"]


def peak_mb() -> float:
    """Peak memory of this process since it started or since :func:`reset_peak`, in MiB.

    Unlike ``ru_maxrss``, it does not include the memory of the parent process at its start.
    """
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return math.nan
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:")), math.nan)


def reset_peak() -> float:
    """Resets the peak; returns the memory in use, in MiB."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)  # memory freed before would otherwise be reused unnoticed
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return math.nan
    return peak_mb()
