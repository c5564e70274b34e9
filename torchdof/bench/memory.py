"""Resident memory of this process as Linux reports it; NaN on other systems."""

import contextlib
import ctypes
import math
import re
from pathlib import Path

__all__ = ["peak_mb", "reset_peak"]


def peak_mb() -> float:
    """Peak memory of this process, without its parent's, since it started or since :func:`reset_peak`, in MiB."""
    try:
        return int(re.findall(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())[0]) / 1024
    except (OSError, IndexError):
        return math.nan


def reset_peak() -> float:
    """Resets the peak; returns the memory in use, in MiB."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)  # memory freed before would otherwise be reused unnoticed
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return math.nan
    return peak_mb()
