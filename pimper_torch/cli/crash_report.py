"""Sentences and reports about a process that was killed or came upon what nobody expected."""

import shlex
import signal
import sys
import tempfile
import traceback
from datetime import UTC, datetime
from pathlib import Path

from pimper_torch.doors.io.version import versions


def what_killed(ended: int) -> str:
    """Report how a process ended that said nothing.

    Args:
        ended: Its exit code; less than 0, of which signal it died.
    """
    if ended == -signal.SIGKILL:
        return (
            "the run was killed by the system or by somebody (SIGKILL), most likely because memory "
            "ran out."
        )
    known = -ended in {*signal.Signals}
    name = signal.Signals(-ended).name if known else f"exit code {ended}"
    return f"the run crashed ({name}), most likely because memory ran out in a native library."


def write_report(error: BaseException) -> Path | None:
    """Write the traceback of an error to a file that can be sent, with versions and arguments.

    Returns:
        The file; ``None`` where the disk refuses.
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
