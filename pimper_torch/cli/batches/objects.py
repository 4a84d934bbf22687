"""The objects of a batch: a folder of folders, or a table."""

import csv
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pimper_torch.cli.options import every_option
from pimper_torch.doors.result_folder.files import require_name
from pimper_torch.runtime.errors import ConfigError, InputError, some

# Files of the batch itself in OUT, beside the objects' folders.
CSV, HTML = "batch.csv", "batch.html"

_PATHS = ("DIR", "FILE", "PATH")
_YES, _NO = ("yes", "true", "1"), ("no", "false", "0")


@dataclass(frozen=True, slots=True, kw_only=True)
class Object:
    """Photographs of one object, and how to reconstruct it.

    Attributes:
        name: Of its folder in the folder of the batch.
        settings: Options of ``pimper reconstruct`` with their values, as on its command line.
        where: Place in a list, for messages.
    """

    name: str
    photos: Path | str
    settings: tuple[str, ...] = ()
    where: str = ""

    def __post_init__(self) -> None:
        where = f"{self.where or self.photos}: the name"
        require_name(self.name, InputError)
        sound = self.name.isprintable() and not re.search(r"^[.\s]|[/\\]|\s$", self.name)
        if not sound or self.name in ("", CSV, HTML):
            raise InputError(
                f"{where} is {self.name!r}; needed: one of a folder in OUT, without / or \\, that "
                f"does not begin with a dot and is not {CSV} or {HTML}."
            )


def read_objects(given: Path | str | Sequence["Object | Path | str"]) -> list[Object]:
    """List the objects of a folder, of a table, or of folders in turn.

    Args:
        given: A folder of folders, each with photographs or with a folder ``photos``; a CSV file
            whose columns are ``photos``, ``name`` and options of ``pimper reconstruct`` without
            dashes; or several objects or folders.
    """
    if not isinstance(given, Path | str):
        found = [one if isinstance(one, Object) else _in_folder(Path(one)) for one in given]
    elif Path(given).is_dir():
        folders = (one for one in sorted(Path(given).iterdir()) if not one.name.startswith("."))
        found = [_in_folder(one) for one in folders if one.is_dir()]
    else:
        found = _in_table(Path(given))
    where = str(given) if isinstance(given, Path | str) else "the list"
    if not found:
        raise InputError(
            f"{where}: no objects; needed: a folder of folders of photographs, or a CSV file with "
            "a column `photos`."
        )
    counts = Counter(one.name.casefold() for one in found)  # which some disks do not tell apart
    same = [f"{one.photos} ({one.name})" for one in found if counts[one.name.casefold()] > 1]
    if same:
        raise InputError(
            f"{where}: several objects have one name: {some(same)}; needed: a name each. Give a "
            "CSV file with a column `name`."
        )
    return found


def _in_folder(
    folder: Path, name: str = "", settings: tuple[str, ...] = (), where: str = ""
) -> Object:
    """Return an object by the name of its folder, for a link its own, unless another is given."""
    own = folder if folder.name not in ("", "..") else folder.resolve()
    photos = folder / "photos" if (folder / "photos").is_dir() else folder
    return Object(name=name or own.name, photos=photos, settings=settings, where=where)


def _in_table(path: Path) -> list[Object]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}); needed: a folder of folders of photographs, or a "
            "CSV file in UTF-8."
        ) from error
    lines = text.splitlines()
    head = lines[0] if lines else ""
    delimiter = ";" if ";" in head and "," not in head else ","
    table = csv.DictReader(lines, delimiter=delimiter)
    columns = [(name or "").strip() for name in table.fieldnames or ()]
    if "photos" not in columns or len({*columns}) < len(columns):
        raise ConfigError(
            f"{path}: its columns are {some(columns) or 'none'}; needed: `photos`, and `name` or "
            "options of `pimper reconstruct` without dashes, each once."
        )
    if taken := {"out", "o", "overwrite", "view"} & {*columns}:
        raise ConfigError(f"{path}: has the column {min(taken)}, which is the batch's own.")
    kinds = {name: one.value for one in every_option("reconstruct") for name in one.names}
    found = []
    for row in table:
        where = f"{path}, row {table.line_num}"
        cells = {
            name: (cell or "").strip() for name, cell in zip(columns, row.values(), strict=False)
        }
        if None in row:
            raise ConfigError(f"{where}: has more cells than there are columns ({len(columns)}).")
        photos, name = cells.pop("photos"), cells.pop("name", "")
        if not photos:
            raise InputError(f"{where}: `photos` is empty; needed: a folder of photographs.")
        settings = [
            word
            for column, cell in cells.items()
            if cell
            for word in _words(where, f"--{column.replace('_', '-')}", cell, kinds, path.parent)
        ]
        found.append(_in_folder(path.parent / photos, name, (*settings,), where))
    return found


def _words(where: str, option: str, cell: str, kinds: Mapping[str, str], base: Path) -> list[str]:
    """Write a cell as on a command line; paths are relative to the table."""
    kind = kinds.get(option)
    if kind == "" and cell.lower() in (*_YES, *_NO):
        stage, dot, last = option[2:].rpartition(".")
        negated = f"--{stage}{dot}no-{last}"
        return [option] if cell.lower() in _YES else [negated] if negated in kinds else []
    if kind in _PATHS or (option == "--preset" and (base / cell).is_file()):
        cell = str((base / cell).absolute())
    try:
        return [option, *(shlex.split(cell) if kind and " " in kind else [cell])]
    except ValueError as error:
        raise ConfigError(
            f"{where}: {option} is {cell}, which a shell does not split ({error}); needed: quotes "
            "in pairs around a name with spaces."
        ) from error
