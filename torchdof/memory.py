"""Memory of this process: what it holds, as Linux tells it, NaN where a system does not; and what becomes of it."""

import contextlib
import ctypes
import math
from pathlib import Path

__all__ = ["keep_freed", "peak_mb", "reset_peak"]

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # as malloc.h has them
_ALWAYS = 2**31 - 1
_LARGEST = 2**26  # bytes; larger blocks leave gaps that the next ones do not fit


def keep_freed() -> bool:
    """Have this process keep what it frees, to use it again, for as long as it runs: blocks of up to 64 MiB.

    Large blocks otherwise go back to the system after each rendering, which hands them out again page by page, each
    cleared: at 1920 x 1080 tens of thousands of page faults for each image. For processes that render one image after
    another. ``torchdof`` on the command line calls it.

    Returns:
        Whether the C library does so; only glibc does.

    Reference:
        mallopt(3), the Linux manual.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # no such library, no such function; Windows has no name for it
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, _LARGEST)) and bool(mallopt(_M_TRIM_THRESHOLD, _ALWAYS))


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
