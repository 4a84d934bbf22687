"""A folder of records that later runs reuse."""

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

from pimper_torch.records import Record
from pimper_torch.records.stored import as_json, load_with_metadata, of_json, save_record
from pimper_torch.runtime.errors import InputError, OutputError, caution
from pimper_torch.runtime.events import Caution, Event, Failure, Removal, StageReport, StageStarted
from pimper_torch.runtime.failures import skipped
from pimper_torch.runtime.mapped import copied
from pimper_torch.runtime.reporting import ASIDE, KEEP, aside
from pimper_torch.runtime.stream import collected, emit
from pimper_torch.store.digest import digest, known_hashes

AnyRecord = TypeVar("AnyRecord", bound=Record)

_Events = tuple[Caution | Failure | Removal | StageReport, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Store:
    """A folder with one file per record, named by a key.

    Each file contains a hash of the record's bits. Files with a wrong hash are ignored, so runs can
    share the folder. If the folder grows too large, the least recently used records are deleted.

    Attributes:
        folder: Created with the first record.
        max_bytes: Maximum size of all files together.
        fresh: Ignore existing records; new ones replace them.
    """

    folder: Path | str
    max_bytes: float = math.inf
    fresh: bool = False

    def find(self, key: str, cls: type[AnyRecord]) -> tuple[AnyRecord, dict[str, Any]] | None:
        """Return a record and its ``about``; ``None`` if it is missing or damaged."""
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
        with suppress(OSError):  # a read-only folder
            os.utime(path)
        return realigned(record), json.loads(about)

    def keep(self, key: str, record: Record, about: Mapping[str, object] | None = None) -> bool:
        """Write a record; it replaces a record with the same key.

        Args:
            record: Of any class that :func:`~pimper_torch.records.stored.save_record` supports.
            about: Further information: JSON types, and records without tensors.

        Returns:
            Whether it is kept; not if it cannot be hashed or stored, or exceeds ``max_bytes``.
        """
        text = as_json(about or {})
        hashed = digest(record, text)
        if hashed is None:
            return False
        try:
            save_record(record, self._path(key), {"digest": hashed, "about": text})
        except InputError:  # a record that files cannot represent
            return False
        except OutputError as error:
            raise OutputError(
                f"{self.folder}: records cannot be kept there ({error}). Free space, or choose a "
                "writable folder."
            ) from error
        with suppress(OSError):  # other runs may delete the same files
            self._bound()
        return self._path(key).exists()

    def _bound(self) -> None:
        """Delete the least recently used records until the others are small enough."""
        for path in Path(self.folder).glob(".*.new-*"):
            if time.time() - path.stat().st_mtime > 86_400:  # a day old: its run has ended
                path.unlink()
        stats = {path: path.stat() for path in Path(self.folder).glob("*.safetensors")}
        total = sum(stat.st_size for stat in stats.values())
        for path in sorted(stats, key=lambda path: stats[path].st_mtime_ns):
            if total > self.max_bytes:
                path.unlink(missing_ok=True)
                total -= stats[path].st_size

    def _path(self, key: str) -> Path:
        return Path(self.folder) / f"{key}.safetensors"


def opened(cache: Store | Path | str | None) -> Store | None:
    """Return a folder as a store; ``None`` keeps nothing."""
    return cache if cache is None or isinstance(cache, Store) else Store(folder=cache)


def realigned(record: AnyRecord) -> AnyRecord:
    """Return the record with contiguous tensors at aligned addresses; other tensors are copied.

    Stages then compute the same bits from records of equal values: matrix products round
    differently at other strides or addresses. Shared tensors stay shared. Differentiable.
    """
    copies: dict[int, Tensor] = {}

    def align(value: object) -> object:
        if not isinstance(value, Tensor) or value.layout != torch.strided:
            return value
        if value.is_contiguous() and value.data_ptr() % 64 == 0:
            return value
        copy = copies.setdefault(id(value), copied(value))
        known = known_hashes.get(value)  # type: ignore[no-untyped-call]
        versions = known and not (value.is_inference() or copy.is_inference())
        if versions and known[0] == value._version:
            known_hashes[copy] = (copy._version, known[1])
        return copy

    return pytree.tree_map(align, record)


def kept(
    store: Store | None, key: str | None, cls: type[AnyRecord], make: Callable[[], AnyRecord]
) -> tuple[AnyRecord, float]:
    """Return a record kept by an earlier run, or compute and keep it.

    Reports, failures and warnings of the earlier run are repeated. Failed writes give a warning.

    Args:
        key: A hash of everything that the record depends on; ``None`` if that is unknown.

    Returns:
        The record, and the seconds of wall clock in which it was computed.
    """
    with aside(KEEP):
        stored = store.find(key, cls) if store and key else None
    if stored is not None:
        record, about = stored
        for event in of_json(about["events"], _Events, "events", {}):
            _repeat(event)
        return record, about["seconds"]
    began = time.perf_counter()
    with collected(Caution, Failure, Removal, StageReport, passed_on=True) as events:
        record = realigned(make())
    seconds = time.perf_counter() - began
    if store and key:
        try:
            with aside(KEEP):
                store.keep(key, record, {"seconds": seconds, "events": tuple(events)})
        except OutputError as error:
            caution(str(error))
    return record, seconds


def _repeat(event: Event) -> None:
    if isinstance(event, Caution):
        caution(event.message)
    elif isinstance(event, Failure):
        skipped(event)
    elif not isinstance(event, StageReport):
        emit(event)
    elif event.name not in ASIDE and emit(StageStarted(name=event.name)):
        emit(event.replace(kept=True))
