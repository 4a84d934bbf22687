"""Folders of results: all of a result, or nothing."""

import secrets
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from pimper_torch.errors import OutputError
from pimper_torch.io.photographs import some


def prepare_output(folder: Path | str, contents: Collection[str], overwrite: bool = False) -> None:
    """Check, before the work, that its result can be written; leaves no trace.

    Args:
        folder: New or empty.
        contents: Names of what the result consists of; a folder with anything else in it is
            never replaced.
        overwrite: Replace a former result.

    Raises:
        OutputError: The folder already holds something, is a file, or cannot be made.
    """
    folder = Path(folder)
    if folder.is_symlink() and not folder.exists():
        raise OutputError(f"{folder}: is a link to nothing. Remove it, or write elsewhere.")
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; needed: a folder that is new or empty.")
    try:
        present = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    except OSError as error:
        raise OutputError(f"{folder}: cannot be listed ({error.strerror}).") from error
    foreign = [name for name in present if name not in contents]
    if present and not overwrite:
        raise OutputError(
            f"{folder}: already holds {some(present)}; needed: a new or empty folder. Write "
            "elsewhere, or replace a former result by `--overwrite` (`overwrite=True`)."
        )
    if foreign:
        raise OutputError(
            f"{folder}: holds {some(foreign)}, which is no part of a result, so it is not "
            "overwritten. Write elsewhere."
        )
    target = folder.resolve().parent
    while not target.exists():
        target = target.parent
    trial = target / f".{folder.name}.trial-{secrets.token_hex(4)}"
    try:
        trial.mkdir()
        trial.rmdir()
    except OSError as error:
        raise OutputError(
            f"{folder}: cannot be written, as {target} refuses ({error.strerror}). Write elsewhere."
        ) from error


@contextmanager
def written_whole(
    folder: Path | str, contents: Collection[str], *, overwrite: bool = False
) -> Iterator[Path]:
    """Give a folder to fill, which takes the place of ``folder`` when all went well.

    It lies beside ``folder``: a folder that is there is whole, and a former result is
    replaced only when the new one is complete. (A folder that cannot be renamed, as a mount
    point cannot, is filled piece by piece at the end.)

    Args:
        folder: New or empty; its parents are made.
        contents: Names of what the result consists of; see :func:`prepare_output`.
        overwrite: Replace a former result.

    Raises:
        OutputError: As :func:`prepare_output`, or the disk refuses on the way; then
            nothing stays behind.
    """
    folder = Path(folder)
    prepare_output(folder, contents, overwrite)
    try:
        with _staged(folder, contents) as staging:
            yield staging
    except OSError as error:
        raise OutputError(
            f"{folder}: writing failed ({error}); nothing was left there. Make room or write "
            "elsewhere."
        ) from error


@contextmanager
def _staged(folder: Path, contents: Collection[str]) -> Iterator[Path]:
    target = folder.resolve()
    made = _make_parents(target.parent)
    token = secrets.token_hex(4)
    staging, former = (target.parent / f".{target.name}.{kind}-{token}" for kind in ("new", "old"))
    try:
        staging.mkdir()
        yield staging
        _move(staging, target, former, contents)
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        for parent in made:
            parent.rmdir()
        raise
    shutil.rmtree(former, ignore_errors=True)


def _move(staging: Path, target: Path, former: Path, contents: Collection[str]) -> None:
    """Rename the new result to ``target``, and what was there to ``former``."""
    if not target.exists():
        staging.rename(target)
        return
    try:
        target.rename(former)
    except OSError:
        # The folder is a mount point, as OUT in a container is: fill it file by file.
        _pour(staging, target, contents)
        return
    try:
        staging.rename(target)
    except BaseException:
        former.rename(target)
        raise


def _pour(staging: Path, target: Path, contents: Collection[str]) -> None:
    for name in contents:
        old = target / name
        if old.is_dir():
            shutil.rmtree(old)
        else:
            old.unlink(missing_ok=True)
        if (staging / name).exists():
            shutil.move(staging / name, old)
    staging.rmdir()


def _make_parents(folder: Path) -> list[Path]:
    """Make a folder and those above it; gives those that were not there, deepest first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return missing
