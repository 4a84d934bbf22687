"""What a reader says when a folder is not laid out as it expects."""

from pathlib import Path

from pimper_torch.errors import InputError
from pimper_torch.io.photographs import some


def expect(ok: bool, place: Path, kind: str, needed: str, found: str | None = None) -> None:
    """Refuse a folder or file that does not have the layout of a data set.

    Args:
        ok: Whether it does.
        place: The folder or file looked at.
        kind: The data set, as its users call it.
        needed: What should be there.
        found: What is there instead; by default what the folder holds.

    Raises:
        InputError: Not ``ok``.
    """
    if ok:
        return
    if found is None:
        found = contents(place)
    raise InputError(
        f"{place}: not the layout of {kind}. Needed: {needed}. Found: {found}. Point to the folder "
        "that holds it, or choose the reader of another layout."
    )


def contents(place: Path) -> str:
    """Tell what a folder holds, for a message."""
    if place.is_dir():
        names = sorted(path.name for path in place.iterdir())
        return some(names) if names else "an empty folder"
    return "a file" if place.exists() else "nothing there"


def inside(folder: Path, name: str, kind: str) -> Path:
    """Join a path that a data set's file names to its folder, refusing to leave the folder.

    Raises:
        InputError: The path is absolute, or leads out by ``..`` or a link.
    """
    path = folder / name
    expect(
        path.resolve().is_relative_to(folder.resolve()),
        folder,
        kind,
        "paths that stay in this folder",
        f"{name!r}, which leads out of it",
    )
    return path
