"""The base of every record that travels between stages."""

import dataclasses
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

AnyRecord = TypeVar("AnyRecord", bound="Record")


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """Frozen data with a few verbs: move it, change a field in a copy, show it briefly.

    Frozen stops rebinding, not writing into a tensor; stages never write into what they
    were handed.
    """

    def to(
        self: AnyRecord,
        target: torch.device | str | torch.dtype,
        dtype: torch.dtype | None = None,
    ) -> AnyRecord:
        """Copy every tensor, in nested records and tuples too, to a device, a dtype, or both.

        Args:
            target: A device, or a dtype alone: ``to("cuda")``, ``to(torch.float64)``,
                ``to("cuda", torch.float64)``.
            dtype: Of floating-point tensors. Integers and masks keep theirs.
        """
        if isinstance(target, torch.dtype):
            return _moved(self, None, target)
        return _moved(self, torch.device(target), dtype)

    def replace(self: AnyRecord, **changes: object) -> AnyRecord:
        """Return a copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def __repr__(self) -> str:
        fields = ", ".join(
            f"{field.name}={_brief(getattr(self, field.name))}"
            for field in dataclasses.fields(self)
        )
        return f"{type(self).__name__}({fields})"


def _moved(  # gives a record for a record, a tensor for a tensor
    value: Any,  # noqa: ANN401
    device: torch.device | None,
    dtype: torch.dtype | None,
) -> Any:  # noqa: ANN401
    if isinstance(value, Tensor):
        return value.to(device=device, dtype=dtype if value.is_floating_point() else None)
    if isinstance(value, Record):
        moved = {
            field.name: _moved(getattr(value, field.name), device, dtype)
            for field in dataclasses.fields(value)
        }
        return dataclasses.replace(value, **moved)
    if isinstance(value, tuple):
        return tuple(_moved(item, device, dtype) for item in value)
    return value


def _brief(value: object) -> str:
    if isinstance(value, Tensor):
        kind = str(value.dtype).removeprefix("torch.")
        return f"{kind}{list(value.shape)}"
    if isinstance(value, tuple) and len(value) > 3:
        return f"({_brief(value[0])}, ... {len(value)} in all)"
    return repr(value)
