"""How much memory this process can still take: what a file's header promises is held against it before reading."""

import contextlib
import math
import os
import sys
from pathlib import Path

__all__ = ["free_bytes"]


def free_bytes() -> float:
    """Bytes that this process can still take: what the machine, its limits and its container leave; ``inf`` if unknown.

    Example:
        >>> free_bytes() > 2**20
        True
    """
    return min(_machine(), _container(), _limit())


def _machine() -> float:
    """What the machine has left, memory that it would free for it included."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return 1024.0 * int(line.split()[1])
    return math.inf


def _container() -> float:
    """What the control group of a container leaves (version 2, else 1)."""
    for folder, limit, used in (
        ("/sys/fs/cgroup", "memory.max", "memory.current"),
        ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes"),
    ):
        with contextlib.suppress(OSError, ValueError):  # "max" is no number: there is no limit
            return float(int(Path(folder, limit).read_text()) - int(Path(folder, used).read_text()))
    return math.inf


def _limit() -> float:
    """What the limit on this process's address space leaves (``ulimit -v``)."""
    if sys.platform != "linux":
        return math.inf
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return math.inf
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    return float(limit - pages * os.sysconf("SC_PAGE_SIZE"))
