"""Folders of results: all of a result, or nothing, and nothing that somebody else put there."""

import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from pimper_torch.errors import InputError, OutputError, some
from pimper_torch.outputs.marker import MARKER, STAGES, Kind, foreign, read_marker, seal
from pimper_torch.outputs.names import require_name
from pimper_torch.outputs.stages import is_ours, kept, locked
from pimper_torch.outputs.workspace import (
    READY,
    finish,
    put_aside,
    put_in_place,
    remove_leftovers,
    restore,
    workspace,
)

# What this run holds: what it calls may write there.
_held: ContextVar[frozenset[Path]] = ContextVar("held_outputs", default=frozenset())


def prepare_output(folder: Path | str, kind: Kind, overwrite: bool = False) -> None:
    """Check, before the work, that its result can be written; leaves no trace.

    Args:
        folder: New, or empty but for what a former run kept.
        overwrite: Replace a former result of that kind, if nothing but its own files is there, as
            they were written.

    Raises:
        OutputError: The folder already holds something, is a file, or cannot be made.
    """
    folder = Path(folder)
    require_name(folder.resolve(), OutputError)
    if folder.is_symlink() and not folder.exists():
        raise OutputError(f"{folder}: is a link to nothing. Remove it, or write elsewhere.")
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; needed: a folder that is new or empty.")
    try:
        present = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    except OSError as error:
        raise OutputError(f"{folder}: cannot be listed ({error.strerror}).") from error
    if STAGES in present:
        present.remove(STAGES)
        if not is_ours(folder / STAGES):
            raise OutputError(
                f"{folder}: holds {STAGES}, which pimper did not make. Write elsewhere."
            )
    if present and not overwrite:
        names = [name for name in present if name != MARKER] or present
        raise OutputError(
            f"{folder}: already holds {some(names)}; needed: a new or empty folder. Write "
            "elsewhere, or replace a former result by `--overwrite` (`overwrite=True`)."
        )
    if present:
        _require_replaceable(folder, kind, present)
    _require_writable(folder)


@contextmanager
def held_output(folder: Path | str, kind: Kind, *, overwrite: bool = False) -> Iterator[Path]:
    """Hold a folder of results for a run: no other run writes there.

    What killed runs left is removed. A folder that was made for the block, and in which nothing
    was kept or written, is removed at its end. A block inside another one is part of it.

    Args:
        folder: Its parents are made.
        overwrite: As of :func:`prepare_output`.

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
        with _refused_by_the_disk(folder):
            restore(target)
            target.parent.mkdir(parents=True, exist_ok=True)
        with locked(target, folder):
            with _refused_by_the_disk(folder):
                remove_leftovers(target)
                finish(target)
            prepare_output(folder, kind, overwrite)
            token = _held.set(_held.get() | {target})
            try:
                yield target
            except BaseException as error:
                if kept(target):
                    error.add_note(
                        f"What was finished is kept in {folder / STAGES}: the same command goes "
                        f"on from there, and `pimper clean {folder}` removes it."
                    )
                raise
            finally:
                _held.reset(token)
    finally:
        for path in made:
            with suppress(OSError):  # something was written or kept
                path.rmdir()


@contextmanager
def written_whole(folder: Path | str, kind: Kind, *, overwrite: bool = False) -> Iterator[Path]:
    """Return a folder to fill, which takes the place of ``folder`` when all went well.

    It lies beside ``folder``: a folder that is there is whole, and a former result is replaced
    only when the new one is complete and on the disk. What a run kept for the next one stays; see
    :func:`pimper_torch.outputs.workspace.put_in_place`.

    Args:
        folder: New, or empty but for what a former run kept; its parents are made.
        overwrite: Replace a former result of that kind.

    Raises:
        OutputError: As :func:`held_output`, or the disk refuses on the way; then nothing stays
            behind.
    """
    folder = Path(folder)
    with (
        held_output(folder, kind, overwrite=overwrite) as target,
        _refused_by_the_disk(folder),
        workspace(target) as space,
    ):
        yield space.new
        seal(space.new, kind)
        try:
            prepare_output(folder, kind, overwrite)
        except OutputError as error:  # somebody wrote there meanwhile
            raise OutputError(f"{error} The new result is in {put_aside(space)}.") from error
        put_in_place(space)


def require_apart(folder: Path | str, inputs: Mapping[str, Path | None]) -> None:
    """Refuse inputs in the folder of the result, which would be replaced with it.

    Args:
        inputs: By what they are called. Links are followed.

    Raises:
        InputError: One is the folder, or lies in it.
    """
    target = Path(folder).resolve()
    for name, path in inputs.items():
        if path is None:
            continue
        whole = path.resolve()
        for one in (whole, *whole.parents):
            if one == target or (one.exists() and target.exists() and one.samefile(target)):
                raise InputError(
                    f"{folder}: {name} ({path}) lies in the folder of the result, which is "
                    "replaced as a whole. Write elsewhere, or move it."
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


def _require_replaceable(folder: Path, kind: Kind, present: list[str]) -> None:
    markers = [
        marker
        for marker in map(read_marker, (folder, folder / STAGES / READY))
        if marker is not None
    ]
    if not markers:
        raise OutputError(
            f"{folder}: holds {some(present)}, but no list of what a former run wrote ({MARKER}), "
            "so it is not overwritten. Write elsewhere, or remove it yourself."
        )
    others = [marker.kind for marker in markers if marker.kind != kind]
    if others:
        raise OutputError(
            f"{folder}: holds a {others[0]}, and is not overwritten by a {kind}. Write elsewhere."
        )
    strangers = foreign(folder, *markers)
    if strangers:
        raise OutputError(
            f"{folder}: holds {some(strangers)}, which is no part of a result, so it is not "
            "overwritten. Write elsewhere, or move it away."
        )


def _require_writable(folder: Path) -> None:
    parent = folder.resolve().parent
    while not parent.exists():
        parent = parent.parent
    # A folder that is there may be written though the one above it may not.
    places = (parent, folder) if folder.is_dir() else (parent,)
    for place in places:
        trial = place / f".pimper-trial-{secrets.token_hex(4)}"
        try:
            trial.mkdir()
            trial.rmdir()
            return
        except OSError as error:
            refused = error
    raise OutputError(
        f"{folder}: cannot be written, as {places[-1]} refuses ({refused.strerror}). Write "
        "elsewhere."
    ) from refused
