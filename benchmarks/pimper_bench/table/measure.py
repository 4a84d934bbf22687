"""The machine of a measurement, and peak memory."""

import platform
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from pimper_torch.cli.doctor.findings import total_gb
from pimper_torch.io.version import installed_version
from pimper_torch.records import Record
from pimper_torch.runtime.cores import usable_cores


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine(Record):
    """A machine, its system and package versions.

    Attributes:
        gpu: Name of the first GPU, or empty.
        versions: Of the packages that affect figures, as ``name version``.
    """

    cpu: str
    cores: int
    memory_gb: float
    gpu: str
    system: str
    python: str
    versions: tuple[str, ...]

    @property
    def summary(self) -> str:
        """The machine in one line."""
        cores = f"{self.cores} core{'s' if self.cores != 1 else ''}"
        hardware = [self.cpu, cores, f"{self.memory_gb:.0f} GB", *([self.gpu] if self.gpu else [])]
        return (
            f"{', '.join(hardware)}; {self.system}; Python {self.python}; "
            f"{', '.join(self.versions)}"
        )


_PACKAGES = ("pimper_torch", "torch", "numpy", "scipy", "pycolmap", "embreex")


def this_machine() -> Machine:
    """Return a description of this machine."""
    return Machine(
        cpu=_cpu(),
        cores=usable_cores(),
        memory_gb=round((total_gb() or 0) * 1e9 / 2**30, 1),
        gpu=torch.cuda.get_device_name(0) if torch.cuda.is_available() else "",
        system=f"{platform.system()} {platform.machine()}",
        python=platform.python_version(),
        versions=tuple(f"{name} {installed_version(name)}" for name in _PACKAGES),
    )


def _cpu() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    named = re.search(r"^model name\s*:\s*(.+)$", text, flags=re.MULTILINE)
    return named[1].strip() if named else platform.processor() or platform.machine()


_SELF = Path("/proc/self")
_RESET_PEAK = "5"  # see proc(5), clear_refs


@contextmanager
def peak_memory() -> Iterator[Callable[[], float | None]]:
    """Measure the peak of resident memory within the ``with`` block.

    The operating system's peak is over the lifetime of a process. Memory in use at the start
    counts, memory of external programs does not.

    Yields:
        A function that returns the peak since the start in MB; ``None`` on systems except Linux.
    """
    try:
        (_SELF / "clear_refs").write_text(_RESET_PEAK, encoding="ascii")
    except OSError:
        yield lambda: None
        return
    yield _peak_mb


def _peak_mb() -> float | None:
    status = (_SELF / "status").read_text(encoding="ascii", errors="replace")
    match = re.search(r"^VmHWM:\s*(\d+) kB", status, flags=re.MULTILINE)
    return int(match[1]) / 2**10 if match else None
