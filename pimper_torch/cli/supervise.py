"""The console's ``pimper``: a small process that supervises the worker process.

If the worker is killed, for example because memory ran out, the watcher survives and reports it.
The watcher also passes on signals, which a long library call does not handle: a worker that has not
ended a few seconds after SIGTERM or SIGHUP is killed; a second Ctrl-C kills it immediately, unless
the worker has taken up the first. Without ``fork``, as on Windows, there is only one process.
"""

import ctypes
import faulthandler
import os
import signal
import sys
import threading
import time
import types
from contextlib import suppress

from pimper_torch.cli import stopping
from pimper_torch.cli.stopping import SIGNALS
from pimper_torch.runtime.scratch import remove_scratch

SHRINK = (
    "Shrink the photographs (`--max-size-px`), close other programs, or set a limit that is "
    "checked early (`--max-memory`)."
)
_CONTINUES = "No result was written; the same command continues after the last finished stage."
# Chosen so that every command ends within five seconds of SIGTERM.
_PATIENCE_SECONDS = 4.0


def main() -> int:
    """Run the command line in a separate process, and return its exit code.

    Returns:
        As for :func:`pimper_torch.cli.main.main`; 128 plus the signal that killed the worker.
    """
    if not hasattr(os, "fork"):
        return _run()
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    watcher, worker = os.getpid(), os.fork()

    first: list[tuple[float, int]] = []

    def handle(number: int, frame: types.FrameType | None) -> None:
        if worker == 0:  # `stoppable` stops the worker; after that block, it ends soon
            return
        if not first:
            first.append((time.monotonic(), number))
            signal.setitimer(signal.ITIMER_REAL, _PATIENCE_SECONDS)
        late = number == signal.SIGALRM
        # One press of Ctrl-C may arrive twice within a moment; a second press takes longer.
        again = late or time.monotonic() - first[0][0] > 0.2
        with suppress(OSError):  # the worker has just ended, or stderr is closed
            if late and first[0][1] == signal.SIGINT:
                os.write(2, b"It stops after this step; a second Ctrl-C stops it immediately.\n")
            else:
                os.kill(worker, signal.SIGKILL if again else number)

    def forget(number: int, frame: types.FrameType | None) -> None:
        first.clear()
        signal.setitimer(signal.ITIMER_REAL, 0)

    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:  # for example by nohup
            signal.signal(number, handle)
    if worker == 0:
        stopping.watcher = watcher
        exit_with_parent(watcher)
        faulthandler.enable()  # a crash prints the stacks of all threads
        code = _run()  # signals stay blocked until they can be raised
        if code > 128:  # interrupted: do not wait for the cleanup of libraries
            sys.stderr.flush()
            os._exit(code)
        return code
    signal.signal(signal.SIGALRM, handle)
    signal.signal(signal.SIGUSR1, forget)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    _, status = os.waitpid(worker, 0)  # signals are handled meanwhile
    signal.setitimer(signal.ITIMER_REAL, 0)
    ended = os.waitstatus_to_exitcode(status)
    if ended >= 0:
        return ended
    from pimper_torch.cli.output import Output

    remove_scratch()
    kind, text = "Killed", f"{what_killed(ended)} {SHRINK}"
    if first:
        ended, kind, text = -first[0][1], "Interrupted", "killed, as it did not stop in time."
    Output(as_json="--json" in sys.argv).error(kind, f"{text} {_CONTINUES}", 128 - ended)
    return 128 - ended


def _run() -> int:
    from pimper_torch.cli.main import main as run

    return run()


def exit_with_parent(watcher: int) -> None:
    """End this process when the watcher is killed."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)
        if os.getppid() != watcher:  # it was already killed
            os._exit(128 + signal.SIGKILL)
        return

    def look() -> None:
        while os.getppid() == watcher:
            time.sleep(1.0)
        os._exit(128 + signal.SIGKILL)

    threading.Thread(target=look, daemon=True).start()


def what_killed(ended: int) -> str:
    """Return a sentence about a process that ended without a message.

    Args:
        ended: Its exit code; or the negative number of the signal that killed it.
    """
    if ended == -signal.SIGKILL:
        return (
            "the run was killed by the system or by somebody (SIGKILL), most likely because memory "
            "ran out."
        )
    is_signal = -ended in {*signal.Signals}
    name = signal.Signals(-ended).name if is_signal else f"exit code {ended}"
    return f"the run crashed ({name}), most likely because memory ran out in a native library."
