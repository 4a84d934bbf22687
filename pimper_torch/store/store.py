"""A folder of records that runs find again."""

import json
import math
import os
import secrets
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from pimper_torch.errors import OutputError, PimperError
from pimper_torch.records import Record
from pimper_torch.records.stored import load_record, save_record
from pimper_torch.store.digest import digest
from pimper_torch.store.settled import settled

AnyRecord = TypeVar("AnyRecord", bound=Record)

_RECORD, _ABOUT = ".safetensors", ".json"
_FORMAT = 1
# Seconds after which a file that was never finished belongs to a run that is no more.
_ABANDONED = 24 * 3600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept(Generic[AnyRecord]):
    """A record from the folder, and what was said when it was found.

    Attributes:
        record: Bit for bit, settled.
        about: What JSON holds.
    """

    record: AnyRecord
    about: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Store:
    """A folder with two files a record, named by a key: the record, and a hash of its bits.

    A record is believed when its hash is right: what was damaged or cut short is as if it were not
    there. Files are renamed into place when they are whole, so that runs can share the folder.
    Where the folder grows too large, the records are deleted that were used longest ago.

    Attributes:
        folder: Made when the first record is kept.
        max_bytes: Of all files together.
        fresh: Find nothing of what is there; what is kept takes its place.
    """

    folder: Path | str
    max_bytes: float = math.inf
    fresh: bool = False

    def find(self, key: str, cls: type[AnyRecord]) -> Kept[AnyRecord] | None:
        """Read a record; ``None`` where there is none, or a damaged one.

        Args:
            key: As it was kept under.
        """
        if self.fresh:
            return None
        try:
            about = json.loads(self._path(key, _ABOUT).read_bytes())
            record = load_record(cls, self._path(key, _RECORD))
            if about["format"] != _FORMAT or about["digest"] != digest(record):
                return None
            found = Kept(record=settled(record), about=dict(about["about"]))
        except (OSError, ValueError, KeyError, TypeError, RecursionError, PimperError):
            return None
        for kind in (_RECORD, _ABOUT):
            with suppress(OSError):  # a folder that may only be read
                os.utime(self._path(key, kind))
        return found

    def keep(self, key: str, record: Record, about: Mapping[str, object] | None = None) -> bool:
        """Write a record in place of one of the same key.

        Args:
            key: A file's name.
            record: Of any class that :func:`~pimper_torch.records.save_record` takes.
            about: What else is to be known of it; what JSON holds.

        Returns:
            Whether it is kept: it is not where it alone is larger than the folder may be.

        Raises:
            OutputError: The folder cannot be written.
        """
        hashed = digest(record)
        if hashed is None:
            return False
        text = json.dumps({"format": _FORMAT, "digest": hashed, "about": dict(about or {})})
        try:
            self._path(key, _ABOUT).unlink(missing_ok=True)
            save_record(record, self._path(key, _RECORD))
            _replace(self._path(key, _ABOUT), text)
        except (OSError, OutputError) as error:
            self._forget(key)
            raise OutputError(
                f"{self.folder}: what was found cannot be kept there ({error}). Free space, or "
                "give a folder that may be written."
            ) from error
        return self._bounded(key)

    def sizes(self) -> dict[str, int]:
        """Return the bytes that every key takes, in the order they were last used in."""
        used: dict[str, tuple[float, int]] = {}
        for path in Path(self.folder).glob(f"*{_RECORD}"):
            with suppress(OSError):  # another run deleted it
                status = path.stat()
                used[path.name.removesuffix(_RECORD)] = (status.st_mtime, status.st_size)
        return {key: used[key][1] for key in sorted(used, key=lambda key: used[key])}

    def _bounded(self, key: str) -> bool:
        """Delete what was used longest ago until the rest is small enough."""
        for path in Path(self.folder).glob(".*.new-*"):
            with suppress(OSError):
                if time.time() - path.stat().st_mtime > _ABANDONED:
                    path.unlink()
        sizes = self.sizes()
        total = sum(sizes.values())
        for other in [*(other for other in sizes if other != key), key]:
            if total <= self.max_bytes:
                break
            self._forget(other)
            total -= sizes.get(other, 0)
        return self._path(key, _ABOUT).exists()

    def _forget(self, key: str) -> None:
        for kind in (_ABOUT, _RECORD):
            with suppress(OSError):
                self._path(key, kind).unlink(missing_ok=True)

    def _path(self, key: str, kind: str) -> Path:
        return Path(self.folder) / f"{key}{kind}"


def _replace(path: Path, text: str) -> None:
    trial = path.with_name(f".{path.name}.new-{secrets.token_hex(4)}")
    try:
        trial.write_text(text, encoding="utf-8")
        trial.replace(path)
    finally:
        trial.unlink(missing_ok=True)


def opened(cache: Store | Path | str | None) -> Store | None:
    """Take a folder for a store; ``None`` keeps nothing."""
    return cache if cache is None or isinstance(cache, Store) else Store(folder=cache)
