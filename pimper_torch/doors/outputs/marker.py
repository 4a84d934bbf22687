"""The list, in a folder of results, of the files written there: nothing else is ever removed."""

import hashlib
import json
import os
import stat
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal, NamedTuple, get_args

from pimper_torch.doors.outputs.files import file_written_whole

MARKER = ".pimper.json"
"""Name of the list. A folder with its list holds a whole result."""
STAGES = ".stages"
"""Folder in a folder of results for what a run keeps, to go on where it stopped."""

Kind = Literal["result", "scene", "table", "data set", "frames"]

_FORMAT, _VERSION = "pimper_torch folder", 1
# What file managers leave wherever they look.
_DROPPINGS = (".DS_Store", "Thumbs.db", "desktop.ini")


class Written(NamedTuple):
    """A file as it was written.

    Attributes:
        size: In bytes.
        modified_ns: Nanoseconds since 1970. A copy has another time.
        digest: SHA-256 of its contents, compared where the time is another.
    """

    size: int
    modified_ns: int
    digest: str


@dataclass(frozen=True, slots=True, kw_only=True)
class FileList:
    """The list of a folder.

    Attributes:
        files: Relative to the folder, with slashes.
    """

    kind: Kind
    files: Mapping[str, Written]


def seal(folder: Path, kind: Kind) -> None:
    """Bring a folder's files to the disk, and list them in its marker."""
    files = {}
    for path in _inside(folder):
        if path.is_file():
            with path.open("rb+") as file:
                os.fsync(file.fileno())
            about = path.stat()
            files[_name(path, folder)] = (about.st_size, about.st_mtime_ns, _digest(path))
    content = {"format": _FORMAT, "format_version": _VERSION, "kind": kind, "files": files}
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
        known = (content["format"], content["format_version"]) == (_FORMAT, _VERSION)
        files = {name: Written(*one) for name, one in content["files"].items()}
        kind = next((one for one in get_args(Kind) if one == content["kind"]), None)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return FileList(kind=kind, files=files) if known and kind is not None else None


def foreign(folder: Path, *markers: FileList) -> list[str]:
    """Name what is in a folder but in none of the lists, or was changed since it was written.

    The folder of kept stages and the marker are left out.
    """
    listed = [name for marker in markers for name in marker.files]
    folders = {str(parent) for name in listed for parent in PurePosixPath(name).parents}
    found = []
    for path in _inside(folder):
        name = _name(path, folder)
        if _is_folder(path) and name in folders:
            continue
        if not any(_is_written(path, name, marker) for marker in markers):
            found.append(name + (" (changed since it was written)" if name in listed else ""))
    return found


def remove_written(folder: Path, marker: FileList) -> None:
    """Remove the files that the list names, and nothing else.

    A folder inside that holds anything else stays.
    """
    for path in reversed(_inside(folder)):
        if _is_folder(path):
            with suppress(OSError):  # something else is in it
                path.rmdir()
        elif _is_written(path, _name(path, folder), marker):
            path.unlink()


def _inside(folder: Path) -> list[Path]:
    """List what a folder holds, folders before what is in them; no link is followed."""
    own = (folder / MARKER, folder / STAGES)
    tops = (path for path in sorted(folder.iterdir()) if path not in own)
    return [
        one for top in tops for one in (top, *(sorted(top.rglob("*")) if _is_folder(top) else []))
    ]


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _is_written(path: Path, name: str, marker: FileList) -> bool:
    """Return whether a file is one that the list names, with the same contents."""
    about = path.lstat()
    if not stat.S_ISREG(about.st_mode):
        return False
    if path.name in _DROPPINGS:
        return True
    one = marker.files.get(name)
    if one is None or one.size != about.st_size:
        return False
    return one.modified_ns == about.st_mtime_ns or one.digest == _digest(path)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _name(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()
