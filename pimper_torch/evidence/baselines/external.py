"""External programs: find them, run them, report what went wrong."""

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pimper_torch.errors import MissingProgramError, ReconstructionError

_LAST_LINES = 15


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """An executable that a user may have.

    Attributes:
        name: As it is called on the command line.
        variable: Environment variable that may name it, or the folder it lies in.
        folders: Folders that its installer uses and that are seldom on the PATH.
    """

    name: str
    variable: str
    source: str
    folders: tuple[Path, ...] = ()

    def find(self) -> Path:
        """Find the executable: as the variable says, on the PATH, in its folders."""
        if self.variable in os.environ:
            named = Path(os.environ[self.variable])
            found = _executable(named / self.name if named.is_dir() else named)
            if found is None:
                raise MissingProgramError(
                    f"{self.name} is not installed at {named}, where {self.variable} says; "
                    f"needed: the executable, or the folder it lies in. {self._advice}"
                )
            return found
        on_path = shutil.which(self.name)
        if on_path is not None:
            return Path(on_path).absolute()
        for folder in self.folders:
            found = _executable(folder / self.name)
            if found is not None:
                return found
        raise MissingProgramError(
            f"{self.name} is not installed: it is neither on the PATH nor named by "
            f"{self.variable}. {self._advice}"
        )

    @property
    def _advice(self) -> str:
        return (
            f"Get it from {self.source}, or point {self.variable} to it, or leave this method out."
        )


def _executable(path: Path) -> Path | None:
    # Absolute, for it will run in another folder.
    return path.absolute() if path.is_file() and os.access(path, os.X_OK) else None


@dataclass(frozen=True, slots=True)
class Deadline:
    """A limit of time that several programs share."""

    minutes: float
    began: float = field(default_factory=time.monotonic)

    @property
    def seconds_left(self) -> float:
        """Time until then; negative after it."""
        return 60 * self.minutes - (time.monotonic() - self.began)


def run_program(
    command: Sequence[Path | str], folder: Path, deadline: Deadline, *, threads: int
) -> str:
    """Run a program in a folder, without a shell, and wait for it.

    It and all that it started are stopped at the deadline or when we are interrupted.

    Args:
        folder: Working directory. What the program prints is kept there too.

    Returns:
        What it printed.
    """
    name = Path(command[0]).name
    began = time.monotonic()
    with tempfile.NamedTemporaryFile(
        prefix=f"{name}-", suffix=".log", dir=folder, delete=False
    ) as log:
        try:
            process = subprocess.Popen(
                [str(part) for part in command],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                # COLMAP's Qt asks for a screen otherwise, which a server has not.
                env=os.environ | {"OMP_NUM_THREADS": str(threads), "QT_QPA_PLATFORM": "offscreen"},
                start_new_session=True,
            )
        except OSError as error:
            raise MissingProgramError(
                f"{command[0]} cannot be started ({error.strerror}); needed: an executable for "
                "this machine."
            ) from error
        try:
            status = process.wait(timeout=max(0.0, deadline.seconds_left))
        except subprocess.TimeoutExpired as error:
            _stop(process)
            raise ReconstructionError(
                f"{name} was stopped: {deadline.minutes:g} minutes are over. Raise `max_minutes`, "
                f"or work on smaller photographs.{last_lines(_text(Path(log.name)))}"
            ) from error
        except BaseException:
            _stop(process)
            raise
    printed = _text(Path(log.name))
    if status != 0:
        raise ReconstructionError(
            f"{name} failed after {time.monotonic() - began:.0f} s ({_ending(status)})."
            f"{last_lines(printed)}"
        )
    return printed


def last_lines(printed: str) -> str:
    """Quote the end of what a program printed, ready to follow a message."""
    lines = [line.rstrip() for line in printed.splitlines() if line.strip()][-_LAST_LINES:]
    if not lines:
        return " It printed nothing."
    return "".join(["\nIts last lines:", *(f"\n  {line}" for line in lines)])


def _stop(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")


def _ending(status: int) -> str:
    if status >= 0:
        return f"exit status {status}"
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = f"signal {-status}"
    often = "; often because memory ran out" if name == "SIGKILL" else ""
    return f"ended by {name}{often}"
