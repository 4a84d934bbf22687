"""Reports of what ended unexpectedly."""

import shlex
import sys
import tempfile
import traceback
from datetime import UTC, datetime
from pathlib import Path

from pimper_torch.io.version import versions


def write_report(what: BaseException | str) -> Path | None:
    """Write what happened to a file that can be sent, with versions and the command line.

    Args:
        what: An error, whose traceback is written, or what a process said last.

    Returns:
        The file; ``None`` where the disk refuses.
    """
    lines = [f"{name} {version}" for name, version in versions().items()]
    lines += [f"at {datetime.now(UTC).isoformat(' ', 'seconds')}", shlex.join(sys.argv), ""]
    text = what if isinstance(what, str) else "".join(traceback.format_exception(what))
    try:
        with tempfile.NamedTemporaryFile(
            *("w", -1, "utf-8"), prefix="pimper-", suffix=".txt", delete=False, errors="replace"
        ) as file:
            file.write("\n".join(lines) + "\n" + text)
    except OSError:
        return None
    return Path(file.name)


def limit() -> str:
    """Name the limit of this process's memory in a sentence, if there is one."""
    try:
        import resource
    except ImportError:  # as on Windows
        return ""
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    if most == resource.RLIM_INFINITY:
        return ""
    return f" Its memory is limited to {most / 1e9:.1f} GB (`ulimit -v`)."
