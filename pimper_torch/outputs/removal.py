"""Removing what is kept for a next run, and what killed runs left."""

import shutil
from pathlib import Path

from pimper_torch.errors import OutputError
from pimper_torch.outputs.folders import put_in_place
from pimper_torch.outputs.marker import STAGES, read_marker
from pimper_torch.outputs.stages import is_ours, kept, locked


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
