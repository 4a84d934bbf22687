"""The list, in a folder of ours, of what was written there: nothing else is ever removed."""

import hashlib
import json
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal, get_args

MARKER = ".pimper.json"
STAGES = ".stages"
"""Folder in a folder of results for what a run keeps, to go on where it stopped."""

Kind = Literal["result", "scene", "table", "data set", "stages", "frames"]

_FORMAT, _VERSION = "pimper_torch folder", 1
# A list of ten thousand files has 1.5 MB.
_MAX_BYTES = 1 << 26
# What file managers leave wherever they look.
_DROPPINGS = (".DS_Store", "Thumbs.db", "desktop.ini")


@dataclass(frozen=True, slots=True, kw_only=True)
class Written:
    """A file as it was written.

    Attributes:
        size: In bytes.
        modified_ns: When, in nanoseconds since 1970. A copy has another time.
        digest: SHA-256 of its contents, looked at where the time is another.
    """

    size: int
    modified_ns: int
    digest: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Marker:
    """What a folder holds.

    Attributes:
        kind: Which command wrote it.
        files: Relative to the folder, with slashes.
        folders: Those inside, in the same form.
    """

    kind: Kind
    files: Mapping[str, Written]
    folders: tuple[str, ...] = ()


def seal(folder: Path, kind: Kind) -> None:
    """Bring a folder's files to the disk, and list them in its marker.

    Raises:
        OSError: The disk refuses.
    """
    files, folders = {}, [folder]
    for path, about in _inside(folder):
        if stat.S_ISDIR(about.st_mode):
            folders.append(path)
        else:
            files[_relative(path, folder)] = _sealed(path)
    _write(folder, kind, files, [_relative(path, folder) for path in folders[1:]])
    for path in folders:
        flush_folder(path)


def mark(folder: Path, kind: Kind) -> None:
    """Find a folder as ours that lists nothing, as its contents check themselves.

    Raises:
        OSError: The disk refuses.
    """
    _write(folder, kind, {}, [])


def read_marker(folder: Path) -> Marker | None:
    """Read a folder's marker; ``None`` where there is none, or none that can be believed."""
    path = folder / MARKER
    try:
        if path.is_symlink() or not path.is_file() or path.stat().st_size > _MAX_BYTES:
            return None
        return _marker(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, RecursionError):
        return None


def foreign(folder: Path, *markers: Marker) -> list[str]:
    """Name what is in a folder but in none of the lists, or was changed since it was written.

    The folder of kept stages and the marker are left out.
    """
    known = {name for marker in markers for name in marker.folders}
    known |= {
        str(parent)
        for marker in markers
        for name in marker.files
        for parent in PurePosixPath(name).parents
    }
    found = []
    for path, about in _inside(folder):
        name = _relative(path, folder)
        lists = [marker.files[name] for marker in markers if name in marker.files]
        if stat.S_ISDIR(about.st_mode):
            ours = name in known
        else:
            ours = stat.S_ISREG(about.st_mode) and (
                path.name in _DROPPINGS or any(_same(path, about, one) for one in lists)
            )
        if not ours:
            found.append(name + (" (changed since it was written)" if lists else ""))
    return found


def remove_written(folder: Path, marker: Marker, under: str = "") -> None:
    """Remove what the list names, in the folder or in one entry of it, and nothing else.

    A folder inside that holds anything else stays.

    Raises:
        OSError: A file cannot be removed.
    """
    for path, about in reversed(list(_inside(folder))):
        name = _relative(path, folder)
        if under and name != under and not name.startswith(f"{under}/"):
            continue
        if stat.S_ISDIR(about.st_mode):
            with suppress(OSError):  # something else is in it
                path.rmdir()
        elif path.name in _DROPPINGS or (
            name in marker.files and _same(path, about, marker.files[name])
        ):
            path.unlink()


def tops(marker: Marker) -> set[str]:
    """Name the entries of the folder itself."""
    return {name.split("/")[0] for name in (*marker.files, *marker.folders)}


def write_text(path: Path, text: str) -> None:
    """Write a small file, whole or not at all, and bring it to the disk.

    Raises:
        OSError: The disk refuses; then nothing stays behind.
    """
    fresh = path.with_name(f"{path.name}.new")
    try:
        with fresh.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(path)
    except BaseException:
        fresh.unlink(missing_ok=True)
        raise


def flush_folder(folder: Path) -> None:
    """Bring the names in a folder to the disk, where the system can."""
    with suppress(OSError):  # not on Windows
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def _write(folder: Path, kind: Kind, files: Mapping[str, Written], folders: Sequence[str]) -> None:
    content = {
        "format": _FORMAT,
        "format_version": _VERSION,
        "kind": kind,
        "folders": folders,
        "files": {
            name: [one.size, one.modified_ns, one.digest] for name, one in sorted(files.items())
        },
    }
    write_text(folder / MARKER, json.dumps(content, indent=1) + "\n")


def _inside(folder: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """List what a folder holds, folders before what is in them; no link is followed."""
    yield from _entries(folder, (MARKER, STAGES))


def _entries(folder: Path, but: tuple[str, ...] = ()) -> Iterator[tuple[Path, os.stat_result]]:
    for path in sorted(folder.iterdir()):
        if path.name in but:
            continue
        about = path.lstat()
        yield path, about
        if stat.S_ISDIR(about.st_mode):
            yield from _entries(path)


def _relative(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()


def _sealed(path: Path) -> Written:
    with path.open("rb+") as file:
        os.fsync(file.fileno())
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    about = path.stat()
    return Written(size=about.st_size, modified_ns=about.st_mtime_ns, digest=digest)


def _same(path: Path, about: os.stat_result, one: Written) -> bool:
    if not stat.S_ISREG(about.st_mode) or about.st_size != one.size:
        return False
    if about.st_mtime_ns == one.modified_ns:
        return True
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == one.digest


def _marker(content: Any) -> Marker:  # noqa: ANN401 - whatever JSON holds
    """Check what was read: it may come from anybody.

    Raises:
        ValueError: It is no marker of this version, or names something outside the folder.
    """
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise ValueError("no marker")
    kind, files, folders = (content.get(name) for name in ("kind", "files", "folders"))
    known: tuple[Kind, ...] = get_args(Kind)
    named = next((one for one in known if one == kind), None)
    if content.get("format_version") != _VERSION or named is None:
        raise ValueError("of another version")
    if not isinstance(files, dict) or not isinstance(folders, list):
        raise ValueError("no lists")
    for name in (*files, *folders):
        _require_inside(name)
    return Marker(
        kind=named,
        files={name: _written(one) for name, one in files.items()},
        folders=tuple(folders),
    )


def _require_inside(name: object) -> None:
    parts = name.split("/") if isinstance(name, str) else [""]
    if any(part in ("", ".", "..") or "\\" in part or "\0" in part for part in parts):
        raise ValueError("a name that leads elsewhere")
    if parts[0] in (MARKER, STAGES) or os.path.splitdrive(str(name))[0]:
        raise ValueError("a name that leads elsewhere")


def _written(one: Any) -> Written:  # noqa: ANN401 - whatever JSON holds
    if not (isinstance(one, list) and len(one) == 3 and all(type(x) is int for x in one[:2])):
        raise ValueError("no file")
    size, modified_ns, digest = one
    if not isinstance(digest, str):
        raise ValueError("no digest")
    return Written(size=size, modified_ns=modified_ns, digest=digest)
