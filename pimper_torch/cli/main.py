"""``pimper``: which command, and how it ends.

What takes long to import is imported when a command needs it.

Exit codes: 0 where the command did what it was asked for; 2 for what the user can correct, in one
paragraph; 130 when interrupted, 143 when terminated; 1 for anything unexpected, which is a fault of
the package. :mod:`pimper_torch.cli.supervise` gives 128 and the number of the signal where the
process was killed.
"""

import ctypes
import difflib
import errno
import gc
import io
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from typing import Any

from pimper_torch.cli.crash_report import write_report
from pimper_torch.cli.output import Output, split
from pimper_torch.cli.stopping import SIGNALS, exit_code, stoppable
from pimper_torch.doors.io.version import versions
from pimper_torch.doors.result_folder.files import require_name
from pimper_torch.runtime.cores import usable_cores
from pimper_torch.runtime.errors import ConfigError, InputError, PimperError, PimperWarning

_HELP = """\
usage: pimper COMMAND [options]
       pimper --version

Photographs from many viewpoints under many unknown lights, to a dense surface with normals,
albedo and light.

{}

`pimper COMMAND --help` tells the options, `--help-all` those of every stage, too.

Exit codes: 0 success; 2 bad input, a full disk or too little memory; 1 unexpected; 130 interrupted;
143 terminated; 137 killed and 139 crashed, as a rule for want of memory.
"""
_ABOUT = {
    "reconstruct PHOTOS -o OUT": "a folder of photographs",
    "batch LIST -o OUT": "many objects, on this machine or on an engine",
    "doctor [PHOTOS]": "what is installed here, and what photographs are worth, before a run",
    "demo": "the photographs of a skull that come with the package",
    "config [NAME]": "the settings of a preset and what they mean, or one of them",
    "render SCENE -o OUT": "photographs of a scene with known truth",
    "export RESULT -o OUT": "a result in the layouts of other programs",
    "evaluate RESULT TRUTH": "a result against the truth",
    "bench": "the table: scenes, presets and baselines",
    "convert DATA -o OUT": "a data set of another layout, or to one",
    "gamma PHOTOS": "the response of photographs from a fixed camera under several lights",
    "view OUT": "a result in the browser, to turn and to light",
    "frames VIDEO -o OUT": "photographs out of a video: sharp frames, equally far apart on the way",
    "markers -o SHEET": "a sheet to print and to photograph with an object, which tells its size",
    "clean OUT": "what runs into a folder kept to go on from, and what killed runs left",
}
# Where each of this package is carried out. `checked` reads and checks the arguments; `--help` ends
# it with SystemExit. It and `run` refuse with PimperError before anything is written.
_COMMANDS = {
    "reconstruct": "pimper_torch.cli.options",
    "batch": "pimper_torch.cli.batches.cli",
    "doctor": "pimper_torch.cli.doctor_command",
    "demo": "pimper_torch.cli.options",
    "config": "pimper_torch.cli.settings",
    "export": "pimper_torch.cli.export_command",
    "gamma": "pimper_torch.single_view.cli.gamma",
    "view": "pimper_torch.cli.view",
    "frames": "pimper_torch.cli.frames",
    "markers": "pimper_torch.cli.markers",
    "clean": "pimper_torch.cli.clean",
}
# Those of `pimper-bench`, which serve in a checkout that is not installed, too.
OF_BENCH = {
    "render": "pimper_bench.cli.render_command",
    "evaluate": "pimper_bench.cli.evaluate",
    "bench": "pimper_bench.cli.bench",
    "convert": "pimper_bench.cli.convert",
}
_LIGHT = ("batch", "clean", "config")  # carried out without torch, too
_UNEXPECTED, _BAD_INPUT = 1, 2
_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))
# What no program can help.
_REFUSALS = (
    *_FULL,
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO, errno.ENAMETOOLONG, errno.ELOOP),
    *(errno.EMFILE, errno.ENFILE, errno.ENOMEM),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line in this process.

    Args:
        arguments: Those of the process unless given.

    Returns:
        The exit code, see above. The traceback of anything unexpected is kept in a file.
    """
    if arguments is None:
        _print_anything()
    try:
        try:
            return _main(list(sys.argv[1:] if arguments is None else arguments))
        finally:
            sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # flushed again at exit
        if isinstance(error, BrokenPipeError):  # `pimper --help | head`: it has been read enough
            return 0
        return _failed(Output(), error)


def _print_anything() -> None:
    """Replace closed streams, and escape characters that a stream cannot print."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115, PTH123 - for good
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _main(given: list[str]) -> int:
    if not given or given[0] in ("-h", "--help", "--help-all"):
        sys.stdout.write(_help())
        return 0 if given else _BAD_INPUT
    if given[0] == "--version":
        sys.stdout.writelines(f"{name} {version}\n" for name, version in versions().items())
        return 0
    output = Output()
    try:
        output, arguments = split(given[1:])
        home = commands().get(given[0])
        if home is None:
            raise ConfigError(_no_command(given[0]))
        with _readable_warnings(output), stoppable():
            _run(given[0], home, arguments, output)
    except SystemExit as error:
        if isinstance(error.__context__, BrokenPipeError):  # rich's answer to it
            raise error.__context__ from None
        raise
    except (Exception, KeyboardInterrupt) as error:
        return _failed(output, error)
    return 0


def _help() -> str:
    """List the commands that are there, those of other distributions that have no line last."""
    home = commands()
    lines = {usage: about for usage, about in _ABOUT.items() if usage.split()[0] in home}
    others = {*home} - {usage.split()[0] for usage in lines}
    lines |= {name: f"brought by {home[name].partition('.')[0]}" for name in sorted(others)}
    return _HELP.format("\n".join(f"  {usage:<26} {about}" for usage, about in lines.items()))


def commands() -> dict[str, str]:
    """List all commands, and where each is carried out.

    Other distributions bring some by entry points of the group ``pimper.commands``: the name is the
    command's, the value the module. Its ``checked(command, arguments)`` reads and checks the
    arguments, and its ``run(job, output)`` carries the command out.
    """
    found = {one.name: one.module for one in entry_points(group="pimper.commands")}
    own = {} if find_spec("pimper_bench") is None else OF_BENCH
    return own | found | _COMMANDS


def _no_command(name: str) -> str:
    if name in OF_BENCH:
        return (
            f"`pimper {name}` comes with pimper-bench, which is not installed: `pip install "
            "./bench` in a clone of the repository brings it."
        )
    near = difflib.get_close_matches(name, commands(), n=1)
    hint = f" Did you mean `{near[0]}`?" if near else ""
    return f"there is no command `{name}`.{hint} See `pimper --help`."


def _run(command: str, home: str, arguments: list[str], output: Output) -> None:
    for argument in arguments:
        require_name(argument, InputError)
    carried_out_by = import_module(home)
    job = carried_out_by.checked(command, arguments)
    output.event("start", command=command, arguments=arguments, versions=versions(), format=1)
    _prepare_threads()
    if command not in _LIGHT:
        _load_torch()
    carried_out_by.run(job, output)


def _prepare_threads() -> None:
    """Set variables and options that torch and the C library read once."""
    # Threads that spin while they wait take the processor from those they wait for when the
    # machine is busy, and many small steps then take ten times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Pages of 2 MB where the system has them: a fifth of the demo's time went into 4 kB ones.
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    if usable_cores() < (os.cpu_count() or 1):  # OpenMP knows of affinity, not of quotas
        os.environ.setdefault("OMP_NUM_THREADS", str(usable_cores()))
    # Places that memory is taken from, one for each core. The C library of Linux makes eight, and
    # what runs leave in each adds up: from the second to the fourth run in one process memory grew
    # by 2.0 %, with two of them by 0.2.
    with suppress(OSError, AttributeError):  # other systems have no such function
        ctypes.CDLL("libc.so.6").mallopt(-8, usable_cores())  # M_ARENA_MAX


def _load_torch() -> None:
    """Import torch whole before signals are heard: half of it would end in odd errors."""
    blockable = hasattr(signal, "pthread_sigmask")
    former = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS) if blockable else None
    import torch  # noqa: F401

    gc.freeze()  # what was imported is out of all searches for unused memory
    if former is not None:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


def _failed(output: Output, error: BaseException) -> int:
    kind = type(error).__name__
    if isinstance(error, BrokenPipeError):
        raise error
    if output.shows("debug"):
        traceback.print_exception(error)
    notes = "".join(f" {note}" for note in getattr(error, "__notes__", ()))
    if isinstance(error, KeyboardInterrupt):
        code, left = exit_code(error), getattr(error, "left", "no result was written.")
        output.error("Interrupted", f"interrupted; {left}{notes}", code)
        return code
    expected = str(error) if isinstance(error, PimperError) else _of_the_world(error)
    if expected is not None:
        kind = "MemoryError" if "can't allocate memory" in str(error) else kind
        output.error(kind, expected + notes, _BAD_INPUT)
        return _BAD_INPUT
    report = write_report(error)
    if report is None:
        traceback.print_exception(error)
    text = (
        f"unexpected {kind}: {str(error).rstrip('.')}. This is a fault of pimper_torch; no result "
        f"was written.{notes} {report or 'Above'} is what a report needs: please send it."
    )
    output.error(kind, text, _UNEXPECTED)
    return _UNEXPECTED


def _of_the_world(error: BaseException) -> str | None:
    """Return advice for an error that is not the package's fault; ``None`` for any other."""
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        return (
            "memory ran out; no result was written. Shrink the photographs (`--max-size-px`), "
            "close other programs, or give `--max-memory` to be told beforehand."
        )
    if isinstance(error, OSError) and error.errno in _REFUSALS:
        place = "" if error.filename is None else f"{error.filename}: "
        advice = " Make room." if error.errno in _FULL else ""
        return f"{place}the system refuses ({error.strerror}); no result was written.{advice}"
    return None


@contextmanager
def _readable_warnings(output: Output) -> Iterator[None]:
    """Show our warnings as sentences, without a line of source; others as Python does."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", PimperWarning)
        usual = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *at: Any, **where: Any) -> None:  # noqa: ANN401
            if issubclass(category, PimperWarning):
                output.warning(str(message))
            elif output.shows("warning"):
                usual(message, category, *at, **where)

        warnings.showwarning = show
        yield
