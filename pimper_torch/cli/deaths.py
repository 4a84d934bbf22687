"""Messages about a process that was killed or crashed."""

import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from pimper_torch.cli.crash_report import limit, write_report
from pimper_torch.cli.output import Output
from pimper_torch.outputs.stages import kept, resumption

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
