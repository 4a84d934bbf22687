"""Number of cores that a process may use, which may be less than the machine has."""

import math
import os
from contextlib import suppress
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")
# Files with a quota and its period in microseconds: cgroup version 2, then version 1.
_QUOTAS = (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us"))


def usable_cores() -> int:
    """Return the number of cores that a process may use, at least 1.

    Affinity, the CPU quota of a container (rounded up) and ``OMP_NUM_THREADS`` limit it.
    """
    cores = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):  # Linux
        cores = len(os.sched_getaffinity(0))
    for names in _QUOTAS:
        with suppress(OSError, ValueError):  # no such file, or "max"
            words = " ".join((_CGROUP / name).read_text() for name in names).split()
            quota, period = map(int, words)
            if quota > 0 and period > 0:
                cores = min(cores, math.ceil(quota / period))
    with suppress(ValueError):  # nested levels (4,2), or not set
        cores = min(cores, max(1, int(os.environ.get("OMP_NUM_THREADS", ""))))
    return cores
