"""``pimper``: which command, and how it ends.

What takes long to import is imported when a command needs it.

Exit codes: 0 where the command did what it was asked for; 2 for what the user can correct, in one
paragraph; 130 when interrupted; 1 for anything unexpected, which is a fault of the package.
"""

import difflib
import os
import signal
import sys
import tempfile
import traceback
import types
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import TextIO

from pimper_torch.cli.output import Output, split
from pimper_torch.errors import PimperError, PimperWarning

_HELP = """\
usage: pimper reconstruct PHOTOS -o OUT [options]
       pimper doctor [PHOTOS] [options]
       pimper demo [-o OUT] [options]
       pimper config [NAME] [options]
       pimper render SCENE -o OUT [options]
       pimper evaluate RESULT TRUTH [options]
       pimper bench [-o OUT] [options]
       pimper convert DATA -o OUT --source KIND --target KIND [options]
       pimper gamma PHOTOS [options]
       pimper clean OUT
       pimper --version

Photographs from many viewpoints under many unknown lights, to a dense surface with normals,
albedo and light.

  reconstruct   a folder of photographs
  doctor        what is installed here, and what photographs are worth, before a run
  demo          the photographs of a skull that come with the package
  config        the settings of a preset and what they mean, or one of them
  render        photographs of a scene with known truth
  evaluate      a result against the truth
  bench         the table: scenes, presets and baselines
  convert       a data set of another layout, or to one
  gamma         the response of photographs from a fixed camera under several lights
  clean         what runs into a folder kept to go on from, and what killed runs left

`pimper COMMAND --help` tells the options, `--help-all` those of every stage, too.

Exit codes: 0 success, 2 bad input, 130 interrupted, 1 unexpected.
"""
# Where each is carried out, and where its arguments are read if that is elsewhere.
_COMMANDS = {
    "reconstruct": "pimper_torch.cli.run",
    "doctor": "pimper_torch.cli.doctor",
    "demo": "pimper_torch.cli.run",
    "config": "pimper_torch.cli.settings",
    "render": "pimper_torch.evidence.cli.render",
    "evaluate": "pimper_torch.evidence.cli.evaluate",
    "bench": "pimper_torch.evidence.cli.bench",
    "convert": "pimper_torch.evidence.cli.convert",
    "gamma": "pimper_torch.single_view.cli.gamma",
    "clean": "pimper_torch.cli.clean",
}
_READERS = {"pimper_torch.cli.run": "pimper_torch.cli.options"}
_LIGHT = ("config",)  # carried out without torch, too
_UNEXPECTED, _BAD_INPUT, _INTERRUPTED = 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        0 for success; 2 for anything the user can correct, in one paragraph; 130 when interrupted;
        1 for anything unexpected, whose traceback is kept in a file.
    """
    try:
        try:
            return _main(arguments)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # as of `pimper --help | head`: whoever reads has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # flushed again at exit
        return 0


def _main(arguments: Sequence[str] | None) -> int:
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] in ("-h", "--help", "--help-all"):
        sys.stdout.write(_HELP)
        return 0 if given else _BAD_INPUT
    if given[0] == "--version":
        from pimper_torch.io.version import versions

        sys.stdout.writelines(f"{name} {version}\n" for name, version in versions().items())
        return 0
    try:
        output, rest = split(given[1:])
    except PimperError as error:
        return _failed(Output(), error)
    if given[0] not in _COMMANDS:
        near = difflib.get_close_matches(given[0], _COMMANDS, n=1)
        hint = f" Did you mean `{near[0]}`?" if near else ""
        text = f"there is no command `{given[0]}`.{hint} See `pimper --help`."
        output.error("ConfigError", text, _BAD_INPUT)
        return _BAD_INPUT
    with _readable_warnings(output), _terminable():
        return _run(given[0], rest, output)


def _run(command: str, arguments: list[str], output: Output) -> int:
    # Read when torch is loaded. Threads that spin while they wait take the processor from
    # those they wait for when the machine is busy, and many small steps then take ten times
    # as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Pages of 2 MB where the system has them: a fifth of the demo's time went into 4 kB ones.
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    from pimper_torch.cli.light import light

    home = _COMMANDS[command]
    try:
        _refuse_at_once(_READERS.get(home, home), command, arguments)
        if output.as_json:
            from pimper_torch.io.version import versions

            output.event(
                "start", command=command, arguments=arguments, versions=versions(), format=1
            )
        run = light(home, "run") if command in _LIGHT else import_module(home).run
        run(command, arguments, output)
    except (Exception, KeyboardInterrupt) as error:
        return _failed(output, error)
    return 0


def _failed(output: Output, error: BaseException) -> int:
    """Tell why a command failed, and give its exit code."""
    kind = type(error).__name__
    if isinstance(error, BrokenPipeError):
        raise error
    if output.shows("debug"):
        traceback.print_exception(error)
    if isinstance(error, PimperError):
        output.error(kind, str(error), _BAD_INPUT)
        return _BAD_INPUT
    if isinstance(error, KeyboardInterrupt):
        output.error("Interrupted", "interrupted; nothing was written.", _INTERRUPTED)
        return _INTERRUPTED
    with tempfile.NamedTemporaryFile(
        "w", prefix="pimper-", suffix=".txt", delete=False, encoding="utf-8"
    ) as file:
        traceback.print_exception(error, file=file)
    text = (
        f"unexpected {kind}: {str(error).rstrip('.')}. This is a fault of pimper_torch; nothing "
        f"was written. {file.name} holds the traceback: please report it with `pimper --version`."
    )
    output.error(kind, text, _UNEXPECTED)
    return _UNEXPECTED


def _refuse_at_once(home: str, command: str, arguments: list[str]) -> None:
    """Answer ``--help``, and refuse arguments, before torch is loaded.

    Raises:
        PimperError: What ``checked`` of the command's module raises.
        SystemExit: ``--help`` was answered.
    """
    from pimper_torch.cli.light import light

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # shown when the arguments are read in earnest
            light(home, "checked")(command, arguments)
    except (PimperError, BrokenPipeError):
        raise
    except Exception:
        pass


@contextmanager
def _readable_warnings(output: Output) -> Iterator[None]:
    """Show our warnings as sentences, without a line of source; others as Python does."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", PimperWarning)
        usual = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if issubclass(category, PimperWarning):
                output.warning(str(message))
            elif output.shows("warning"):
                usual(message, category, filename, lineno, file, line)

        warnings.showwarning = show
        yield


@contextmanager
def _terminable() -> Iterator[None]:
    """Let a polite kill clean up as Ctrl-C does."""

    def interrupt(number: int, frame: types.FrameType | None) -> None:
        raise KeyboardInterrupt

    try:
        former = signal.signal(signal.SIGTERM, interrupt)
    except ValueError:  # not in the main thread, where no signals arrive
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, former)
