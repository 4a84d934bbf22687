"""A hidden folder beside a folder of results, where the new result is filled until it is whole.

It holds ``new``, which is filled and then changes names with the former result; ``note.json``,
which says whose it is and how far it came; and a lock, so that what a killed run left is known.
"""

import json
import re
import secrets
import shutil
import signal
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from types import FrameType
from typing import Any, Literal

from pimper_torch.errors import caution
from pimper_torch.outputs.exchange import exchange
from pimper_torch.outputs.marker import (
    MARKER,
    STAGES,
    flush_folder,
    read_marker,
    remove_written,
    tops,
    write_text,
)
from pimper_torch.outputs.stages import LOCK, is_ours, kept, link_lock, move_kept

READY = "ready"
"""In the folder of kept stages: a whole result that waits to be moved to its place."""

_PREFIX = ".pimper-"
_NAME = re.compile(r"\.pimper-[0-9a-f]{8}")
_NOTE, _FORMAT = "note.json", "pimper_torch workspace"
_BARE_S = 60.0
_State = Literal["filling", "replacing"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Workspace:
    """Where a result is filled.

    Attributes:
        folder: Hidden, beside the target or in its folder of kept stages.
        target: Where the result goes.
    """

    folder: Path
    target: Path

    @property
    def new(self) -> Path:
        """What is filled."""
        return self.folder / "new"

    @property
    def spare(self) -> Path:
        """The former result, for a moment, where names cannot be changed at once."""
        return self.folder / "spare"


@contextmanager
def workspace(target: Path) -> Iterator[Workspace]:
    """Make a workspace for a target that this process has locked; nothing of it stays behind.

    Raises:
        OSError: It can be made neither beside the target nor in it.
    """
    from filelock import FileLock

    space = Workspace(folder=_made(target), target=target)
    lock = FileLock(space.folder / LOCK, thread_local=False)
    try:
        _note(space, "filling")
        with suppress(NotImplementedError, OSError):  # a disk without locks
            lock.acquire()
        space.new.mkdir()
        with suppress(OSError):
            space.new.chmod(stat.S_IMODE(target.stat().st_mode))
        yield space
    finally:
        with undisturbed():
            _discard(space)
            lock.release()


def put_in_place(space: Workspace) -> None:
    """Put a filled and sealed folder in the place of the target.

    Both change their names at once, with all that is kept for the next run. A target that cannot
    be renamed, such as a mount point, or the folder where the process is, is filled entry by entry;
    :func:`finish` goes on where that was cut off.

    Raises:
        OSError: The disk refuses.
    """
    target = space.target
    with undisturbed():
        if _can_be_renamed(space):
            link_lock(target, space.new)
            _note(space, "replacing")
            try:
                exchange(target, space.new, space.spare)
            except OSError:
                shutil.rmtree(space.new / STAGES)
                _note(space, "filling")
            else:
                with suppress(OSError):  # or what is kept is moved one by one at the end
                    exchange(target / STAGES, space.new / STAGES, space.folder / "stages")
                flush_folder(target)
                flush_folder(target.parent)
                return
        _make_ready(space)
        finish(target)


def put_aside(space: Workspace) -> Path:
    """Put a filled folder beside the target, under the next name that is free.

    Raises:
        OSError: The disk refuses.
    """
    names = (space.target.with_name(f"{space.target.name}-{number}") for number in count(2))
    free = next(path for path in names if not path.exists() and not path.is_symlink())
    space.new.rename(free)
    return free


def finish(target: Path) -> None:
    """Move a result that waits in the folder of kept stages to its place, if there is one.

    Raises:
        OSError: The disk refuses, or a file that we did not write is in the way.
    """
    ready = target / STAGES / READY
    fresh, former = read_marker(ready), read_marker(target)
    if fresh is not None:
        waiting = {path.name for path in ready.iterdir()}
        if former is not None:
            for name in sorted(tops(former)):
                if name in waiting or name not in tops(fresh):
                    remove_written(target, former, name)
        for name in sorted(waiting - {MARKER}):
            (ready / name).rename(target / name)
        (ready / MARKER).replace(target / MARKER)
        flush_folder(target)
    if ready.is_dir():
        ready.rmdir()


def restore(target: Path) -> None:
    """Put a new result in its place where a run was killed when nothing was there."""
    for space in _spaces(target.parent, target):
        if not target.exists() and space.spare.is_dir() and _is_left(space):
            with suppress(OSError):
                space.new.rename(target)


def leftovers(target: Path) -> list[Path]:
    """List the workspaces that killed runs left, beside a target and in it."""
    return [
        space.folder
        for parent in (target.parent, target / STAGES)
        for space in _spaces(parent, target)
        if _is_left(space)
    ]


def remove_leftovers(target: Path) -> None:
    """Remove what killed runs left of a target that this process has locked.

    What they kept for the next run goes to its place.
    """
    for folder in leftovers(target):
        with suppress(OSError):
            _discard(Workspace(folder=folder, target=target))
    for parent in (target.parent, target / STAGES):
        _remove_bare(parent)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Let signals that stop the process wait until the block ends.

    Blocking them would not do: another thread would receive them.
    """
    waiting: list[int] = []

    def later(number: int, frame: FrameType | None) -> None:
        waiting.append(number)

    former = {}
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            if callable(handler):
                former[number] = signal.signal(number, later)
    except ValueError:  # not in the main thread, where no signals arrive
        yield
        return
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
        for told in waiting[:1]:
            signal.raise_signal(told)


def _made(target: Path) -> Path:
    """Make the folder beside the target, or in it where nothing may be made beside."""
    name = _PREFIX + secrets.token_hex(4)
    try:
        (target.parent / name).mkdir()
    except PermissionError:
        (target / STAGES / name).mkdir()
        return target / STAGES / name
    return target.parent / name


def _can_be_renamed(space: Workspace) -> bool:
    """Whether the target may get another name, with no process of ours left in the old one."""
    target = space.target
    if space.folder.parent != target.parent or target.is_mount():
        return False
    with suppress(OSError):  # the folder where the process is may have been removed
        here = Path.cwd()
        return not any(one.samefile(target) for one in (here, *here.parents))
    return True


def _make_ready(space: Workspace) -> None:
    ready = space.target / STAGES / READY
    try:
        space.new.rename(ready)
    except OSError:  # on another disk
        near = space.target / STAGES / f"{_PREFIX}{secrets.token_hex(4)}"
        try:
            shutil.copytree(space.new, near)
            near.rename(ready)
        except BaseException:
            shutil.rmtree(near, ignore_errors=True)
            raise
    flush_folder(space.target / STAGES)


def _discard(space: Workspace) -> None:
    """Remove a workspace: what was filled, and of a former result what its list names."""
    state = _read_note(space)
    for part in (space.new, space.spare):
        if part.is_symlink() or not part.is_dir():
            continue
        with suppress(OSError):
            move_kept(part, space.target)
        marker = read_marker(part)
        if state == "filling":
            shutil.rmtree(part, ignore_errors=True)
            continue
        if marker is not None:
            remove_written(part, marker)
        if is_ours(part / STAGES) and not kept(part):
            shutil.rmtree(part / STAGES, ignore_errors=True)
        if {path.name for path in part.iterdir()} <= {MARKER}:
            shutil.rmtree(part, ignore_errors=True)
        else:
            caution(
                f"{part}: holds files that came into {space.target} while it was replaced. "
                "Move them, and remove that folder."
            )
            return
    for name in (_NOTE, LOCK):
        (space.folder / name).unlink(missing_ok=True)
    with suppress(OSError):
        space.folder.rmdir()


def _spaces(parent: Path, target: Path) -> Iterator[Workspace]:
    """Find the workspaces of a target."""
    try:
        found = sorted(path for path in parent.iterdir() if _NAME.fullmatch(path.name))
    except OSError:
        return
    for folder in found:
        space = Workspace(folder=folder, target=target)
        if not folder.is_symlink() and folder.is_dir() and _read_note(space) is not None:
            yield space


def _remove_bare(parent: Path) -> None:
    """Remove the folders of runs that were killed before they noted whose they are."""
    with suppress(OSError):
        for folder in parent.iterdir():
            if (
                _NAME.fullmatch(folder.name)
                and time.time() - folder.lstat().st_mtime > _BARE_S
                and {path.name for path in folder.iterdir()} <= {f"{_NOTE}.new", LOCK}
            ):
                shutil.rmtree(folder)


def _is_left(space: Workspace) -> bool:
    """Whether no process fills a workspace."""
    from filelock import FileLock, Timeout

    lock = FileLock(space.folder / LOCK, timeout=0, thread_local=False)
    try:
        lock.acquire()
    except (Timeout, RuntimeError, NotImplementedError, OSError):
        return False
    lock.release()
    return True


def _note(space: Workspace, state: _State) -> None:
    about = {"format": _FORMAT, "of": space.target.name, "state": state}
    write_text(space.folder / _NOTE, json.dumps(about) + "\n")


def _read_note(space: Workspace) -> _State | None:
    """Read how far a workspace came; ``None`` where it is none, or another target's."""
    about: Any = None
    with suppress(OSError, ValueError, RecursionError):
        about = json.loads((space.folder / _NOTE).read_text(encoding="utf-8"))
    if not isinstance(about, dict) or about.get("format") != _FORMAT:
        return None
    if about.get("of") != space.target.name:
        return None
    state = about.get("state")
    return "filling" if state == "filling" else "replacing" if state == "replacing" else None
