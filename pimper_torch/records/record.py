"""The base of every record that travels between stages."""

import dataclasses
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

AnyRecord = TypeVar("AnyRecord", bound="Record")


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """Frozen data with a few verbs: move it, change a field in a copy, show it briefly.

    Frozen stops rebinding, not writing into a tensor; stages never write into what they
    were handed.
    """

    def to(self: AnyRecord, device: torch.device | str) -> AnyRecord:
        """Copy every tensor, in nested records and tuples too, to ``device``."""
        moved = {
            field.name: _moved(getattr(self, field.name), device)
            for field in dataclasses.fields(self)
        }
        return dataclasses.replace(self, **moved)

    def replace(self: AnyRecord, **changes: object) -> AnyRecord:
        """Return a copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def __repr__(self) -> str:
        fields = ", ".join(
            f"{field.name}={_brief(getattr(self, field.name))}"
            for field in dataclasses.fields(self)
        )
        return f"{type(self).__name__}({fields})"


def _moved(value: object, device: torch.device | str) -> object:
    if isinstance(value, Tensor | Record):
        return value.to(device)
    if isinstance(value, tuple):
        return tuple(_moved(item, device) for item in value)
    return value


def _brief(value: object) -> str:
    if isinstance(value, Tensor):
        kind = str(value.dtype).removeprefix("torch.")
        return f"{kind}{list(value.shape)}"
    if isinstance(value, tuple) and len(value) > 3:
        return f"({_brief(value[0])}, ... {len(value)} in all)"
    return repr(value)
