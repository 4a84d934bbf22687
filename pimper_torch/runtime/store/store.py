"""A folder of records that runs find again."""

import json
import math
import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from pimper_torch.records import Failure, LeftOut, Record, StageReport
from pimper_torch.records.stored import as_json, load_with_metadata, of_json, save_record
from pimper_torch.runtime.errors import InputError, OutputError, caution
from pimper_torch.runtime.failures import skipped
from pimper_torch.runtime.journal import KEEP, aside, current, noted
from pimper_torch.runtime.mapped import copied
from pimper_torch.runtime.store.digest import digest

AnyRecord = TypeVar("AnyRecord", bound=Record)

_Events = tuple[str | Failure | LeftOut | StageReport, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Store:
    """A folder with a file a record, named by a key, in which is a hash of the record's bits.

    A record is believed when its hash is right: what was damaged is as if it were not there, so
    that runs can share the folder. Where it grows too large, the records are deleted that were used
    longest ago.

    Attributes:
        folder: Made when the first record is kept.
        max_bytes: Of all files together.
        fresh: Find nothing of what is there; what is kept takes its place.
    """

    folder: Path | str
    max_bytes: float = math.inf
    fresh: bool = False

    def find(self, key: str, cls: type[AnyRecord]) -> tuple[AnyRecord, dict[str, Any]] | None:
        """Read a record; ``None`` where there is none, or a damaged one."""
        path = self._path(key)
        if self.fresh or not path.exists():
            return None
        try:
            record, metadata = load_with_metadata(cls, path)
            about = metadata.get("about", "")
            if metadata.get("digest") != digest(record, about):
                return None
        except InputError:
            return None
        with suppress(OSError):  # a folder that may only be read
            os.utime(path)
        return realigned(record), json.loads(about)

    def keep(self, key: str, record: Record, about: Mapping[str, object] | None = None) -> bool:
        """Write a record in place of one of the same key.

        Args:
            record: Of any class that :func:`~pimper_torch.records.stored.save_record` takes.
            about: What else is to be known of it: what JSON holds, and records without tensors.

        Returns:
            Whether it is kept: it is not where it alone is larger than the folder may be.
        """
        text = as_json(about or {})
        hashed = digest(record, text)
        if hashed is None:
            return False
        try:
            save_record(record, self._path(key), {"digest": hashed, "about": text})
        except InputError:  # a record that no file can hold
            return False
        except OutputError as error:
            raise OutputError(
                f"{self.folder}: what was found cannot be kept there ({error}). Free space, or "
                "give a folder that may be written."
            ) from error
        with suppress(OSError):  # another run deletes, too
            self._bound()
        return self._path(key).exists()

    def _bound(self) -> None:
        """Delete what was used longest ago until the rest is small enough."""
        for path in Path(self.folder).glob(".*.new-*"):
            if time.time() - path.stat().st_mtime > 86_400:  # a day: its run is no more
                path.unlink()
        about = {path: path.stat() for path in Path(self.folder).glob("*.safetensors")}
        total = sum(each.st_size for each in about.values())
        for path in sorted(about, key=lambda path: about[path].st_mtime_ns):
            if total > self.max_bytes:
                path.unlink(missing_ok=True)
                total -= about[path].st_size

    def _path(self, key: str) -> Path:
        return Path(self.folder) / f"{key}.safetensors"


def opened(cache: Store | Path | str | None) -> Store | None:
    """Take a folder for a store; ``None`` keeps nothing."""
    return cache if cache is None or isinstance(cache, Store) else Store(folder=cache)


def realigned(record: AnyRecord) -> AnyRecord:
    """Copy tensors that are not contiguous at an address of torch's; others stay as they are.

    Stages compute the same bits from two records of equal values once both are settled: products
    of matrices round otherwise at other strides or addresses. Fields that share a tensor share one
    still. Differentiable.
    """
    copies: dict[int, Tensor] = {}

    def one(value: object) -> object:
        if not isinstance(value, Tensor) or value.layout != torch.strided:
            return value
        if value.is_contiguous() and value.data_ptr() % 64 == 0:
            return value
        return copies.setdefault(id(value), copied(value))

    return pytree.tree_map(one, record)


def kept(
    store: Store | None, key: str | None, cls: type[AnyRecord], make: Callable[[], AnyRecord]
) -> tuple[AnyRecord, float]:
    """Return a record that an earlier run kept, or make it and keep it.

    What the earlier run reported, skipped and warned of is told again. Where a record cannot be
    kept, a warning says so.

    Args:
        key: A hash of all that the record depends on; ``None`` where that is not known.

    Returns:
        The record, and the seconds of wall clock in which it was made.
    """
    with aside(KEEP):
        found = store.find(key, cls) if store and key else None
    if found is not None:
        record, about = found
        for event in of_json(about["events"], _Events, "events", {}):
            _replay(event)
        return record, about["seconds"]
    began = time.perf_counter()
    with noted() as events:
        record = realigned(make())
    seconds = time.perf_counter() - began
    if store and key:
        try:
            with aside(KEEP):
                store.keep(key, record, {"seconds": seconds, "events": tuple(events)})
        except OutputError as error:
            caution(str(error))
    return record, seconds


def _replay(event: str | Failure | LeftOut | StageReport) -> None:
    journal = current()
    if isinstance(event, str):
        caution(event)
    elif isinstance(event, Failure):
        skipped(event)
    elif isinstance(event, LeftOut) and journal.collects:
        journal.note(event)
    elif isinstance(event, StageReport) and journal.observer is not None:
        journal.observer.started(event.name)
        journal.note(event.replace(kept=True))
        journal.observer.finished(event.replace(kept=True))
