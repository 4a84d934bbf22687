"""Result folders: a complete result or none, and no file of others is removed.

A result is written to ``.stages/new`` inside its folder, guarded by the folder's lock. Its list of
files is written last and marks it as complete. Then the files of the previous result are removed,
and the new ones are renamed to their places, the list last: a folder with its list contains a
complete result. If a run is killed in between, the next one continues from there.
"""

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from pimper_torch.export.result_folder.files import require_name
from pimper_torch.export.result_folder.marker import (
    MARKER,
    STAGES,
    FileList,
    Kind,
    read_marker,
    seal,
    sort_out,
)
from pimper_torch.export.result_folder.stages import NEW, is_ours, kept_stages, locked, resumption
from pimper_torch.runtime.errors import InputError, OutputError, some

# Folders that this run has locked; nested blocks may write to them.
_held: ContextVar[frozenset[Path]] = ContextVar("held_outputs", default=frozenset())


def prepare_output(folder: Path | str, kind: Kind, overwrite: bool = False) -> None:
    """Check, before any work, that a result can be written; changes nothing on disk.

    Args:
        folder: New, or empty except for stages kept by a previous run.
        overwrite: Accept a previous result of the same kind, if the folder contains only its
            files and none was changed since.
    """
    folder = Path(folder)
    require_name(folder.resolve(), OutputError)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; needed: a new or empty folder.")
    if os.path.lexists(folder / STAGES) and not is_ours(folder / STAGES):
        raise OutputError(f"{folder}: {STAGES} in it is not from pimper. Write elsewhere.")
    parent = next(path for path in (folder.resolve(), *folder.resolve().parents) if path.exists())
    if not (parent.is_dir() and os.access(parent, os.W_OK | os.X_OK)):
        raise OutputError(
            f"{folder}: cannot be written, as {parent} is not a writable folder. Write elsewhere."
        )
    entries = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    present = [name for name in entries if name != STAGES]
    if not present:
        return
    if not overwrite:
        names = [name for name in present if name != MARKER] or present
        raise OutputError(
            f"{folder}: already contains {some(names)}; needed: a new or empty folder. Write "
            "elsewhere, or replace a previous result with `--overwrite` (`overwrite=True`)."
        )
    lists = _lists(folder)
    if not lists:
        raise OutputError(
            f"{folder}: contains {some(present)}, but not the list of files of a previous run "
            f"({MARKER}), so it is not overwritten. Write elsewhere, or remove it yourself."
        )
    if others := {files.kind for files in lists} - {kind}:
        raise OutputError(
            f"{folder}: contains a {others.pop()}, and is not overwritten by a {kind}. Write "
            "elsewhere."
        )
    _require_ours(folder, lists)


@contextmanager
def held_output(folder: Path | str, kind: Kind, *, overwrite: bool = False) -> Iterator[Path]:
    """Lock a result folder for a run, so that no other run writes to it.

    A result that a killed run left is installed if it was complete, else removed. A folder that was
    created for the block is removed at its end if nothing was kept or written in it. Nested blocks
    for the same folder share the lock.

    Yields:
        The folder, with links resolved.

    Raises:
        OutputError: As :func:`prepare_output`, or a different run has locked the folder.
    """
    folder = Path(folder)
    prepare_output(folder, kind, overwrite)
    target = folder.resolve()
    if target in _held.get():
        yield target
        return
    created = [path for path in (target, *target.parents) if not path.exists()]
    try:
        with locked(target, folder):
            with _disk_errors(folder):
                install_result(target)
            prepare_output(folder, kind, overwrite)
            token = _held.set(_held.get() | {target})
            try:
                yield target
            except BaseException as error:
                if kept_stages(target):
                    error.add_note(resumption(folder))
                raise
            finally:
                _held.reset(token)
    finally:
        for path in created:
            with suppress(OSError):  # not empty
                path.rmdir()


@contextmanager
def written_whole(folder: Path | str, kind: Kind, *, overwrite: bool = False) -> Iterator[Path]:
    """Yield an empty folder, which becomes the result in ``folder`` if the block succeeds.

    A previous result is replaced only when the new one is complete and on the disk. Stages kept for
    the next run stay.

    Args:
        folder: New, or empty except for stages kept by a previous run; its parents are created.

    Raises:
        OutputError: As :func:`held_output`, or writing failed; then no incomplete result remains.
    """
    folder = Path(folder)
    with held_output(folder, kind, overwrite=overwrite) as target, _disk_errors(folder):
        new = target / STAGES / NEW
        new.mkdir()
        try:
            yield new
            seal(new, kind)
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)
            raise
        try:
            install_result(target)
        except OutputError as error:  # other files were written there meanwhile
            raise OutputError(f"{error} The new result is in {new}.") from error


def install_result(target: Path) -> None:
    """Move a complete result from the folder of kept stages to its place; remove an incomplete one.

    An interrupted call is continued: the list of the previous result is set aside first, so the
    folder has no list, and thus no result, until the new list is moved as the last file.

    Args:
        target: A folder that this process has locked.

    Raises:
        OutputError: The folder contains files of others; then nothing is changed.
    """
    stages = target / STAGES
    new = stages / NEW
    if read_marker(new) is not None:
        _require_ours(target, _lists(target))
        if (target / MARKER).exists():
            (target / MARKER).replace(stages / MARKER)
        previous = read_marker(stages)
        for path in sort_out(target, previous)[0] if previous else ():
            if not path.is_dir():
                path.unlink()
            elif not any(path.iterdir()):
                path.rmdir()
        (stages / MARKER).unlink(missing_ok=True)
        for path in sorted(new.iterdir()):
            if path.name != MARKER:
                path.rename(target / path.name)
        (new / MARKER).rename(target / MARKER)
    if new.exists():
        shutil.rmtree(new)


def require_apart(folder: Path | str, inputs: Mapping[str, Path | None]) -> None:
    """Raise an error if an input is inside the result folder, and would be replaced with it.

    Args:
        inputs: Paths by name or option. Links are followed.
    """
    target = Path(folder).resolve()
    for name, path in inputs.items():
        if path is not None and path.resolve().is_relative_to(target):
            raise InputError(
                f"{folder}: {name} ({path}) is inside the result folder, which is replaced as a "
                "whole. Write elsewhere, or move it."
            )


@contextmanager
def _disk_errors(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{folder}: writing failed ({error}); its previous content is unchanged. Free space, "
            "or write elsewhere."
        ) from error


def _lists(folder: Path) -> list[FileList]:
    """Read the list of a result, or, while it is being replaced, those of the old and new one."""
    complete = read_marker(folder)
    folders = (folder / STAGES, folder / STAGES / NEW) if complete is None else ()
    return [files for files in (complete, *map(read_marker, folders)) if files is not None]


def _require_ours(folder: Path, lists: list[FileList]) -> None:
    _, others = sort_out(folder, *lists)
    if others:
        raise OutputError(
            f"{folder}: contains {some(others)}, not part of a result, so it is not overwritten. "
            "Write elsewhere, or move these away."
        )


def require_cleanable(folder: Path | str) -> None:
    """Raise an error unless a folder contains a result or kept stages."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; needed: the folder `-o OUT` of a run.")
    stages = folder / STAGES
    if not (is_ours(stages) and any(stages.iterdir())) and read_marker(folder) is None:
        found = "nothing that pimper wrote" if folder.exists() else "nothing"
        raise OutputError(f"{folder}: found {found}; needed: the folder `-o OUT` of a run.")


def clean_output(folder: Path | str) -> int:
    """Remove kept stages and leftovers of killed runs, and return the freed bytes.

    A result stays. A complete result that a killed run did not install is installed.

    Raises:
        OutputError: It has neither a result nor stages, a different run has locked it, or it
            cannot be changed.
    """
    folder = Path(folder)
    require_cleanable(folder)
    target = folder.resolve()
    if not is_ours(target / STAGES):
        return 0
    try:
        with locked(target, folder):
            before = _size(target)
            install_result(target)
            for path in kept_stages(target):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            return before - _size(target)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be cleaned ({error}).") from error


def _size(folder: Path) -> int:
    """Sum the bytes of files in a folder, without following links."""
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file())
