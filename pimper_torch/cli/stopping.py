"""Signals that stop a command, raised as exceptions."""

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


watcher: int | None = None
"""Process that passes signals on to this one, if there is one."""


def taken_up() -> None:
    """Tell the watcher that a signal was handled: the next one counts as the first."""
    if watcher is not None:
        os.kill(watcher, signal.SIGUSR1)


class Stopped(KeyboardInterrupt):
    """Exception for a signal that stops the process.

    Attributes:
        left: Sentence about the results that exist, for the message.
    """

    def __init__(self, number: int, left: str = "no result was written.") -> None:
        super().__init__(signal.Signals(number).name)
        self.number, self.left = number, left


def exit_code(error: BaseException) -> int:
    """Return the exit code of an interrupted command, as in shells: 128 plus the signal's number.

    >>> exit_code(Stopped(signal.SIGTERM)), exit_code(KeyboardInterrupt())
    (143, 130)
    """
    return 128 + (error.number if isinstance(error, Stopped) else signal.SIGINT)


@contextmanager
def stoppable() -> Iterator[None]:
    """Raise :class:`Stopped` in the block on signals to stop; ignored signals stay ignored.

    An exception raised where Python must ignore it, such as in a destructor, is raised again.
    """
    latest = 0.0

    def stop(number: int, frame: types.FrameType | None) -> None:
        nonlocal latest
        before, latest = latest, time.monotonic()
        if latest - before > 1.0:  # the terminal and the watcher both send one press of Ctrl-C
            raise Stopped(number)

    def resend(args: Any) -> None:  # noqa: ANN401 - `sys.UnraisableHookArgs` is for type stubs only
        nonlocal latest
        if not isinstance(args.exc_value, Stopped):
            usual(args)
            return
        latest = 0.0
        again = threading.Timer(0.05, os.kill, (os.getpid(), args.exc_value.number))
        again.daemon = True
        again.start()

    try:
        former = {
            number: signal.signal(number, stop)
            for number in SIGNALS
            if signal.getsignal(number) is not signal.SIG_IGN  # for example by nohup
        }
    except ValueError:  # other threads than the main one receive no signals
        yield
        return
    usual, sys.unraisablehook = sys.unraisablehook, resend
    try:
        if hasattr(signal, "pthread_sigmask"):  # pending signals are raised now
            signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        yield
    finally:
        sys.unraisablehook = usual
        for number, handler in former.items():
            signal.signal(number, handler)
