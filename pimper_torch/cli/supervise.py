"""The console's ``pimper``: a light process that watches the one that does the work.

What kills the work, as a system without memory does, leaves the watcher, which says so. It passes
on signals to stop, which a long call of a library does not hear: work that has not ended a few
seconds after SIGTERM or SIGHUP is killed, and so it is at once by a second Ctrl-C. Where processes
cannot be forked, as on Windows, there is one process alone.
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

from pimper_torch.cli.stopping import SIGNALS
from pimper_torch.runtime.scratch import remove_scratch

_SHRINK = (
    "Shrink the photographs (`--max-size-px`), close other programs, or give `--max-memory` to be "
    "told before the surface takes too much."
)
_GOES_ON = "No result was written; the same command goes on from what stages finished."
# A choice: with it every command ends within five seconds of SIGTERM.
_PATIENCE_SECONDS = 4.0


def main() -> int:
    """Run the command line in a process of its own, and give its exit code.

    Returns:
        As :func:`pimper_torch.cli.main.main`; 128 and the number of the signal where the work was
        killed.
    """
    if not hasattr(os, "fork"):
        return _carry_out()
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    watcher, worker = os.getpid(), os.fork()

    first: list[tuple[float, int]] = []

    def heard(number: int, frame: types.FrameType | None) -> None:
        if worker == 0:  # which `stoppable` stops; behind it, its end is near
            return
        if not first:
            first.append((time.monotonic(), number))
            signal.setitimer(signal.ITIMER_REAL, _PATIENCE_SECONDS)
        late = number == signal.SIGALRM
        # The first press of Ctrl-C may reach both processes; nobody presses again so fast.
        again = late or time.monotonic() - first[0][0] > 0.2
        with suppress(OSError):  # it has just ended, or nobody reads
            if late and first[0][1] == signal.SIGINT:
                os.write(2, b"It ends after this step; a second Ctrl-C ends it at once.\n")
            else:
                os.kill(worker, signal.SIGKILL if again else number)

    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:  # as by nohup
            signal.signal(number, heard)
    if worker == 0:
        exit_with_parent(watcher)
        faulthandler.enable()  # a crash writes where every thread was
        code = _carry_out()  # signals wait until they can be raised
        if code > 128:  # interrupted: whoever waits does not wait for libraries to tidy up
            sys.stderr.flush()
            os._exit(code)
        return code
    signal.signal(signal.SIGALRM, heard)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    _, status = os.waitpid(worker, 0)  # signals are heard while this waits
    signal.setitimer(signal.ITIMER_REAL, 0)
    ended = os.waitstatus_to_exitcode(status)
    if ended >= 0:
        return ended
    from pimper_torch.cli.crash_report import what_killed
    from pimper_torch.cli.output import Output

    remove_scratch()
    output = Output(as_json="--json" in sys.argv)
    if first:
        ended = -first[0][1]
        output.error("Interrupted", f"killed, as it did not end by itself. {_GOES_ON}", 128 - ended)
    else:
        output.error("Killed", f"{what_killed(ended)} {_SHRINK} {_GOES_ON}", 128 - ended)
    return 128 - ended


def _carry_out() -> int:
    from pimper_torch.cli.main import main as carry_out

    return carry_out()


def exit_with_parent(watcher: int) -> None:
    """End this process when the watcher is killed, so that nobody works unwatched."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)
        if os.getppid() != watcher:  # killed already
            os._exit(128 + signal.SIGKILL)
        return

    def look() -> None:
        while os.getppid() == watcher:
            time.sleep(1.0)
        os._exit(128 + signal.SIGKILL)

    threading.Thread(target=look, daemon=True).start()
