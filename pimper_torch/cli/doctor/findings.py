"""Findings: measurement, requirement and advice; and the findings on the machine."""

import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pimper_torch.io.version import versions
from pimper_torch.runtime.cores import usable_cores

Severity = Literal["ok", "note", "warning"]


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check.

    Attributes:
        severity: ok; note, possibly intended; or warning, if the result will be worse.
        needed: The requirement; empty if it is met.
        advice: Advice to the user; empty if the requirement is met.
    """

    check: str
    severity: Severity
    found: str
    needed: str = ""
    advice: str = ""

    def __str__(self) -> str:
        needed = f"; needed: {self.needed}" if self.needed else ""
        advice = f" {self.advice}" if self.advice else ""
        return f"{self.found}{needed}.{advice}"


def machine() -> Iterator[Finding]:
    """Report versions, device, threads and memory."""
    import torch

    installed = ", ".join(f"{name} {version}" for name, version in versions().items())
    yield Finding("installed", "ok", installed)
    cuda = torch.cuda.is_available()
    device = f"CPU and {torch.cuda.get_device_name()}" if cuda else "CPU"
    threads = f"{torch.get_num_threads()} threads on {usable_cores()} processors"
    yield Finding("device", "ok", f"{device}, {threads}")
    free, total = available_gb(), total_gb()
    if free is None or total is None:
        yield Finding("memory", "note", "the system does not report its memory")
        return
    found, advice = f"{free:.1f} of {total:.1f} GB are free", "Close other programs."
    short = ("2.5 GB, as for the demo", advice) if free < 2.5 else ()
    yield Finding("memory", "warning" if short else "ok", found, *short)


def available_gb() -> float | None:
    """Return the memory that is still free for a process; ``None`` if unknown."""
    free = None
    with suppress(OSError, IndexError, ValueError):
        fields = Path("/proc/meminfo").read_text(encoding="ascii")
        free = 1024 * float(fields.split("MemAvailable:")[1].split()[0])
    with suppress(OSError, ValueError):  # in a container
        group = Path("/sys/fs/cgroup")
        limit = float((group / "memory.max").read_text(encoding="ascii"))
        used = float((group / "memory.current").read_text(encoding="ascii"))
        pages = (group / "memory.stat").read_text(encoding="ascii").split("inactive_file ")[1]
        used -= float(pages.split()[0])  # of files, which the system drops
        free = min(free or limit, limit - used)
    return None if free is None else free / 1e9


def total_gb() -> float | None:
    """Return the memory of the machine; ``None`` if unknown."""
    with suppress(AttributeError, OSError, ValueError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    return None
