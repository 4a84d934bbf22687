"""Removing what is kept for a next run, and what killed runs left."""

import os
import stat
from pathlib import Path

from pimper_torch.errors import OutputError
from pimper_torch.outputs.marker import STAGES, read_marker
from pimper_torch.outputs.stages import is_ours, kept, locked, remove_stages
from pimper_torch.outputs.workspace import finish, leftovers, remove_leftovers, restore


def require_cleanable(folder: Path | str) -> None:
    """Refuse a folder in which and beside which there is nothing of ours.

    Raises:
        OutputError: It is not a result, nothing is kept in it, and no killed run left anything.
    """
    folder = Path(folder)
    target = folder.resolve()
    if target.exists() and not target.is_dir():
        raise OutputError(f"{folder}: is a file; needed: the folder of a result.")
    stages = target / STAGES
    held = is_ours(stages) and any(stages.iterdir())
    if not (held or read_marker(target) is not None or leftovers(target)):
        found = "nothing that pimper wrote" if target.exists() else "nothing"
        raise OutputError(
            f"{folder}: found {found}; needed: the folder that was given as `-o OUT` to a run."
        )


def clean_output(folder: Path | str) -> int:
    """Remove what is kept for the next run into a folder, and what killed runs left beside it.

    A result stays. One whose writing was cut off when it was whole is brought to its place.

    Args:
        folder: That was written into.

    Returns:
        How many bytes were freed.

    Raises:
        OutputError: It holds nothing of ours, another run holds it, or the disk refuses.
    """
    folder = Path(folder)
    require_cleanable(folder)
    target = folder.resolve()
    was_there = target.exists()
    try:
        restore(target)
        with locked(target, folder):
            finish(target)
            freed = _size(target / STAGES) if kept(target) else 0  # more than its lock
            freed += sum(_size(one) for one in leftovers(target))
            remove_leftovers(target)
            remove_stages(target)
        if not was_there and not any(target.iterdir()):
            target.rmdir()
    except OSError as error:
        raise OutputError(f"{folder}: cannot be cleaned ({error}).") from error
    return freed


def _size(folder: Path) -> int:
    """Count the bytes of files in a folder; no link is followed."""
    return sum(
        about.st_size
        for parent, _, names in os.walk(folder)
        for about in ((Path(parent) / name).lstat() for name in names)
        if stat.S_ISREG(about.st_mode)
    )
