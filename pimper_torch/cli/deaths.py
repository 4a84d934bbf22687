"""Messages and reports about a process that was killed or crashed."""

import shlex
import signal
import sys
import tempfile
import traceback
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from pimper_torch.cli.output import Output
from pimper_torch.doors.io.version import versions
from pimper_torch.doors.outputs.stages import kept, resumption

_CRASHES = ("SIGSEGV", "SIGABRT", "SIGBUS", "SIGILL", "SIGFPE", "SIGTRAP", "SIGSYS")
_LESS = (
    "Shrink the photographs (`--max-size-px`), close other programs, or give `--max-memory` to be "
    "told before the surface takes too much."
)


def tell_death(ended: int, said: str) -> int:
    """Report why the work ended, what to do, and what is kept.

    Args:
        ended: The exit code of a process that told nothing; less than 0, of which signal it died.
        said: What native libraries said before.
    """
    code, name = 128 - ended if ended < 0 else ended, _name(ended)
    text = f"{what_killed(ended)}{limit()} {_LESS}{_kept(sys.argv[1:])}"
    if name != "SIGKILL":
        report = write_report(f"{name}\n{said}")
        if report is not None:
            text += f" If memory was not the reason, please report {report}."
    Output(as_json="--json" in sys.argv).error("Killed", text, code)
    return code


def _name(ended: int) -> str:
    if ended > 0:
        return f"exit code {ended}"
    known = -ended in {*signal.Signals}
    return signal.Signals(-ended).name if known else f"signal {-ended}"


def what_killed(ended: int) -> str:
    """Report how a process ended that told nothing."""
    name = _name(ended)
    if name == "SIGKILL":
        return (
            "the run was killed by the system or by somebody (SIGKILL), most likely because memory "
            "ran out."
        )
    if name in _CRASHES or name.startswith("exit"):
        return (
            f"the run crashed in a native library ({name}), most likely because memory ran out "
            "there."
        )
    return f"the run was ended by {name}."


def _kept(arguments: Sequence[str]) -> str:
    """Report what the folder of the result keeps, as far as the arguments name it."""
    out = folder_of(arguments)
    if out is None or not out.is_dir():
        return " No result was written."
    if not kept(out):
        return " No result was written, and what was there before is there still."
    return f" {resumption(out)}"


def folder_of(arguments: Sequence[str]) -> Path | None:
    """Find the folder for the result in a command line.

    >>> folder_of(["reconstruct", "photos", "-o", "out"]).name
    'out'
    """
    for index, argument in enumerate(arguments):
        name, equals, value = argument.partition("=")
        if name in ("-o", "--out"):
            value = value if equals else "".join(arguments[index + 1 : index + 2])
            return Path(value) if value else None
    return Path("pimper_demo") if arguments[:1] == ["demo"] else None


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
