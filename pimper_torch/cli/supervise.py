"""The console's ``pimper``: a light process that watches the one that does the work.

What kills the work, as a system without memory does, leaves the watcher, which says so. It passes
on signals, and a second Ctrl-C ends the work at once. Where processes cannot be forked, as on
Windows, there is one process alone.
"""

import os
import signal
import sys
import time
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
NOTHING_YET = "interrupted; nothing was begun."

_Handler = Callable[[int, types.FrameType | None], Any] | int | None


class Stopped(KeyboardInterrupt):
    """The process was told to stop.

    Attributes:
        left: What is there now, for the message.
    """

    def __init__(self, number: int, left: str = "no result was written.") -> None:
        super().__init__(signal.Signals(number).name)
        self.number, self.left = number, left


def exit_code(error: BaseException) -> int:
    """Return the exit code of an interrupted command, as shells have it: 128 and the signal.

    >>> exit_code(Stopped(signal.SIGTERM)), exit_code(KeyboardInterrupt())
    (143, 130)
    """
    return 128 + (error.number if isinstance(error, Stopped) else signal.SIGINT)


def heed(handler: _Handler) -> dict[int, _Handler]:
    """Let a handler have the signals that stop a process, but for those that are ignored.

    Returns:
        The former handlers.
    """
    former: dict[int, _Handler] = {}
    for number in SIGNALS:
        current = signal.getsignal(number)
        if current is not signal.SIG_IGN:  # as by nohup, or in the background of a script
            former[number] = current
            signal.signal(number, handler)
    return former


def leave_at_once(number: int, frame: types.FrameType | None) -> None:
    """End a process in which nothing was begun, whatever it is importing."""
    for other in SIGNALS:
        signal.signal(other, signal.SIG_IGN)  # said once
    say(NOTHING_YET, 128 + number)
    os._exit(128 + number)


def say(text: str, code: int) -> None:
    """Report why a command ended, with nothing but the system's calls."""
    if "--json" in sys.argv:
        line = f'{{"event": "error", "kind": "Interrupted", "message": "{text}", '
        _write(sys.__stdout__, f'{line}"exit_code": {code}}}\n')
    _write(sys.__stderr__, f"error: {text}\n")


@contextmanager
def stoppable(repeat: bool = True) -> Iterator[None]:
    """Raise :class:`Stopped` in the block where a signal tells to stop.

    One that is raised where Python can only ignore it, as in a destructor, is raised again.

    Args:
        repeat: Whether a second signal raises again; else further ones are ignored for good.
    """
    told: list[int] = []

    def stop(number: int, frame: types.FrameType | None) -> None:
        if repeat or not told:
            told.append(number)
            raise Stopped(number)

    def lost(about: Any) -> None:  # noqa: ANN401 - `sys.UnraisableHookArgs` is none at run time
        if not isinstance(about.exc_value, Stopped):
            usual(about)
            return
        import threading

        told.clear()
        again = threading.Timer(0.05, os.kill, (os.getpid(), about.exc_value.number))
        again.daemon = True
        again.start()

    try:
        former = heed(stop)
    except ValueError:  # not in the main thread, where no signals arrive
        yield
        return
    usual, sys.unraisablehook = sys.unraisablehook, lost
    try:
        yield
    finally:
        sys.unraisablehook = usual
        for number, handler in former.items():
            signal.signal(number, signal.SIG_IGN if told and not repeat else handler)


def _write(stream: TextIO | None, text: str) -> None:
    if stream is not None:
        with suppress(OSError, ValueError):  # nobody listens
            os.write(stream.fileno(), text.encode())


def main() -> int:
    """Run the command line in a process of its own, and give its exit code.

    Returns:
        As :func:`pimper_torch.cli.main.main`; 128 and the number of the signal where the work was
        killed.
    """
    if not hasattr(os, "fork"):
        from pimper_torch.cli.main import main as carry_out

        return carry_out()
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by whoever started this
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115, PTH123 - for good
    heed(leave_at_once)
    said = os.memfd_create("pimper") if sys.platform == "linux" else None
    hears, tells = os.pipe()
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    watcher = os.getpid()
    worker = os.fork()
    if worker == 0:
        return _work(watcher, said, tells)
    os.close(tells)
    watch = _Watch(worker=worker)
    heed(watch.heard)
    signal.signal(signal.SIGALRM, watch.waited)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    _, status = os.waitpid(worker, 0)  # signals are heard while this waits
    code = os.waitstatus_to_exitcode(status)
    if code == 0 or code > 128 or os.read(hears, 1):
        return code
    if watch.killed:
        code = 128 + watch.first
        say("ended at once; what is left in `.stages` is removed by the next run.", code)
        return code
    from pimper_torch.cli.deaths import tell_death

    return tell_death(code, _tail(said))


class _Watch:
    """State of the watcher.

    Attributes:
        first: Number of the first signal that told to stop; 0 before.
        killed: Whether the worker was ended at once.
    """

    def __init__(self, worker: int) -> None:
        self.worker, self.first, self.since, self.killed = worker, 0, 0.0, False

    def heard(self, number: int, frame: types.FrameType | None) -> None:
        """Pass a signal on; a second one ends the worker at once."""
        now = time.monotonic()
        # One press of Ctrl-C reaches both processes, one of them twice; nobody presses so fast.
        if self.first and now - self.since > 0.3:
            self.killed = True
            number = signal.SIGKILL
        elif not self.first:
            self.first, self.since = number, now
            signal.setitimer(signal.ITIMER_REAL, 2.0)
        with suppress(ProcessLookupError):  # it has just ended
            os.kill(self.worker, number)

    def waited(self, number: int, frame: types.FrameType | None) -> None:
        """Report that the worker is still busy with what cannot be interrupted."""
        with suppress(OSError):  # the terminal is closed
            os.write(2, b"stopping after this step; Ctrl-C again ends it at once.\n")


def _work(watcher: int, said: int | None, tells: int) -> int:
    """Carry out the command, and end when the watcher does."""
    die_with(watcher)
    heed(leave_at_once)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    if said is not None and "debug" not in sys.argv and "--log-level=debug" not in sys.argv:
        _keep_apart(said)
    from pimper_torch.cli.main import main as carry_out

    code = carry_out(supervised=True)
    os.write(tells, b".")  # it has told how it ended
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)  # nothing is left to stop
    if code > 128:  # interrupted: whoever waits does not wait for libraries to tidy up
        sys.stderr.flush()
        os._exit(code)
    return code


def die_with(watcher: int) -> None:
    """End this process when the watcher is killed, so that nobody works unwatched."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(1, signal.SIGKILL)
        if os.getppid() != watcher:  # killed already
            os._exit(128 + signal.SIGKILL)
        return
    import threading

    def look() -> None:
        while os.getppid() == watcher:
            time.sleep(1.0)
        os._exit(128 + signal.SIGKILL)

    threading.Thread(target=look, daemon=True).start()


def _keep_apart(said: int) -> None:
    """Send what native libraries say on standard error to a file, and keep Python's where it is.

    A crash writes there where every thread was.
    """
    import faulthandler

    shown = os.dup(2)
    os.dup2(said, 2)
    stream = open(  # noqa: SIM115, PTH123 - for good
        shown, "w", buffering=1, encoding=sys.stderr.encoding, errors="backslashreplace"
    )
    for name in ("stderr", "__stderr__"):
        setattr(sys, name, stream)
    faulthandler.enable(2)


def _tail(said: int | None) -> str:
    if said is None:
        return ""
    most = 100_000
    os.lseek(said, max(0, os.fstat(said).st_size - most), os.SEEK_SET)
    return os.read(said, most).decode("utf-8", "replace")
