"""``pimper``: which command, and how it ends.

What takes long to import is imported when a command needs it.
"""

import difflib
import os
import signal
import sys
import types
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import TextIO

from pimper_torch.errors import PimperError, PimperWarning

_HELP = """\
usage: pimper reconstruct PHOTOS -o OUT [options]
       pimper demo [-o OUT] [options]
       pimper render SCENE -o OUT [options]
       pimper evaluate RESULT TRUTH [options]
       pimper bench [-o OUT] [options]
       pimper convert DATA -o OUT --source KIND --target KIND [options]
       pimper gamma PHOTOS [options]
       pimper --version

Photographs from many viewpoints under many unknown lights, to a dense surface with normals,
albedo and light.

  reconstruct   a folder of photographs
  demo          the photographs of a skull that come with the package
  render        photographs of a scene with known truth
  evaluate      a result against the truth
  bench         the table: scenes, presets and baselines
  convert       a data set of another layout, or to one
  gamma         the response of photographs from a fixed camera under several lights

`pimper COMMAND --help` tells every option, and every setting of every stage.
"""
# Where each is carried out, and where its arguments are read if that is elsewhere.
_COMMANDS = {
    "reconstruct": "pimper_torch.cli.run",
    "demo": "pimper_torch.cli.run",
    "render": "pimper_torch.evidence.cli.render",
    "evaluate": "pimper_torch.evidence.cli.evaluate",
    "bench": "pimper_torch.evidence.cli.bench",
    "convert": "pimper_torch.evidence.cli.convert",
    "gamma": "pimper_torch.single_view.cli.gamma",
}
_READERS = {"pimper_torch.cli.run": "pimper_torch.cli.options"}
_FAILED, _INTERRUPTED = 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        0; 2 for anything the user can correct, in one message; 130 when interrupted.
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
    if not given or given[0] in ("-h", "--help"):
        sys.stdout.write(_HELP)
        return 0 if given else _FAILED
    if given[0] == "--version":
        from pimper_torch.io.version import installed_version

        sys.stdout.write(f"pimper_torch {installed_version()}\n")
        return 0
    if given[0] not in _COMMANDS:
        near = difflib.get_close_matches(given[0], _COMMANDS, n=1)
        hint = f" Did you mean `{near[0]}`?" if near else ""
        _tell("error", f"there is no command `{given[0]}`.{hint} See `pimper --help`.")
        return _FAILED
    with _readable_warnings(), _terminable():
        return _run(given[0], given[1:])


def _run(command: str, arguments: list[str]) -> int:
    # Read when torch is loaded. Threads that spin while they wait take the processor from
    # those they wait for when the machine is busy, and many small steps then take ten times
    # as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Pages of 2 MB where the system has them: a fifth of the demo's time went into 4 kB ones.
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    home = _COMMANDS[command]
    try:
        _refuse_at_once(_READERS.get(home, home), command, arguments)
        module = import_module(home)
        module.run(command, arguments)
    except PimperError as error:
        _tell("error", str(error))
        return _FAILED
    except KeyboardInterrupt:
        _tell("error", "interrupted; nothing was written.")
        return _INTERRUPTED
    return 0


def _refuse_at_once(home: str, command: str, arguments: list[str]) -> None:
    """Answer ``--help``, and refuse arguments, before torch is loaded.

    Raises:
        PimperError: What ``checked`` of the command's module raises.
        SystemExit: As tyro does.
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


def _tell(kind: str, message: str) -> None:
    from rich.console import Console
    from rich.text import Text

    color = "bold red" if kind == "error" else "bold yellow"
    text = Text.assemble((f"{kind}: ", color), message)
    Console(stderr=True, soft_wrap=True).print(text)


@contextmanager
def _readable_warnings() -> Iterator[None]:
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
                _tell("warning", str(message))
            else:
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
