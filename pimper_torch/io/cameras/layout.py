"""Folders and files of data sets, with errors that name the expected layout."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, NoReturn, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.rigid import rigid
from pimper_torch.records.shapes import Matrix3, Pose, Vector
from pimper_torch.runtime.errors import InputError, shortened, some

T = TypeVar("T")


class DataSetPath(NamedTuple):
    """A folder or file of a data set.

    Attributes:
        kind: Name of the data set in messages, such as "a transforms.json set".
    """

    path: Path
    kind: str

    def inner(self, name: str | Path) -> "DataSetPath":
        """Return a file or folder inside this one."""
        return self._replace(path=self.path / name)

    def refuse(self, needed: str, found: str | None = None) -> NoReturn:
        """Raise an ``InputError`` for a different layout.

        Args:
            found: The content found instead; by default that of the folder.
        """
        found = contents(self.path) if found is None else found
        raise InputError(
            f"{self.path}: not the layout of {self.kind}. Needed: {shortened(needed, 400)}. "
            f"Found: {shortened(found, 400)}. Give the folder that contains it, or choose "
            "a different format."
        )

    def expect(self, ok: bool, needed: str, found: str | None = None) -> None:
        """Raise an ``InputError`` as :meth:`refuse` unless ``ok``."""
        if not ok:
            self.refuse(needed, found)

    def read(self, reader: Callable[[Path], T], what: str) -> T:
        """Return the content of the file as parsed by ``reader``.

        Args:
            what: The format, for messages.

        Raises:
            InputError: The file does not exist, or the reader fails.
        """
        parent = self._replace(path=self.path.parent)
        parent.expect(self.path.is_file(), f"a file {self.path.name}")
        try:
            return reader(self.path)
        except (InputError, MemoryError):
            raise
        except Exception as error:  # every parser raises errors of its own types
            raise InputError(
                f"{self.path}: cannot be read as {what} ({error}); needed: {what} of {self.kind}. "
                "Copy or export it again."
            ) from error

    def read_text(self) -> str:
        """Return the content of a text file."""
        return self.read(lambda path: path.read_text(encoding="utf-8-sig"), "text in UTF-8")

    def read_json(self) -> dict[str, object]:
        """Return the object in a JSON file."""
        content = self.read(lambda path: json.loads(path.read_text("utf-8-sig")), "JSON in UTF-8")
        self.expect(isinstance(content, dict), "a JSON object", f"a {type(content).__name__}")
        return dict(content)

    def inside(self, name: str) -> Path:
        """Return the path in this folder that a file of the data set names.

        Links in the folder are followed wherever they lead: their author intended that.

        Raises:
            InputError: The path is absolute, leads out by ``..``, or is not a path.
        """
        sizes = [len(part.encode("utf-8", "surrogatepass")) for part in Path(name).parts]
        self.expect(max(sizes, default=0) <= 255, "file names of at most 255 bytes", f"{name!r}")
        path = os.path.normpath(name)
        is_inside = not Path(name).anchor and Path(path).parts[:1] != ("..",) and "\0" not in name
        self.expect(is_inside, "paths inside this folder", f"{name!r}, which leads out of it")
        return self.path / path

    def objects(self, value: object, what: str) -> list[dict[str, object]]:
        """Return a value of the file, which must be a list of objects that is not empty."""
        entries = list(value) if isinstance(value, list) else []
        ok = bool(entries) and all(isinstance(entry, dict) for entry in entries)
        self.expect(ok, f"a list of objects as {what}", _printed(value))
        return entries

    def numbers(self, value: object, count: int, what: str) -> Float[Tensor, " number"]:
        """Return a value of the file, which must be ``count`` finite numbers, in float64.

        Args:
            value: Numbers or their texts: single, in a list, in nested lists, or in one text.
        """
        pieces = value.split() if isinstance(value, str) else value
        try:
            array = np.asarray(pieces, dtype=np.float64).reshape(-1)
        except (ValueError, TypeError, OverflowError):
            array = np.full(1, np.nan)
        ok = len(array) == count and bool(np.isfinite(array).all())
        plural = "s" if count > 1 else ""
        self.expect(ok, f"{count} finite number{plural} as {what}", _printed(value))
        return torch.from_numpy(array.copy())

    def rigid(self, rotation: Matrix3, translation: Vector, what: str) -> Pose:
        """Return the rigid transform of the nearest rotation to a matrix, and a translation."""
        U, _, Vh = torch.linalg.svd(rotation)
        nearest = U @ Vh
        error = float((rotation - nearest).abs().max())
        mirrored = bool(torch.linalg.det(nearest) < 0)
        found = f"a matrix that differs by {error:.2g} from the nearest rotation"
        # Files round rotations to a few digits; larger errors are a scale or a reflection.
        valid = error <= 0.01 and not mirrored
        self.expect(valid, f"a rotation in {what}", "a reflection" if mirrored else found)
        return rigid(nearest, translation)


def contents(path: Path) -> str:
    """Return the names in a folder, for a message."""
    if path.is_dir():
        names = sorted(inner.name for inner in path.iterdir())
        return some(names) if names else "an empty folder"
    return "a file" if path.exists() else "nothing"


def _printed(value: object) -> str:
    return "nothing" if value is None else shortened(repr(value), 80)
