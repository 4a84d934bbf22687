"""Which file of one list is which of another, by names that programs have rewritten on the way."""

import re
import unicodedata
from collections.abc import Callable, Sequence

from pimper_torch.runtime.errors import InputError

_SUFFIXES = re.compile(
    r"(\.(jpe?g|png|tiff?|bmp|webp|gif|hei[cf]|hif|avif|dng|cr[23w]|nef|nrw|arw|sr2|orf|raf|rw[2l]|pef|srw|3fr|iiq))+$",
    re.IGNORECASE,
)
# What programs write for a space, and runs of it that they shorten.
_SPACES = re.compile(r"(\s|_|%20)+")
Form = Callable[[str], str]


def match_files(
    wanted: Sequence[str], present: Sequence[str], *, folder: str = "", where: str, what: str
) -> list[int | None]:
    """Find files by name: exactly, else as another program may have written the name.

    Names are compared by their last part, in turn as they are; in one Unicode form and with either
    separator; with spaces and underscores taken for one another; without case; and without the
    extensions of images. What was found by an earlier comparison is out of the later ones. Among
    several of one last part, the one counts whose folders agree with those of the wanted file from
    the end on; where some folders agree, a file from another folder is not taken.

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
    found: list[int | None] = [None] * len(wanted)
    for form in _FORMS:
        taken = set(found)
        free: dict[str, list[int]] = {}
        for index, name in enumerate(present):
            if index not in taken:
                free.setdefault(form(name), []).append(index)
        claims: dict[int, list[int]] = {}
        for index, name in enumerate(wanted):
            if found[index] is None and (several := free.get(form(name))):
                best = _best(name, [present[one] for one in several], folder)
                if len(best) > 1:
                    raise _ambiguous(where, what, name, [present[several[one]] for one in best])
                claims.setdefault(several[best[0]], []).append(index)
        for index, claimants in claims.items():
            best = _best(present[index], [wanted[one] for one in claimants], "")
            if len(best) > 1:
                names = [wanted[claimants[one]] for one in best]
                raise _ambiguous(where, what, present[index], names)
            found[claimants[best[0]]] = index
    return _of_one_folder(wanted, present, folder, found)


def _last(name: str) -> str:
    return name.rpartition("/")[2]


def _composed(name: str) -> str:
    return _last(unicodedata.normalize("NFC", name).replace("\\", "/"))


def _spaced(name: str) -> str:
    return _SPACES.sub(" ", _composed(name).strip('"')).strip()


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", _spaced(name).casefold())


def _without_extension(name: str) -> str:
    stem = _SUFFIXES.sub("", _folded(name)).strip()
    return stem or _folded(name)


_FORMS: tuple[Form, ...] = (_last, _composed, _spaced, _folded, _without_extension)


def _folders(name: str) -> list[str]:
    """List the folders of a path from its end on, without what a program may rewrite."""
    parts = unicodedata.normalize("NFC", name).replace("\\", "/").split("/")[:-1]
    return [_folded(part) for part in reversed(parts) if part not in ("", ".")]


def _common(first: str, second: str) -> int:
    """Count the folders that agree, from the end of both paths on."""
    pairs = list(zip(_folders(first), _folders(second), strict=False))
    return next((depth for depth, (one, other) in enumerate(pairs) if one != other), len(pairs))


def _best(name: str, several: Sequence[str], folder: str) -> list[int]:
    """Return positions of those whose folders agree with a name's best, then the name itself."""
    path = f"{folder}/{name}" if folder else name
    scores = [(_common(path, other), other == name) for other in several]
    return [index for index, score in enumerate(scores) if score == max(scores)]


def _of_one_folder(
    wanted: Sequence[str], present: Sequence[str], folder: str, found: list[int | None]
) -> list[int | None]:
    """Leave out files of other folders where some are of the wanted ones' folder."""

    def contradicts(index: int, other: int) -> bool:
        path = f"{folder}/{wanted[index]}"
        return _common(path, present[other]) < min(
            len(_folders(path)), len(_folders(present[other]))
        )

    tied = [
        other is not None and _common(f"{folder}/{wanted[index]}", present[other]) > 0
        for index, other in enumerate(found)
    ]
    if not any(tied):
        return found
    return [
        None if other is not None and not tied[index] and contradicts(index, other) else other
        for index, other in enumerate(found)
    ]


def _ambiguous(where: str, what: str, name: str, several: Sequence[str]) -> InputError:
    return InputError(
        f"{where}: {name} may be any of {', '.join(several)} by its name; needed: one {what} for "
        "each photograph. Rename them, or give the folder under its own name."
    )


def view_named(name: str, names: Sequence[str], of: str = "photographs") -> int:
    """Find the one photograph of a name, with its suffix or without."""
    found = [index for index, known in enumerate(names) if name in (known, known.rsplit(".", 1)[0])]
    if len(found) != 1:
        raise InputError(
            f"reference view: {len(found)} {of} are named {name!r}; needed: one of "
            f"{', '.join(names)}."
        )
    return found[0]
