"""Layout of data sets: refusals of other layouts, and readers of their text files."""

import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.errors import InputError, some

_MAX_NAME = 255  # bytes, of most file systems


def expect(ok: bool, path: Path, kind: str, needed: str, found: str | None = None) -> None:
    """Refuse a folder or file that does not have the layout of a data set.

    Args:
        kind: The data set, as its users call it.
        found: What is there instead; by default what the folder holds.
    """
    if ok:
        return
    if found is None:
        found = contents(path)
    needed, found = _shortened(needed), _shortened(found)
    raise InputError(
        f"{path}: not the layout of {kind}. Needed: {needed}. Found: {found}. Point to the folder "
        "that holds it, or choose the reader of another layout."
    )


def _shortened(text: str, most: int = 400) -> str:
    return text if len(text) <= most else f"{text[: most - 3]}..."


def contents(path: Path) -> str:
    """List a folder's contents, for a message."""
    if path.is_dir():
        names = sorted(inner.name for inner in path.iterdir())
        return some(names) if names else "an empty folder"
    return "a file" if path.exists() else "nothing there"


def inside(folder: Path, name: str, kind: str) -> Path:
    """Join a path that a data set's file names to its folder, refusing to leave the folder.

    Links that lie in the folder are followed wherever they lead: who put them there wants that.

    Returns:
        Without ``..``, which would leave the folder behind a link.

    Raises:
        InputError: The path is absolute, leads out by ``..``, or is no path.
    """
    longest = max(len(part.encode("utf-8", "surrogatepass")) for part in (*Path(name).parts, ""))
    expect(longest <= _MAX_NAME, folder, kind, "names of files", f"{name!r}")
    within = os.path.normpath(name)
    stays = not Path(name).anchor and Path(within).parts[:1] != ("..",) and "\0" not in name
    expect(
        stays,
        folder,
        kind,
        "paths that stay in this folder",
        f"{name!r}, which leads out of it",
    )
    return folder / within


def first_of(candidates: Sequence[Path]) -> Path | None:
    """Return the first path that exists."""
    return next((path for path in candidates if path.exists()), None)


def file_in(given: Path | str, names: Sequence[str], kind: str) -> Path:
    """Return a file, or the one of these names, or patterns, in a folder.

    Raises:
        InputError: There is none, or several fit a pattern.
    """
    given = Path(given)
    if given.is_file():
        return given
    found = [given / name for name in names if (given / name).exists()]
    if names[0].startswith("*"):
        found = sorted(given.glob(names[0])) if given.is_dir() else []
        expect(len(found) == 1, given, kind, f"one file named {names[0]}")
    expect(bool(found), given, kind, f"a file {' or '.join(names)}")
    return found[0]


def read_text(path: Path, kind: str) -> str:
    """Read a text file of a data set.

    Raises:
        InputError: There is no such file, or it is no UTF-8 text.
    """
    expect(path.is_file(), path, kind, "a text file", contents(path))
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read as text ({error}); needed: the text file of {kind}, as UTF-8. "
            "Copy it again."
        ) from error


def read_json(path: Path, kind: str) -> dict[str, object]:
    """Read a JSON file that holds one object.

    Raises:
        InputError: There is no such file, or it holds something else.
    """
    try:
        found = json.loads(read_text(path, kind))
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: is no valid JSON ({error}); needed: the JSON file of {kind}. Copy it again, "
            "or write it anew."
        ) from error
    expect(isinstance(found, dict), path, kind, "a JSON object", f"a {type(found).__name__}")
    return dict(found)


def objects(value: object, what: str, path: Path, kind: str) -> list[dict[str, object]]:
    """Check that a value of a file is a list of objects, and give it.

    Raises:
        InputError: It is something else, or empty.
    """
    entries = list(value) if isinstance(value, list) else []
    expect(
        bool(entries) and all(isinstance(entry, dict) for entry in entries),
        path,
        kind,
        f"a list of objects as {what}",
        _shown(value),
    )
    return entries


def numbers(
    value: object, count: int, what: str, path: Path, kind: str
) -> Float[Tensor, " number"]:
    """Check that a value of a file is so many numbers, and give them in float64.

    Args:
        value: Numbers, or texts of numbers, in a list, a list of lists, one text or alone.
        kind: The data set, as its users call it.

    Raises:
        InputError: They are more, fewer, not finite, or no numbers.
    """
    pieces = value.split() if isinstance(value, str) else value
    try:
        array = np.asarray(pieces, dtype=np.float64).reshape(-1)
    except (ValueError, TypeError, OverflowError):
        array = np.full(1, np.nan)
    expect(
        len(array) == count and bool(np.isfinite(array).all()),
        path,
        kind,
        f"{count} finite number{'s' if count > 1 else ''} as {what}",
        _shown(value),
    )
    return torch.from_numpy(array.copy())


def _shown(value: object) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
