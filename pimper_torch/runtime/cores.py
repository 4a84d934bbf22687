"""Number of cores that a process may use; it may be lower than the machine's."""

import math
import os
from contextlib import suppress
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")
# A quota and its period in microseconds: of version 2, then of version 1.
_QUOTAS = (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us"))


def usable_cores() -> int:
    """Return the number of cores that a process may use, at least 1.

    They are those that affinity, the CPU quota of a container and ``OMP_NUM_THREADS`` leave. A
    quota of a core and a half is two cores.
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
    with suppress(ValueError):  # several levels, or nothing
        cores = min(cores, max(1, int(os.environ.get("OMP_NUM_THREADS", ""))))
    return cores
