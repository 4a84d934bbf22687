"""The list, in a folder of results, of the files of a run: nothing else is ever removed."""

import json
import os
import stat
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal, get_args

from pimper_torch.doors.result_folder.files import file_written_whole

MARKER = ".pimper.json"
"""Name of the list. A folder with its list holds a whole result."""
STAGES = ".stages"
"""Folder in a folder of results for what a run keeps, to go on where it stopped."""

Kind = Literal["result", "scene", "table", "data set", "frames"]

_FORMAT = "pimper_torch folder"
# Version 1 had sizes, times and hashes with the names.
_VERSIONS = (1, 2)
# What file managers leave wherever they look.
_DROPPINGS = (".DS_Store", "Thumbs.db", "desktop.ini")


@dataclass(frozen=True, slots=True, kw_only=True)
class FileList:
    """The list of a folder.

    Attributes:
        files: Names relative to the folder, with slashes.
        written_ns: Nanoseconds since 1970. Files of a later time were changed since.
    """

    kind: Kind
    files: frozenset[str]
    written_ns: int

    def has(self, path: Path, name: str) -> bool:
        """Return whether a file is one of the list, as it was written; a link is none."""
        about = path.lstat()
        own = name in self.files and about.st_mtime_ns <= self.written_ns
        return stat.S_ISREG(about.st_mode) and (own or path.name in _DROPPINGS)


def seal(folder: Path, kind: Kind) -> None:
    """Bring a folder's files to the disk, and list them in its marker."""
    files = [path for path in _inside(folder) if path.is_file()]
    for path in files:
        with path.open("rb+") as file:
            os.fsync(file.fileno())
    names = [path.relative_to(folder).as_posix() for path in files]
    content = {"format": _FORMAT, "format_version": _VERSIONS[-1], "kind": kind, "files": names}
    with file_written_whole(folder / MARKER) as fresh:
        fresh.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_marker(folder: Path) -> FileList | None:
    """Read a folder's marker; ``None`` where there is none, or none that can be believed.

    Its names are only compared with those in the folder: a name that leads elsewhere is harmless.
    """
    path = folder / MARKER
    if path.is_symlink():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        known = content["format"] == _FORMAT and content["format_version"] in _VERSIONS
        kind = next(one for one in get_args(Kind) if one == content["kind"])
        files, written_ns = frozenset(map(str, content["files"])), path.stat().st_mtime_ns
    except (OSError, ValueError, KeyError, TypeError, RecursionError, StopIteration):
        return None
    return FileList(kind=kind, files=files, written_ns=written_ns) if known else None


def sort_out(folder: Path, *lists: FileList) -> tuple[list[Path], list[str]]:
    """Separate what is in a folder by whether it is in one of the lists, as it was written.

    The folder of kept stages and the marker are left out; no link is followed.

    Returns:
        Paths of what is listed, files before the folders that they are in; names of all else.
    """
    listed = {name for one in lists for name in one.files}
    folders = {str(parent) for name in listed for parent in PurePosixPath(name).parents}
    own, others = list[Path](), list[str]()
    for path in reversed(_inside(folder)):
        name = path.relative_to(folder).as_posix()
        if name in folders if _is_folder(path) else any(one.has(path, name) for one in lists):
            own.append(path)
        else:
            others.append(name + " (changed since it was written)" * (name in listed))
    return own, sorted(others)


def _inside(folder: Path) -> list[Path]:
    """List what a folder holds, folders before what is in them."""
    tops = [path for path in sorted(folder.iterdir()) if path.name not in (MARKER, STAGES)]
    return [
        one for top in tops for one in (top, *(sorted(top.rglob("*")) if _is_folder(top) else []))
    ]


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()
