"""Folders and files of data sets, and refusals of those of another layout."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, NoReturn, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.ground.geometry.rigid import rigid
from pimper_torch.ground.shapes import Matrix3, Pose, Vector
from pimper_torch.runtime.errors import InputError, shortened, some

T = TypeVar("T")


class DataSetPath(NamedTuple):
    """A folder or file of a data set.

    Attributes:
        kind: The data set, as its users call it.
    """

    path: Path
    kind: str

    def inner(self, name: str | Path) -> "DataSetPath":
        """Return a file or folder inside."""
        return self._replace(path=self.path / name)

    def refuse(self, needed: str, found: str | None = None) -> NoReturn:
        """Refuse it.

        Args:
            found: What is there instead; by default what the folder holds.
        """
        found = contents(self.path) if found is None else found
        raise InputError(
            f"{self.path}: not the layout of {self.kind}. Needed: {shortened(needed, 400)}. "
            f"Found: {shortened(found, 400)}. Point to the folder that holds it, or choose "
            "the reader of another layout."
        )

    def expect(self, ok: bool, needed: str, found: str | None = None) -> None:
        """Refuse it unless it is as needed."""
        if not ok:
            self.refuse(needed, found)

    def read(self, reader: Callable[[Path], T], what: str) -> T:
        """Read the file.

        Args:
            what: The format, for messages.

        Raises:
            InputError: There is no such file, or the reader fails.
        """
        parent = self._replace(path=self.path.parent)
        parent.expect(self.path.is_file(), f"a file {self.path.name}")
        try:
            return reader(self.path)
        except (InputError, MemoryError):
            raise
        except Exception as error:  # every parser has its own kinds
            raise InputError(
                f"{self.path}: cannot be read as {what} ({error}); needed: {what} of {self.kind}. "
                "Copy it again, or write it anew."
            ) from error

    def read_text(self) -> str:
        """Read a text file, or refuse it."""
        return self.read(lambda path: path.read_text(encoding="utf-8-sig"), "a text in UTF-8")

    def read_json(self) -> dict[str, object]:
        """Read a JSON file of one object, or refuse it."""
        found = self.read(lambda path: json.loads(path.read_text("utf-8-sig")), "JSON in UTF-8")
        self.expect(isinstance(found, dict), "a JSON object", f"a {type(found).__name__}")
        return dict(found)

    def inside(self, name: str) -> Path:
        """Join a path that a file of the data set names to its folder.

        Links in the folder are followed wherever they lead: whoever put them there wants that.

        Raises:
            InputError: The path is absolute, leads out by ``..``, or is no path.
        """
        sizes = [len(part.encode("utf-8", "surrogatepass")) for part in Path(name).parts]
        self.expect(max(sizes, default=0) <= 255, "names of files", f"{name!r}")
        within = os.path.normpath(name)
        stays = not Path(name).anchor and Path(within).parts[:1] != ("..",) and "\0" not in name
        self.expect(stays, "paths that stay in this folder", f"{name!r}, which leads out of it")
        return self.path / within

    def objects(self, value: object, what: str) -> list[dict[str, object]]:
        """Return a value of the file as a list of objects; refuse anything else, or none."""
        entries = list(value) if isinstance(value, list) else []
        ok = bool(entries) and all(isinstance(entry, dict) for entry in entries)
        self.expect(ok, f"a list of objects as {what}", _shown(value))
        return entries

    def numbers(self, value: object, count: int, what: str) -> Float[Tensor, " number"]:
        """Return a value of the file as ``count`` finite numbers in float64; refuse others.

        Args:
            value: Numbers, or texts of numbers, in a list, a list of lists, one text or alone.
        """
        pieces = value.split() if isinstance(value, str) else value
        try:
            array = np.asarray(pieces, dtype=np.float64).reshape(-1)
        except (ValueError, TypeError, OverflowError):
            array = np.full(1, np.nan)
        ok = len(array) == count and bool(np.isfinite(array).all())
        plural = "s" if count > 1 else ""
        self.expect(ok, f"{count} finite number{plural} as {what}", _shown(value))
        return torch.from_numpy(array.copy())

    def rigid(self, rotation: Matrix3, translation: Vector, what: str) -> Pose:
        """Return the rigid transform of a rotation, made exact, and a translation of the file."""
        U, _, Vh = torch.linalg.svd(rotation)
        nearest = U @ Vh
        off = float((rotation - nearest).abs().max())
        mirrored = bool(torch.linalg.det(nearest) < 0)
        found = f"a matrix that is {off:.2g} off the nearest rotation"
        # Files round a rotation to some digits; more than this is a scale or a reflection.
        sound = off <= 0.01 and not mirrored
        self.expect(sound, f"a rotation in {what}", "a reflection" if mirrored else found)
        return rigid(nearest, translation)


def contents(path: Path) -> str:
    """List a folder's contents, for a message."""
    if path.is_dir():
        names = sorted(inner.name for inner in path.iterdir())
        return some(names) if names else "an empty folder"
    return "a file" if path.exists() else "nothing there"


def _shown(value: object) -> str:
    return "nothing" if value is None else shortened(repr(value), 80)
