"""Free memory, with which the size in a file's header is compared before reading."""

import contextlib
import math
import os
import re
from pathlib import Path

_CGROUP_FILES = (  # limit and use of a control group, version 2 and 1
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def free_bytes() -> float:
    """Bytes that this process can still allocate, limited by machine, ulimit and container; ``inf`` if unknown."""
    limits = [math.inf]
    with contextlib.suppress(OSError):
        limits += [1024.0 * int(kib) for kib in re.findall(r"MemAvailable:\s*(\d+)", Path("/proc/meminfo").read_text())]
    for limit, used in _CGROUP_FILES:
        with contextlib.suppress(OSError, ValueError):  # "max" means no limit
            limits.append(float(int(Path(limit).read_text()) - int(Path(used).read_text())))
    with contextlib.suppress(ImportError, OSError):
        import resource

        address_space, _ = resource.getrlimit(resource.RLIMIT_AS)  # ulimit -v
        if address_space != resource.RLIM_INFINITY:
            used_pages = int(Path("/proc/self/statm").read_text().split()[0])
            limits.append(address_space - used_pages * os.sysconf("SC_PAGE_SIZE"))
    return min(limits)
