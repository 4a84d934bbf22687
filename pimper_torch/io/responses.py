"""Responses of photographs: measured curves, and contradictions with the files' metadata."""

import csv
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from pimper_torch.io.header import Header
from pimper_torch.radiometry import Curve, Encoding, Gamma, Linear, Response, Srgb
from pimper_torch.radiometry.colour import describe, disagree
from pimper_torch.radiometry.response import curve_from_table
from pimper_torch.runtime.errors import InputError, caution, some
from pimper_torch.runtime.numpy_files import read_npy

_LAYOUT = (
    "one column of radiance, or three for red, green and blue, for the levels 0, 1, 2, ...; or two "
    "or four columns, the first with the level"
)

_NUMBER = re.compile(r"\s*([-+.\d]|nan\b|inf\b)", re.IGNORECASE)  # its start


def response_of(encoding: Encoding) -> Response:
    """Return the response of the settings, read from its file if it is measured.

    ``auto`` is sRGB, the default for files that state no response.
    """
    choice = encoding.response
    if choice in ("auto", "srgb"):
        return Srgb()
    if choice == "linear":
        return Linear()
    if isinstance(choice, int | float):
        return Gamma(exponent=float(choice))
    return read_curve(Path(choice))


def read_curve(path: Path | str) -> Curve:
    """Read a measured inverse response: the radiance of each level.

    The table has one column, the radiance of the levels 0, 1, 2, ...; three, for red, green
    and blue; or two or four, the first with the level. Levels go from 0 to 1 (fractions of
    full scale), to 255 (files of 8 bits), or higher (16 bits). Radiance is in any unit.

    ``.csv`` has rows of numbers, and may have a first row of names; ``.npy`` has rows, such as
    those of OpenCV's ``CalibrateDebevec`` with its colours in reverse order.

    Raises:
        InputError: The file does not exist, is of a different kind, or has no table of numbers
            or no curve: see :func:`~pimper_torch.radiometry.response.curve_from_table`.
    """
    path = Path(path)
    readers: Mapping[str, Callable[[Path], np.ndarray]] = {".csv": _read_csv, ".npy": _read_npy}
    reader = readers.get(path.suffix.lower())
    if reader is None or not path.is_file():
        found = "no such file" if reader else f"a {path.suffix} file" if path.suffix else "no file"
        raise InputError(
            f"{path}: is not a response of photographs ({found}); needed: srgb, linear, the "
            f"exponent of a gamma curve, or a file ending in {', '.join(readers)}."
        )
    if path.stat().st_size > 20_000_000:  # 65536 levels of three colours need 5 MB as text
        raise InputError(f"{path}: has {path.stat().st_size} bytes; needed: a small table.")
    try:
        table = reader(path)
    except (OSError, ValueError, TypeError, OverflowError, csv.Error) as error:
        raise InputError(
            f"{path}: has no table of a response curve ({str(error)[:200]}); needed: {_LAYOUT}."
        ) from error
    if table.ndim != 2 or not 1 <= table.shape[1] <= 4:
        raise InputError(
            f"{path}: has a table of {' x '.join(str(side) for side in table.shape)}; needed: "
            f"{_LAYOUT}."
        )
    columns = torch.from_numpy(np.ascontiguousarray(table.T))
    if len(columns) in (1, 3):
        columns = torch.cat([torch.arange(columns.shape[1])[None].double(), columns])
    try:
        return curve_from_table(columns[0], columns[1:])
    except InputError as error:
        raise InputError(f"{path}: is not a response curve: {error}") from error


def _read_csv(path: Path) -> np.ndarray:
    text = path.read_text(encoding="utf-8-sig")
    comma = ";" if ";" in text else ","
    rows = [row for row in csv.reader(text.splitlines(), delimiter=comma) if any(row)]
    if rows and not any(_NUMBER.match(cell) for cell in rows[0]):
        rows = rows[1:]
    if len({len(row) for row in rows}) != 1:
        raise ValueError("it has no rows, or rows of different lengths")
    return np.array([[float(cell) for cell in row] for row in rows])


def _read_npy(path: Path) -> np.ndarray:
    table = read_npy(path)
    if table.dtype.kind not in "iuf":
        raise ValueError("it is not an array of numbers")
    if table.ndim == 3 and table.shape[1] == 1:  # OpenCV's layout
        table = table[:, 0]
    return (table[:, None] if table.ndim == 1 else table).astype(np.float64)


# Part of the warning that the files' metadata differ from the given response.
CONTRADICTED = "the given response is used"


def warn_of_responses(
    folder: Path | str, paths: Sequence[Path | str], headers: Sequence[Header], encoding: Encoding
) -> None:
    """Warn of metadata of photographs that are not applied.

    Args:
        encoding: As given. A measured curve is not compared with the files' metadata.

    Raises:
        InputError: Names a file with unsupported colours, unless a response is given.
    """
    names_of: dict[str, list[str]] = defaultdict(list)
    for path, header in zip(paths, headers, strict=True):
        sentences, stated = [*header.cautions], header.colour
        if stated.trouble and encoding.response == "auto":
            raise InputError(
                f"{path}: {stated.source} {stated.trouble}, which is not supported; needed: sRGB, "
                "or a profile with tone curves and primaries such as Display P3. Convert it with a "
                "program that supports it, such as GIMP or ImageMagick, or give the true response "
                "with `photographs.response`."
            )
        if stated.trouble:
            sentences.append(
                f"{stated.source} {stated.trouble}, which is not supported; the given response is "
                "used, with the primaries of sRGB"
            )
        elif stated.response is not None and not isinstance(encoding.response, Path):
            given = response_of(encoding)
            if encoding.response != "auto" and disagree(given, stated.response):
                sentences.append(
                    f"the response {describe(given)} is given, but {stated.source} states "
                    f"{describe(stated.response)}; the given response is used. Remove "
                    "`photographs.response` to use that of the files"
                )
        for sentence in sentences:
            names_of[sentence].append(Path(path).name)
    for sentence, names in names_of.items():
        caution(
            f"{folder}: {len(names)} of {len(paths)} photographs ({some(names, 4)}): {sentence}.",
            stacklevel=3,
        )
