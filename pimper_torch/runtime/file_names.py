"""Match two lists of file names, some of which programs have rewritten."""

import posixpath
import re
import unicodedata
from collections.abc import Sequence

from pimper_torch.runtime.errors import InputError, some

_SUFFIXES = re.compile(
    r"(\.(jpe?g|png|tiff?|bmp|webp|gif|hei[cf]|hif|avif|dng|cr[23w]|nef|nrw|arw|sr2|orf|raf|rw[2l]|pef|srw|3fr|iiq))+$",
    re.IGNORECASE,
)
# Spaces and their replacements by programs, which also shorten runs of them.
_SPACES = re.compile(r"(\s|_|%20)+")


def match_files(
    wanted: Sequence[str], present: Sequence[str], *, folder: str = "", where: str, what: str
) -> list[int | None]:
    """Return the index in ``present`` of each wanted file, by exact or rewritten names.

    File names without folders are compared in three rounds: exactly; without regard to case,
    Unicode form, separator and replacements of spaces; and also without image extensions. Each
    round excludes the files matched before. Among files of the same name, the one with most common
    folders, from the end of both paths, is chosen. If any folders agree, others are excluded.

    Args:
        folder: Parent folder of the wanted names.
        where: Location of the present files, for the message.
        what: Kind of the present files, for the message.

    Returns:
        Indices into ``present``; ``None`` for missing files.

    Raises:
        InputError: A name matches several files equally well; the message lists them.

    >>> match_files(["a 1.JPG"], ["cam2/A_1.jpg"], where="model", what="image")
    [0]
    """

    def best(path: str, name: str, candidates: Sequence[int], names: Sequence[str]) -> int:
        ranks = {index: (_common(path, names[index]), names[index] == name) for index in candidates}
        first = [index for index in candidates if ranks[index] == max(ranks.values())]
        if len(first) > 1:
            raise InputError(
                f"{where}: {name} may be any of {', '.join(names[index] for index in first)} by "
                f"its name; needed: one {what} for each photograph. Rename them, or give the "
                "folder by its original name."
            )
        return first[0]

    paths = [f"{folder}/{name}" if folder else name for name in wanted]
    matches: list[int | None] = [None] * len(wanted)
    for form in (posixpath.basename, _folded, _without_extension):
        matched = set(matches)
        free: dict[str, list[int]] = {}
        for position, name in enumerate(present):
            if position not in matched:
                free.setdefault(form(name), []).append(position)
        claims: dict[int, list[int]] = {}
        for index, name in enumerate(wanted):
            if matches[index] is None and (candidates := free.get(form(name))):
                claims.setdefault(best(paths[index], name, candidates, present), []).append(index)
        for position, claimants in claims.items():
            matches[best(present[position], present[position], claimants, wanted)] = position
    others = ["" if position is None else present[position] for position in matches]
    pairs = list(zip(paths, others, strict=True))
    tied = any(_common(*pair) for pair in pairs)
    return [
        None if tied and not _common(*pair) and all(map(_folders, pair)) else position
        for position, pair in zip(matches, pairs, strict=True)
    ]


def match_poses(
    wanted: Sequence[str], present: Sequence[str], *, folder: str = "", where: str, what: str
) -> list[int | None]:
    """Return the index of the file of each photograph, or of its pose (its folder).

    If any files are in folders named like poses, photographs are matched by :func:`match_files`
    pose by pose, else with all files. A photograph without a match has the file of a photograph of
    its pose, else the file named like the pose, else the only file in the pose's folder.

    >>> match_poses(["p1/a.jpg", "p1/b.jpg", "p2/a.jpg"], ["p2.png", "p1/b.jpg"], where="", what="")
    [1, 1, 0]
    """
    poses = [name.rpartition("/")[0] for name in wanted]
    folders = {
        pose: [index for index, name in enumerate(present) if _folders(name)[:1] == [_folded(pose)]]
        for pose in poses
        if pose
    }

    def match(names: Sequence[str], candidates: Sequence[int]) -> dict[str, int]:
        files = [present[index] for index in candidates]
        matches = match_files(names, files, folder=folder, where=where, what=what)
        pairs = zip(names, matches, strict=True)
        return {name: candidates[index] for name, index in pairs if index is not None}

    by_name = {} if any(folders.values()) else match(wanted, range(len(present)))
    for pose, indices in folders.items():
        names = [name for name, parent in zip(wanted, poses, strict=True) if parent == pose]
        by_name |= match(names, indices)
    by_pose: dict[str, int] = {}
    for name, pose in zip(wanted, poses, strict=True):
        if pose and name in by_name:
            by_pose.setdefault(pose, by_name[name])
    missing = [pose for pose in folders if pose not in by_pose]
    by_pose |= {pose: folders[pose][0] for pose in missing if len(folders[pose]) == 1}
    by_pose |= match(missing, [i for i in range(len(present)) if i not in by_name.values()])
    return [by_name.get(name, by_pose.get(pose)) for name, pose in zip(wanted, poses, strict=True)]


def _folded(name: str) -> str:
    text = unicodedata.normalize("NFC", name).replace("\\", "/").rpartition("/")[2].strip('"')
    return unicodedata.normalize("NFC", _SPACES.sub(" ", text).strip().casefold())


def _without_extension(name: str) -> str:
    return _SUFFIXES.sub("", _folded(name)).strip() or _folded(name)


def _folders(name: str) -> list[str]:
    """List the folders of a path from its end on, in a form that ignores rewriting."""
    parts = unicodedata.normalize("NFC", name).replace("\\", "/").split("/")[:-1]
    return [_folded(part) for part in reversed(parts) if part not in ("", ".")]


def _common(first: str, second: str) -> int:
    """Return the number of folders in common, counted from the end of both paths."""
    pairs = list(zip(_folders(first), _folders(second), strict=False))
    return next((depth for depth, (a, b) in enumerate(pairs) if a != b), len(pairs))


def view_named(name: str, names: Sequence[str], of: str = "photographs") -> int:
    """Return the index of the photograph with a name, which may lack its suffix.

    >>> view_named("b", ["a.jpg", "b.jpg"])
    1
    """
    exact = [index for index, candidate in enumerate(names) if name == candidate]
    stems = [index for index, candidate in enumerate(names) if name == candidate.rpartition(".")[0]]
    matches = exact or stems
    if len(matches) != 1:
        raise InputError(
            f"{name!r}: {len(matches) or 'no'} {of} have this name; needed: one of {some(names)}."
        )
    return matches[0]
