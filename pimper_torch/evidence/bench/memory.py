"""The peak memory of a part of the program."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_SELF = Path("/proc/self")
_RESET_PEAK = "5"  # see proc(5), clear_refs


@contextmanager
def peak_memory() -> Iterator[Callable[[], float | None]]:
    """Measure the peak of resident memory within the ``with`` block.

    The operating system's own peak is of the whole life of a process, so that a frugal method
    would inherit that of the one before. What was in use before counts, what external programs
    use does not.

    Yields:
        A function that gives the peak since then in MB; ``None`` where the system, other than
        Linux, cannot tell.
    """
    try:
        (_SELF / "clear_refs").write_text(_RESET_PEAK, encoding="ascii")
    except OSError:
        yield lambda: None
        return
    yield _peak_mb


def _peak_mb() -> float | None:
    status = (_SELF / "status").read_text(encoding="ascii", errors="replace")
    found = re.search(r"^VmHWM:\s*(\d+) kB", status, flags=re.MULTILINE)
    return int(found[1]) / 2**10 if found else None
