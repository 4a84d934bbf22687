"""A folder of records that runs find again."""

import json
import math
import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from pimper_torch.records import Failure, LeftOut, Record, StageReport
from pimper_torch.records.stored import load_record, save_record
from pimper_torch.runtime.errors import OutputError, PimperError, caution
from pimper_torch.runtime.failures import skipped
from pimper_torch.runtime.journal import KEEP, aside, current, noted
from pimper_torch.runtime.mapped import copied
from pimper_torch.runtime.store.digest import digest

AnyRecord = TypeVar("AnyRecord", bound=Record)

_RECORD, _ABOUT = ".safetensors", ".json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Store:
    """A folder with two files a record, named by a key: the record, and a hash of its bits.

    A record is believed when its hash is right: what was damaged or cut short is as if it were not
    there, so that runs can share the folder. Where it grows too large, the records are deleted that
    were used longest ago.

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
        if self.fresh:
            return None
        try:
            about = json.loads(self._path(key, _ABOUT).read_bytes())
            record = load_record(cls, self._path(key, _RECORD))
            if about["digest"] != digest(record):
                return None
            found = settled(record), dict(about["about"])
        except (OSError, ValueError, KeyError, TypeError, RecursionError, PimperError):
            return None
        for kind in (_RECORD, _ABOUT):
            with suppress(OSError):  # a folder that may only be read
                os.utime(self._path(key, kind))
        return found

    def keep(self, key: str, record: Record, about: Mapping[str, object] | None = None) -> bool:
        """Write a record in place of one of the same key.

        Args:
            record: Of any class that :func:`~pimper_torch.records.stored.save_record` takes.
            about: What else is to be known of it; what JSON holds.

        Returns:
            Whether it is kept: it is not where it alone is larger than the folder may be.
        """
        hashed = digest(record)
        if hashed is None:
            return False
        text = json.dumps({"digest": hashed, "about": dict(about or {})})
        try:
            self._path(key, _ABOUT).unlink(missing_ok=True)
            save_record(record, self._path(key, _RECORD))
            self._path(key, _ABOUT).write_text(text, encoding="utf-8")
        except (OSError, OutputError) as error:
            self._forget(key)
            raise OutputError(
                f"{self.folder}: what was found cannot be kept there ({error}). Free space, or "
                "give a folder that may be written."
            ) from error
        with suppress(OSError):  # another run deletes, too
            self._bound()
        return self._path(key, _ABOUT).exists()

    def sizes(self) -> dict[str, int]:
        """Return the bytes of every record by its key, in the order they were last used in."""
        found = {path.stem: path.stat() for path in Path(self.folder).glob(f"*{_RECORD}")}
        used = sorted(found, key=lambda key: found[key].st_mtime_ns)
        return {key: found[key].st_size for key in used}

    def _bound(self) -> None:
        """Delete what was used longest ago until the rest is small enough."""
        for path in Path(self.folder).glob(".*.new-*"):
            if time.time() - path.stat().st_mtime > 86_400:  # a day: its run is no more
                path.unlink()
        sizes = self.sizes()
        total = sum(sizes.values())
        for key, size in sizes.items():
            if total > self.max_bytes:
                self._forget(key)
                total -= size

    def _forget(self, key: str) -> None:
        for kind in (_ABOUT, _RECORD):
            with suppress(OSError):
                self._path(key, kind).unlink(missing_ok=True)

    def _path(self, key: str, kind: str) -> Path:
        return Path(self.folder) / f"{key}{kind}"


def opened(cache: Store | Path | str | None) -> Store | None:
    """Take a folder for a store; ``None`` keeps nothing."""
    return cache if cache is None or isinstance(cache, Store) else Store(folder=cache)


def settled(record: AnyRecord) -> AnyRecord:
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

    found: AnyRecord = pytree.tree_map(one, record)
    return found


_EVENTS = {cls.__name__: cls for cls in (Failure, LeftOut, StageReport)}


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
        for event in about["events"]:
            _tell(event)
        return record, about["seconds"]
    began = time.perf_counter()
    with noted() as events:
        record = settled(make())
    seconds = time.perf_counter() - began
    if store and key:
        try:
            with aside(KEEP):
                store.keep(key, record, {"seconds": seconds, "events": list(map(_plain, events))})
        except OutputError as error:
            caution(str(error))
    return record, seconds


def _plain(event: object) -> object:
    """Turn an event into what JSON holds."""
    if not isinstance(event, Failure | LeftOut | StageReport):
        return event
    return {"kind": type(event).__name__, **asdict(event)}


def _tell(plain: str | dict[str, Any]) -> None:
    """Repeat an event of an earlier run."""
    if isinstance(plain, str):
        caution(plain)
        return
    fields: dict[str, Any] = dict(plain)
    if "names" in fields:
        fields["names"] = tuple(fields["names"])
    kind: Any = _EVENTS[fields.pop("kind")]
    event, journal = kind(**fields), current()
    if isinstance(event, Failure):
        skipped(event)
    elif isinstance(event, LeftOut) and journal.collects:
        journal.tell(event)
    elif isinstance(event, StageReport) and journal.observer is not None:
        journal.observer.started(event.name)
        journal.tell(event.replace(kept=True))
        journal.observer.finished(event.replace(kept=True))
