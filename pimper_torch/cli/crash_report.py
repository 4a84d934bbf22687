"""Messages and report files for killed processes and unexpected errors."""

import shlex
import signal
import sys
import tempfile
import traceback
from datetime import UTC, datetime
from pathlib import Path

from pimper_torch.io.version import versions

SHRINK = (
    "Shrink the photographs (`--max-size-px`), close other programs, or set a limit that is "
    "checked early (`--max-memory`)."
)


def what_killed(ended: int) -> str:
    """Return a sentence about a process that ended without a message.

    Args:
        ended: Its exit code; or the negative number of the signal that killed it.
    """
    if ended == -signal.SIGKILL:
        return (
            "the run was killed by the system or by somebody (SIGKILL), most likely because memory "
            "ran out."
        )
    is_signal = -ended in {*signal.Signals}
    name = signal.Signals(-ended).name if is_signal else f"exit code {ended}"
    return f"the run crashed ({name}), most likely because memory ran out in a native library."


def write_report(error: BaseException) -> Path | None:
    """Write the traceback of an error to a file for bug reports, with versions and arguments.

    Returns:
        The file; ``None`` if it cannot be written.
    """
    lines = [f"{name} {version}" for name, version in versions().items()]
    lines += [f"at {datetime.now(UTC).isoformat(' ', 'seconds')}", shlex.join(sys.argv), ""]
    try:
        with tempfile.NamedTemporaryFile(
            *("w", -1, "utf-8"), prefix="pimper-", suffix=".txt", delete=False, errors="replace"
        ) as file:
            file.write("\n".join([*lines, *traceback.format_exception(error)]))
    except OSError:
        return None
    return Path(file.name)
