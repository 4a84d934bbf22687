"""List of a run's files in a result folder; no other files are ever removed."""

import json
import os
import stat
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal, get_args

from pimper_torch.export.result_folder.files import file_written_whole

MARKER = ".pimper.json"
"""Name of the list. A folder with its list contains a complete result."""
STAGES = ".stages"
"""Subfolder of finished stages, from which an interrupted run continues."""

Kind = Literal["result", "scene", "table", "data set", "frames"]

_FORMAT = "pimper_torch folder"
# Version 1 had sizes, times and hashes with the names.
_VERSIONS = (1, 2)
# Files that file managers create in folders they display.
_FILE_MANAGER = (".DS_Store", "Thumbs.db", "desktop.ini")


@dataclass(frozen=True, slots=True, kw_only=True)
class FileList:
    """Files of a run in a folder.

    Attributes:
        files: Names relative to the folder, with slashes.
        written_ns: Nanoseconds since 1970. Files with a later time were changed since.
    """

    kind: Kind
    files: frozenset[str]
    written_ns: int

    def has(self, path: Path, name: str) -> bool:
        """Return whether a file is listed and unchanged, or a file manager's; links are not."""
        status = path.lstat()
        unchanged = name in self.files and status.st_mtime_ns <= self.written_ns
        return stat.S_ISREG(status.st_mode) and (unchanged or path.name in _FILE_MANAGER)


def seal(folder: Path, kind: Kind) -> None:
    """Flush a folder's files to the disk, and write their list."""
    files = [path for path in _inside(folder) if path.is_file()]
    for path in files:
        with path.open("rb+") as file:
            os.fsync(file.fileno())
    names = [path.relative_to(folder).as_posix() for path in files]
    content = {"format": _FORMAT, "format_version": _VERSIONS[-1], "kind": kind, "files": names}
    with file_written_whole(folder / MARKER) as path:
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_marker(folder: Path) -> FileList | None:
    """Read a folder's list of files; ``None`` if it is missing or invalid.

    Its names are only compared with those in the folder: a name that leads elsewhere is harmless.
    """
    path = folder / MARKER
    if path.is_symlink():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        supported = content["format"] == _FORMAT and content["format_version"] in _VERSIONS
        kind = next(kind for kind in get_args(Kind) if kind == content["kind"])
        files, written_ns = frozenset(map(str, content["files"])), path.stat().st_mtime_ns
    except (OSError, ValueError, KeyError, TypeError, RecursionError, StopIteration):
        return None
    return FileList(kind=kind, files=files, written_ns=written_ns) if supported else None


def sort_out(folder: Path, *lists: FileList) -> tuple[list[Path], list[str]]:
    """Partition the content of a folder into unchanged files of the lists, and all others.

    The folder of kept stages and the list itself are skipped; links are not followed.

    Returns:
        Paths of unchanged files, before the folders that contain them; names of all others.
    """
    listed = {name for files in lists for name in files.files}
    folders = {str(parent) for name in listed for parent in PurePosixPath(name).parents}
    unchanged, others = list[Path](), list[str]()
    for path in reversed(_inside(folder)):
        name = path.relative_to(folder).as_posix()
        if name in folders if _is_folder(path) else any(files.has(path, name) for files in lists):
            unchanged.append(path)
        else:
            others.append(name + " (changed since it was written)" * (name in listed))
    return unchanged, sorted(others)


def _inside(folder: Path) -> list[Path]:
    """List a folder recursively, folders before their content."""
    tops = [path for path in sorted(folder.iterdir()) if path.name not in (MARKER, STAGES)]
    return [p for top in tops for p in (top, *(sorted(top.rglob("*")) if _is_folder(top) else []))]


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()
