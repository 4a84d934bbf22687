"""Objects of a batch, from a folder of folders or a CSV table."""

import csv
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pimper_torch.cli.options import every_option, refuse_result
from pimper_torch.export.result_folder.files import require_name
from pimper_torch.runtime.errors import ConfigError, InputError, some

# Files of the batch itself in OUT, next to the objects' folders.
CSV, HTML = "batch.csv", "batch.html"

_PATHS = ("DIR", "FILE", "PATH")
_NAMED = ("--preset", "--segmenter")  # a name, or a file
_YES, _NO = ("yes", "true", "1"), ("no", "false", "0")


@dataclass(frozen=True, slots=True, kw_only=True)
class Object:
    """Photographs of one object, and options for its reconstruction.

    Attributes:
        name: Name of its folder in the folder of the batch.
        settings: Options of ``pimper reconstruct`` with their values, as on its command line.
        where: Position in a list, for messages.
    """

    name: str
    photos: Path | str
    settings: tuple[str, ...] = ()
    where: str = ""

    def __post_init__(self) -> None:
        where = f"{self.where or self.photos}: the name"
        require_name(self.name, InputError)
        valid = self.name.isprintable() and not re.search(r"^[.\s]|[/\\]|\s$", self.name)
        if not valid or self.name in ("", CSV, HTML):
            raise InputError(
                f"{where} is {self.name!r}; needed: a name for a folder in OUT, without / or \\, "
                f"that does not begin with a dot and is not {CSV} or {HTML}."
            )


def read_objects(given: Path | str | Sequence["Object | Path | str"]) -> list[Object]:
    """Return the objects of a folder, of a table, or of a list of folders.

    Args:
        given: A folder of folders, each with photographs or with a folder ``photos``; a CSV file
            whose columns are ``photos``, ``name`` and options of ``pimper reconstruct`` without
            dashes; or several objects or folders.
    """
    if not isinstance(given, Path | str):
        objects = [item if isinstance(item, Object) else _in_folder(Path(item)) for item in given]
    elif Path(given).is_dir():
        refuse_result(Path(given))
        paths = (path for path in sorted(Path(given).iterdir()) if not path.name.startswith("."))
        objects = [_in_folder(path) for path in paths if path.is_dir()]
    else:
        objects = _in_table(Path(given))
    where = str(given) if isinstance(given, Path | str) else "the list"
    if not objects:
        raise InputError(
            f"{where}: no objects; needed: a folder of folders of photographs, or a CSV file with "
            "a column `photos`. For one object, run `pimper reconstruct`."
        )
    counts = Counter(item.name.casefold() for item in objects)  # some disks ignore case
    same = [f"{item.photos} ({item.name})" for item in objects if counts[item.name.casefold()] > 1]
    if same:
        raise InputError(
            f"{where}: several objects have one name: {some(same)}; needed: different names. Give "
            "a CSV file with a column `name`."
        )
    return objects


def _in_folder(
    folder: Path, name: str = "", settings: tuple[str, ...] = (), where: str = ""
) -> Object:
    """Return the object of a folder, by default with the name of the folder or link."""
    named = folder if folder.name not in ("", "..") else folder.resolve()
    photos = folder / "photos" if (folder / "photos").is_dir() else folder
    return Object(name=name or named.name, photos=photos, settings=settings, where=where)


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
    if reserved := {"out", "o", "overwrite", "view"} & {*columns}:
        raise ConfigError(
            f"{path}: has the column {min(reserved)}, which only `pimper batch` itself may set."
        )
    kinds = {name: option.value for option in every_option("reconstruct") for name in option.names}
    objects = []
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
        objects.append(_in_folder(path.parent / photos, name, (*settings,), where))
    return objects


def _words(where: str, option: str, cell: str, kinds: Mapping[str, str], base: Path) -> list[str]:
    """Return a cell as words of a command line; paths are relative to the table."""
    kind = kinds.get(option)
    if kind == "" and cell.lower() in (*_YES, *_NO):
        stage, dot, last = option[2:].rpartition(".")
        negated = f"--{stage}{dot}no-{last}"
        return [option] if cell.lower() in _YES else [negated] if negated in kinds else []
    if kind in _PATHS or (option in _NAMED and (base / cell).is_file()):
        cell = str((base / cell).absolute())
    try:
        return [option, *(shlex.split(cell) if kind and " " in kind else [cell])]
    except ValueError as error:
        raise ConfigError(
            f"{where}: {option} is {cell}, which cannot be split into words ({error}); needed: "
            "quotes in pairs around a name with spaces."
        ) from error
