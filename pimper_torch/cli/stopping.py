"""Stop of a process by Ctrl-C, a polite kill, or a closed terminal.

Loads nothing, so that it can be the first thing that a process does.
"""

import os
import signal
import sys
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
