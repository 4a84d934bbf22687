"""Folders of results: all of a result, or nothing, and nothing that somebody else put there.

A result is filled in ``.stages/new`` inside its folder, where the lock of the folder guards it. It
is whole when its list is there, the last file written. Then the former result's files are removed,
and those of the new one are renamed to their places, the list last: a folder with its list holds
a whole result. Where a run is killed in between, the next one goes on from there.
"""

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from pimper_torch.doors.result_folder.files import require_name
from pimper_torch.doors.result_folder.marker import (
    MARKER,
    STAGES,
    FileList,
    Kind,
    read_marker,
    seal,
    sort_out,
)
from pimper_torch.doors.result_folder.stages import NEW, is_ours, kept, locked, resumption
from pimper_torch.runtime.errors import InputError, OutputError, some

# What this run holds: what it calls may write there.
_held: ContextVar[frozenset[Path]] = ContextVar("held_outputs", default=frozenset())


def prepare_output(folder: Path | str, kind: Kind, overwrite: bool = False) -> None:
    """Check, before the work, that its result can be written; leaves no trace.

    Args:
        folder: New, or empty but for what a former run kept.
        overwrite: Replace a former result of that kind, if nothing but its own files is there, none
            of them changed since.
    """
    folder = Path(folder)
    require_name(folder.resolve(), OutputError)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; needed: a folder that is new or empty.")
    if os.path.lexists(folder / STAGES) and not is_ours(folder / STAGES):
        raise OutputError(f"{folder}: holds {STAGES}, which pimper did not make. Write elsewhere.")
    place = next(path for path in (folder.resolve(), *folder.resolve().parents) if path.exists())
    if not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
        raise OutputError(f"{folder}: cannot be written, as {place} refuses. Write elsewhere.")
    there = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    present = [name for name in there if name != STAGES]
    if not present:
        return
    if not overwrite:
        names = [name for name in present if name != MARKER] or present
        raise OutputError(
            f"{folder}: already holds {some(names)}; needed: a new or empty folder. Write "
            "elsewhere, or replace a former result by `--overwrite` (`overwrite=True`)."
        )
    lists = _lists(folder)
    if not lists:
        raise OutputError(
            f"{folder}: holds {some(present)}, but no list of what a former run wrote ({MARKER}), "
            "so it is not overwritten. Write elsewhere, or remove it yourself."
        )
    if others := {one.kind for one in lists} - {kind}:
        raise OutputError(
            f"{folder}: holds a {others.pop()}, and is not overwritten by a {kind}. Write "
            "elsewhere."
        )
    _require_ours(folder, lists)


@contextmanager
def held_output(folder: Path | str, kind: Kind, *, overwrite: bool = False) -> Iterator[Path]:
    """Hold a folder of results for a run: no other run writes there.

    What a killed run left is removed, or put in its place where it was whole. A folder that was
    made for the block, and in which nothing was kept or written, is removed at its end. A block
    inside another block is part of it.

    Yields:
        The folder, without links.

    Raises:
        OutputError: As :func:`prepare_output`, or another run holds the folder.
    """
    folder = Path(folder)
    prepare_output(folder, kind, overwrite)
    target = folder.resolve()
    if target in _held.get():
        yield target
        return
    made = [path for path in (target, *target.parents) if not path.exists()]
    try:
        with locked(target, folder):
            with _refused_by_the_disk(folder):
                put_in_place(target)
            prepare_output(folder, kind, overwrite)
            token = _held.set(_held.get() | {target})
            try:
                yield target
            except BaseException as error:
                if kept(target):
                    error.add_note(resumption(folder))
                raise
            finally:
                _held.reset(token)
    finally:
        for path in made:
            with suppress(OSError):  # something was written or kept
                path.rmdir()


@contextmanager
def written_whole(folder: Path | str, kind: Kind, *, overwrite: bool = False) -> Iterator[Path]:
    """Return a folder to fill, which becomes the result in ``folder`` when all went well.

    A former result is replaced only when the new one is complete and on the disk. What a run kept
    for the next one stays.

    Args:
        folder: New, or empty but for what a former run kept; its parents are made.

    Raises:
        OutputError: As :func:`held_output`, or the disk refuses on the way; then nothing stays
            behind.
    """
    folder = Path(folder)
    with held_output(folder, kind, overwrite=overwrite) as target, _refused_by_the_disk(folder):
        new = target / STAGES / NEW
        new.mkdir()
        try:
            yield new
            seal(new, kind)
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)
            raise
        try:
            put_in_place(target)
        except OutputError as error:  # somebody wrote there meanwhile
            raise OutputError(f"{error} The new result is in {new}.") from error


def put_in_place(target: Path) -> None:
    """Put a whole result that waits in the folder of kept stages in its place; remove half a one.

    Goes on where it was cut off: the list of the former result is set aside first, so that the
    folder is no result until the new one's list comes as the last file.

    Args:
        target: A folder that this process has locked.

    Raises:
        OutputError: Files that we did not write are there; nothing is changed then.
    """
    stages = target / STAGES
    new = stages / NEW
    if read_marker(new) is not None:
        _require_ours(target, _lists(target))
        if (target / MARKER).exists():
            (target / MARKER).replace(stages / MARKER)
        former = read_marker(stages)
        for path in sort_out(target, former)[0] if former else ():
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
    """Refuse inputs in the folder of the result, which would be replaced with it.

    Args:
        inputs: By what they are called. Links are followed.
    """
    target = Path(folder).resolve()
    for name, path in inputs.items():
        if path is not None and path.resolve().is_relative_to(target):
            raise InputError(
                f"{folder}: {name} ({path}) lies in the folder of the result, which is replaced as "
                "a whole. Write elsewhere, or move it."
            )


@contextmanager
def _refused_by_the_disk(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{folder}: writing failed ({error}); what was there before is there still. Make room "
            "or write elsewhere."
        ) from error


def _lists(folder: Path) -> list[FileList]:
    """Read the list of a result, or those of one that a new one is replacing, and of the new."""
    whole = read_marker(folder)
    places = (folder / STAGES, folder / STAGES / NEW) if whole is None else ()
    return [one for one in (whole, *map(read_marker, places)) if one is not None]


def _require_ours(folder: Path, lists: list[FileList]) -> None:
    _, strangers = sort_out(folder, *lists)
    if strangers:
        raise OutputError(
            f"{folder}: holds {some(strangers)}, which is no part of a result, so it is not "
            "overwritten. Write elsewhere, or move it away."
        )


def require_cleanable(folder: Path | str) -> None:
    """Refuse a folder in which there is nothing of ours."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; needed: the folder of a result.")
    stages = folder / STAGES
    if not (is_ours(stages) and any(stages.iterdir())) and read_marker(folder) is None:
        found = "nothing that pimper wrote" if folder.exists() else "nothing"
        raise OutputError(
            f"{folder}: found {found}; needed: the folder that was given as `-o OUT` to a run."
        )


def clean_output(folder: Path | str) -> int:
    """Remove what is kept in a folder for the next run into it, and what killed runs left there.

    A result stays. One whose writing was cut off when it was whole is brought to its place.

    Raises:
        OutputError: It holds nothing of ours, another run holds it, or the disk refuses.
    """
    folder = Path(folder)
    require_cleanable(folder)
    target = folder.resolve()
    if not is_ours(target / STAGES):
        return 0
    try:
        with locked(target, folder):
            before = _size(target)
            put_in_place(target)
            for path in kept(target):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            return before - _size(target)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be cleaned ({error}).") from error


def _size(folder: Path) -> int:
    """Count the bytes of files in a folder; no link is followed."""
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file())
