"""Records that are kept with what was told of them, so that a run goes on where another ended."""

import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, TypeVar

from pimper_torch.errors import OutputError, caution
from pimper_torch.failures import skipped
from pimper_torch.journal import KEEP, aside, current, noted
from pimper_torch.records import Failure, LeftOut, Record, StageReport
from pimper_torch.store.store import Store, settled

AnyRecord = TypeVar("AnyRecord", bound=Record)

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
