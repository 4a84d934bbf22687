"""Signals that stop a command, as errors that unwind it."""

import os
import signal
import sys
import threading
import time
import types
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


class Stopped(KeyboardInterrupt):
    """A signal to stop the process.

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


@contextmanager
def stoppable() -> Iterator[None]:
    """Raise :class:`Stopped` in the block at a signal to stop; one that is ignored stays so.

    One that is raised where Python can only ignore it, as in a destructor, is raised again.
    """
    latest = 0.0

    def stop(number: int, frame: types.FrameType | None) -> None:
        nonlocal latest
        before, latest = latest, time.monotonic()
        if latest - before > 1.0:  # one press of Ctrl-C comes from the terminal and the watcher
            raise Stopped(number)

    def lost(about: Any) -> None:  # noqa: ANN401 - `sys.UnraisableHookArgs` is none at run time
        nonlocal latest
        if not isinstance(about.exc_value, Stopped):
            usual(about)
            return
        latest = 0.0
        again = threading.Timer(0.05, os.kill, (os.getpid(), about.exc_value.number))
        again.daemon = True
        again.start()

    try:
        former = {
            number: signal.signal(number, stop)
            for number in SIGNALS
            if signal.getsignal(number) is not signal.SIG_IGN  # as by nohup
        }
    except ValueError:  # not in the main thread, where no signals arrive
        yield
        return
    usual, sys.unraisablehook = sys.unraisablehook, lost
    try:
        if hasattr(signal, "pthread_sigmask"):  # those that came meanwhile are raised now
            signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        yield
    finally:
        sys.unraisablehook = usual
        for number, handler in former.items():
            signal.signal(number, handler)
