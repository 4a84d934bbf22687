"""Which file of one list is which of another, by names that programs have rewritten on the way."""

import posixpath
import re
import unicodedata
from collections.abc import Sequence

from pimper_torch.runtime.errors import InputError

_SUFFIXES = re.compile(
    r"(\.(jpe?g|png|tiff?|bmp|webp|gif|hei[cf]|hif|avif|dng|cr[23w]|nef|nrw|arw|sr2|orf|raf|rw[2l]|pef|srw|3fr|iiq))+$",
    re.IGNORECASE,
)
# What programs write for a space, and runs of it that they shorten.
_SPACES = re.compile(r"(\s|_|%20)+")


def match_files(
    wanted: Sequence[str], present: Sequence[str], *, folder: str = "", where: str, what: str
) -> list[int | None]:
    """Find files by name: exactly, else as another program may have written the name.

    Names are compared by their last part, in turn as they are; without regard to case, Unicode
    form, separator, and what stands for a space; and without the extensions of images. What was
    found by an earlier comparison is out of the later ones. Among several of one last part, the one
    counts whose folders agree with those of the wanted file from the end on; where some folders
    agree, a file from another folder is not taken.

    Args:
        folder: Path that wanted names lie under.
        where: Where the present ones are, for the message.
        what: What the present ones are called there.

    Returns:
        The position of each in ``present``; ``None`` for one that is not there.

    Raises:
        InputError: A name fits several equally well: says which.

    >>> match_files(["a 1.JPG"], ["cam2/A_1.jpg"], where="model", what="image")
    [0]
    """

    def best(path: str, name: str, several: Sequence[int], names: Sequence[str]) -> int:
        ranks = {index: (_common(path, names[index]), names[index] == name) for index in several}
        first = [index for index in several if ranks[index] == max(ranks.values())]
        if len(first) > 1:
            raise InputError(
                f"{where}: {name} may be any of {', '.join(names[one] for one in first)} by its "
                f"name; needed: one {what} for each photograph. Rename them, or give the folder "
                "under its own name."
            )
        return first[0]

    paths = [f"{folder}/{name}" if folder else name for name in wanted]
    found: list[int | None] = [None] * len(wanted)
    for form in (posixpath.basename, _folded, _without_extension):
        taken = set(found)
        free: dict[str, list[int]] = {}
        for place, name in enumerate(present):
            if place not in taken:
                free.setdefault(form(name), []).append(place)
        claims: dict[int, list[int]] = {}
        for index, name in enumerate(wanted):
            if found[index] is None and (several := free.get(form(name))):
                claims.setdefault(best(paths[index], name, several, present), []).append(index)
        for place, claimants in claims.items():
            found[best(present[place], present[place], claimants, wanted)] = place
    # Files of other folders are left out where some are of the wanted ones' folder.
    others = ["" if place is None else present[place] for place in found]
    pairs = list(zip(paths, others, strict=True))
    tied = any(_common(*pair) for pair in pairs)
    return [
        None if tied and not _common(*pair) and all(map(_folders, pair)) else place
        for place, pair in zip(found, pairs, strict=True)
    ]


def match_poses(
    wanted: Sequence[str], present: Sequence[str], *, folder: str = "", where: str, what: str
) -> list[int | None]:
    """Find the file of each photograph, or of the pose whose folder the photograph is in.

    Where some files are in folders that are named like poses, these are the photographs' own, pose
    by pose; else all files may be. A photograph without a file by :func:`match_files` has that of
    another photograph of its pose, else the file that is named like the pose, else the only file
    in the folder of the pose.

    >>> match_poses(["p1/a.jpg", "p1/b.jpg", "p2/a.jpg"], ["p2.png", "p1/b.jpg"], where="", what="")
    [1, 1, 0]
    """
    poses = [name.rpartition("/")[0] for name in wanted]
    own = {
        pose: [at for at, name in enumerate(present) if _folders(name)[:1] == [_folded(pose)]]
        for pose in poses
        if pose
    }

    def match(names: Sequence[str], places: Sequence[int]) -> dict[str, int]:
        files = [present[place] for place in places]
        matched = match_files(names, files, folder=folder, where=where, what=what)
        return {name: places[at] for name, at in zip(names, matched, strict=True) if at is not None}

    found = {} if any(own.values()) else match(wanted, range(len(present)))
    for pose, places in own.items():
        found |= match([name for name, of in zip(wanted, poses, strict=True) if of == pose], places)
    of_pose: dict[str, int] = {}
    for name, pose in zip(wanted, poses, strict=True):
        if pose and name in found:
            of_pose.setdefault(pose, found[name])
    lost = [pose for pose in own if pose not in of_pose]
    of_pose |= {pose: own[pose][0] for pose in lost if len(own[pose]) == 1}
    of_pose |= match(lost, [at for at in range(len(present)) if at not in found.values()])
    return [found.get(name, of_pose.get(pose)) for name, pose in zip(wanted, poses, strict=True)]


def _folded(name: str) -> str:
    text = unicodedata.normalize("NFC", name).replace("\\", "/").rpartition("/")[2].strip('"')
    return unicodedata.normalize("NFC", _SPACES.sub(" ", text).strip().casefold())


def _without_extension(name: str) -> str:
    return _SUFFIXES.sub("", _folded(name)).strip() or _folded(name)


def _folders(name: str) -> list[str]:
    """List the folders of a path from its end on, without what a program may rewrite."""
    parts = unicodedata.normalize("NFC", name).replace("\\", "/").split("/")[:-1]
    return [_folded(part) for part in reversed(parts) if part not in ("", ".")]


def _common(first: str, second: str) -> int:
    """Count the folders that agree, from the end of both paths on."""
    pairs = list(zip(_folders(first), _folders(second), strict=False))
    return next((depth for depth, (one, other) in enumerate(pairs) if one != other), len(pairs))


def view_named(name: str, names: Sequence[str], of: str = "photographs") -> int:
    """Find the one photograph of a name, with its suffix or without."""
    found = [index for index, known in enumerate(names) if name in (known, known.rsplit(".", 1)[0])]
    if len(found) != 1:
        raise InputError(
            f"reference view: {len(found)} {of} are named {name!r}; needed: one of "
            f"{', '.join(names)}."
        )
    return found[0]
