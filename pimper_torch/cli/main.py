"""``pimper``: run a command, and report how it ended.

Slow imports are deferred until a command needs them.

Exit codes: 0 success; 2 an error that the user can correct, reported in one paragraph; 130
interrupted, 143 terminated; 1 anything unexpected, which is a bug of the package.
:mod:`pimper_torch.cli.supervise` returns 128 plus the signal's number if the process was killed.
"""

import ctypes
import errno
import gc
import io
import os
import shlex
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pimper_torch.cli.output import Output, split
from pimper_torch.cli.stopping import SIGNALS, exit_code, stoppable
from pimper_torch.cli.supervise import SHRINK
from pimper_torch.export.result_folder.files import require_name
from pimper_torch.export.result_folder.marker import MARKER
from pimper_torch.io.version import versions
from pimper_torch.runtime.config import nearest
from pimper_torch.runtime.cores import usable_cores
from pimper_torch.runtime.errors import ConfigError, InputError, PimperError, PimperWarning

_HELP = """\
usage: pimper COMMAND [options]
       pimper --version

Reconstruct a dense surface with normals, albedo and lights from photographs, each from a different
viewpoint under a different unknown light.

{}

`pimper COMMAND --help` lists the options of a command, `--help-all` also those of all stages.

Exit codes: 0 success; 2 bad input, a full disk or too little memory; 1 unexpected error;
130 interrupted; 143 terminated; 137 killed and 139 crashed, usually because memory ran out.
"""
_ABOUT = {
    "reconstruct PHOTOS -o OUT": "reconstruct an object from a folder of photographs",
    "batch LIST -o OUT": "reconstruct many objects, on this machine or on a cluster",
    "doctor [PHOTOS]": "check the installation, and photographs before a run",
    "demo": "reconstruct the skull whose photographs come with the package",
    "config [NAME]": "print the settings of a preset with their meaning, or explain one",
    "render SCENE -o OUT": "render photographs of a scene with ground truth",
    "export RESULT -o OUT": "write a result in the formats of other programs",
    "evaluate RESULT TRUTH": "compare a result with ground truth",
    "bench": "run the benchmark: scenes, presets and baselines",
    "convert DATA -o OUT": "convert a data set between layouts",
    "gamma PHOTOS": "estimate the gamma of photographs: a fixed camera, several lights",
    "view OUT": "show a result in the browser, to turn and light it",
    "frames VIDEO -o OUT": "extract photographs from a video: sharp frames, evenly spaced",
    "markers -o SHEET": "write a sheet of markers, printed and photographed for real size",
    "clean OUT": "delete the records kept in a result folder, and files of killed runs",
}
# The module of each command of this package. Its `checked` reads and checks the arguments, and
# raises SystemExit after `--help`. It and `run` raise PimperError before anything is written.
_COMMANDS = {
    "reconstruct": "pimper_torch.cli.options",
    "batch": "pimper_torch.cli.batches.cli",
    "doctor": "pimper_torch.cli.doctor_command",
    "demo": "pimper_torch.cli.options",
    "config": "pimper_torch.cli.settings",
    "export": "pimper_torch.cli.export_command",
    "gamma": "pimper_torch.cli.gamma",
    "view": "pimper_torch.cli.view",
    "frames": "pimper_torch.cli.frames",
    "markers": "pimper_torch.cli.markers",
    "clean": "pimper_torch.cli.clean",
}
# Commands of `pimper-bench`; they also work in a checkout that is not installed.
OF_BENCH = {
    "render": "pimper_bench.cli.render_command",
    "evaluate": "pimper_bench.cli.evaluate",
    "bench": "pimper_bench.cli.bench",
    "convert": "pimper_bench.cli.convert",
}
_LIGHT = ("batch", "clean", "config")  # run without torch
_UNEXPECTED, _BAD_INPUT = 1, 2
_FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))
# Errors of the system, not bugs of the package.
_REFUSALS = (
    *_FULL,
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO, errno.ENAMETOOLONG, errno.ELOOP),
    *(errno.EMFILE, errno.ENFILE, errno.ENOMEM),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line in this process.

    Args:
        arguments: By default those of the process.

    Returns:
        The exit code, see above. Tracebacks of unexpected errors are written to a file.
    """
    if arguments is None:
        _make_streams_safe()
    try:
        try:
            return _main(list(sys.argv[1:] if arguments is None else arguments))
        finally:
            sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # flushed again at exit
        if isinstance(error, BrokenPipeError):  # `pimper --help | head`: the reader has stopped
            return 0
        return _failed(Output(), error)


def _make_streams_safe() -> None:
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
        module = commands().get(given[0])
        if module is None:
            raise ConfigError(_no_command(given[0]))
        with _readable_warnings(output), stoppable():
            _run(given[0], module, arguments, output)
    except SystemExit as error:
        if isinstance(error.__context__, BrokenPipeError):  # rich turns it into SystemExit
            raise error.__context__ from None
        raise
    except (Exception, KeyboardInterrupt) as error:
        return _failed(output, error)
    return 0


def _help() -> str:
    """Return the help page: installed commands, those of other distributions at the end."""
    modules = commands()
    lines = {usage: about for usage, about in _ABOUT.items() if usage.split()[0] in modules}
    others = {*modules} - {usage.split()[0] for usage in lines}
    lines |= {name: f"provided by {modules[name].partition('.')[0]}" for name in sorted(others)}
    return _HELP.format("\n".join(f"  {usage:<26} {about}" for usage, about in lines.items()))


def commands() -> dict[str, str]:
    """Return the module of each command, by the command's name.

    Other distributions add commands by entry points of the group ``pimper.commands``: the name is
    the command's, the value the module. Its ``checked(command, arguments)`` reads and checks the
    arguments, and its ``run(job, output)`` runs the command.
    """
    installed = {entry.name: entry.module for entry in entry_points(group="pimper.commands")}
    bench = {} if find_spec("pimper_bench") is None else OF_BENCH
    return bench | installed | _COMMANDS


def _no_command(name: str) -> str:
    if Path(name).is_dir():
        result = (Path(name) / MARKER).is_file()
        needed = f"view {name}" if result else f"reconstruct {name} -o OUT"
        return f"{name} is a folder; needed: a command before it, such as `pimper {needed}`."
    if name in OF_BENCH:
        return (
            f"`pimper {name}` comes with pimper-bench, which is not installed. Run `pip install "
            "./benchmarks` in a clone of the repository."
        )
    return f"there is no command `{name}`.{nearest(name, [*commands()])} See `pimper --help`."


def _run(command: str, name: str, arguments: list[str], output: Output) -> None:
    for argument in arguments:
        require_name(argument, InputError)
    module = import_module(name)
    job = module.checked(command, arguments)
    output.event("start", command=command, arguments=arguments, versions=versions(), format=1)
    _prepare_threads()
    if command not in _LIGHT:
        _load_torch()
    module.run(job, output)


def _prepare_threads() -> None:
    """Set variables and options that torch and the C library read once."""
    # On a busy machine, threads that spin while they wait take the processor from the threads they
    # wait for; many small steps then take ten times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Pages of 2 MB if the system has them: 4 kB pages cost a fifth of the demo's time.
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    if usable_cores() < (os.cpu_count() or 1):  # OpenMP respects affinity, but not quotas
        os.environ.setdefault("OMP_NUM_THREADS", str(usable_cores()))
    # One malloc arena per core. The C library of Linux makes eight, and runs leave memory in each:
    # from the second to the fourth run in one process it grew by 2.0 %, with two arenas by 0.2 %.
    with suppress(OSError, AttributeError):  # other systems have no such function
        ctypes.CDLL("libc.so.6").mallopt(-8, usable_cores())  # M_ARENA_MAX


def _load_torch() -> None:
    """Import torch with signals blocked: an interrupted import leads to misleading errors."""
    blockable = hasattr(signal, "pthread_sigmask")
    former = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS) if blockable else None
    import torch  # noqa: F401

    gc.freeze()  # garbage collections skip the imported modules
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
        code, saved = exit_code(error), getattr(error, "left", "no result was written.")
        output.error("Interrupted", f"interrupted; {saved}{notes}", code)
        return code
    expected = str(error) if isinstance(error, PimperError) else _system_advice(error)
    if expected is not None:
        kind = "MemoryError" if "can't allocate memory" in str(error) else kind
        output.error(kind, expected + notes, _BAD_INPUT)
        return _BAD_INPUT
    report = _write_report(error)
    if report is None:
        traceback.print_exception(error)
    text = (
        f"unexpected {kind}: {str(error).rstrip('.')}. This is a bug of pimper_torch; no result "
        f"was written.{notes} Please send {report or 'the traceback above'} with a bug report."
    )
    output.error(kind, text, _UNEXPECTED)
    return _UNEXPECTED


def _write_report(error: BaseException) -> Path | None:
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


def _system_advice(error: BaseException) -> str | None:
    """Return advice for an error that is not a bug of the package; ``None`` for any other."""
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error):
        return f"memory ran out; no result was written. {SHRINK}"
    if isinstance(error, OSError) and error.errno in _REFUSALS:
        path = "" if error.filename is None else f"{error.filename}: "
        advice = " Free space." if error.errno in _FULL else ""
        return f"{path}the system refuses ({error.strerror}); no result was written.{advice}"
    return None


@contextmanager
def _readable_warnings(output: Output) -> Iterator[None]:
    """Print warnings of the package as sentences, without a line of source; others as usual."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", PimperWarning)
        usual = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *args: Any, **rest: Any) -> None:  # noqa: ANN401
            if issubclass(category, PimperWarning):
                output.warning(str(message))
            elif output.shows("warning"):
                usual(message, category, *args, **rest)

        warnings.showwarning = show
        yield
