"""Installed versions, cores and memory of the machine."""

import os
from collections.abc import Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import torch

from pimper_torch.cores import usable_cores
from pimper_torch.doctor.findings import Finding, ok, warned
from pimper_torch.io.version import versions

_NEEDED = ("numba", "pycolmap", "kornia", "embreex", "fcpw", "cholespy", "cv2", "skimage")


def machine() -> Iterator[Finding]:
    """Report versions, device, threads and memory."""
    told = ", ".join(f"{name} {version}" for name, version in versions().items())
    missing = [name for name in _NEEDED if find_spec(name) is None]
    if missing:
        advice = "Run `pip install pimper_torch` again."
        found = f"{told}; without {', '.join(missing)}"
        yield warned("installed", found, "all packages that pimper_torch names", advice, "error")
    else:
        yield ok("installed", told)
    cuda = torch.cuda.is_available()
    device = f"CPU and {torch.cuda.get_device_name()}" if cuda else "CPU"
    yield ok(
        "device", f"{device}, {torch.get_num_threads()} threads on {usable_cores()} processors"
    )
    free, total = available_gb(), total_gb()
    if free is None or total is None:
        yield Finding(check="memory", severity="note", found="the system does not tell its memory")
        return
    found = f"{free:.1f} of {total:.1f} GB are free"
    if free < 2.5:
        advice = "Close other programs; the demo takes that much."
        yield warned("memory", found, "2.5 GB", advice)
    else:
        yield ok("memory", found)


def available_gb() -> float | None:
    """Return the memory that a process may still take; ``None`` where the system does not tell."""
    free = None
    with suppress(OSError, IndexError, ValueError):
        fields = Path("/proc/meminfo").read_text(encoding="ascii")
        free = 1024 * float(fields.split("MemAvailable:")[1].split()[0])
    with suppress(OSError, ValueError):  # of a container
        group = Path("/sys/fs/cgroup")
        limit = float((group / "memory.max").read_text(encoding="ascii"))
        used = float((group / "memory.current").read_text(encoding="ascii"))
        free = min(free or limit, limit - used)
    return None if free is None else free / 1e9


def total_gb() -> float | None:
    """Return the memory of the machine; ``None`` where the system does not tell."""
    with suppress(AttributeError, OSError, ValueError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    return None
