"""Calls whose records are kept, so that a run goes on where an earlier one ended."""

import dataclasses
import typing
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from torch import Tensor, nn
from torch.utils import _pytree as pytree

from pimper_torch.errors import OutputError, caution, overheard
from pimper_torch.failures import distinct, skipped
from pimper_torch.ledger import kept_entries, noted_entries, repeat_entries
from pimper_torch.records import Failure, Record, StageReport
from pimper_torch.reporting import HASH, KEEP, aside, noted, repeat
from pimper_torch.store import Store, digest, settled
from pimper_torch.store.code import code, is_known

R = TypeVar("R")


def kept_call(
    store: Store | None,
    name: str,
    call: Callable[..., R],
    inputs: tuple[object, ...],
    derived: Mapping[str, object],
    settings: object = None,
) -> R:
    """Call a stage, or give what it gave for the same inputs in an earlier run.

    What the earlier run reported, skipped and warned of is told again. A stage of another package
    is called every time, as its code is not known, and so is one that gradients are asked of. What
    was found in smaller batches for lack of memory is not kept. Where the record cannot be kept, a
    warning says so.

    Args:
        store: Where records are; without, it is called.
        derived: What it is called with by name, which follows from the inputs.
        settings: What else the record depends on.
    """
    cls = _returns(call)
    if store is None or cls is None:
        return call(*inputs, **derived)
    with aside(HASH):
        own = all(map(is_known, _modules(call, *inputs)))
        hashed = digest(code(), call, settings, *inputs) if own else None
    if hashed is None:
        return call(*inputs, **derived)
    key = f"{name}-{hashed}"
    with aside(KEEP):
        found = store.find(key, cls)
    if found is not None:
        record, told = found
        skipped(*(Failure(**failure) for failure in told["failures"]))
        repeat_entries(told["left_out"])
        repeat([StageReport(**report) for report in told["reports"]])
        for message in told["cautions"]:
            caution(message)
        return typing.cast(R, _beside(record, inputs))
    with overheard() as cautions, noted() as reports, noted_entries() as entries:
        result = settled(typing.cast(Record, call(*inputs, **derived)))
    failures = distinct(entries)
    if any(failure.what == "memory" for failure in failures):
        return typing.cast(R, result)  # smaller batches round otherwise
    about = {
        "reports": list(map(dataclasses.asdict, reports)),
        "cautions": cautions,
        "failures": list(map(dataclasses.asdict, failures)),
        "left_out": kept_entries(entries),
    }
    try:
        with aside(KEEP):
            store.keep(key, result, about)
    except OutputError as error:
        caution(str(error))
    return typing.cast(R, result)


def _modules(call: Callable[..., object], *inputs: object) -> set[str]:
    """Name the Python modules of a function, and of all parts of stages."""
    stages = [value for value in (call, *inputs) if isinstance(value, nn.Module)]
    return {call.__module__} | {type(part).__module__ for one in stages for part in one.modules()}


def _returns(call: Callable[..., object]) -> type[Record] | None:
    """Return the record that a call is annotated to return."""
    function = call.forward if isinstance(call, nn.Module) else call
    cls: Any = typing.get_type_hints(function).get("return")
    return cls if isinstance(cls, type) and issubclass(cls, Record) else None


def _beside(record: Record, inputs: tuple[object, ...]) -> Record:
    """Put a record on the device of the inputs."""
    records = [value for value in inputs if isinstance(value, Record)]
    tensors = [leaf for leaf in pytree.tree_leaves(records) if isinstance(leaf, Tensor)]
    return record.to(tensors[0].device) if tensors else record
