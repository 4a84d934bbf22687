"""One layout in memory for a record that was just found and one that was read from a file."""

from typing import TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from pimper_torch.records import Record

AnyRecord = TypeVar("AnyRecord", bound=Record)

# Bytes; torch allocates so. Matrix products of other strides or addresses round otherwise: a batch
# of 3x3 products from a mapped file differed by 5e-15.
_ALIGNMENT = 64


def settled(record: AnyRecord) -> AnyRecord:
    """Copy tensors that are not contiguous at an aligned address; others stay what they are.

    Stages compute the same bits from two records whose values have the same, once both are
    settled. Fields that share a tensor share one still. Differentiable.
    """
    copies: dict[int, Tensor] = {}

    def one(value: object) -> object:
        if not isinstance(value, Tensor) or value.layout != torch.strided:
            return value
        if value.is_contiguous() and value.data_ptr() % _ALIGNMENT == 0:
            return value
        return copies.setdefault(id(value), value.clone(memory_format=torch.contiguous_format))

    found: AnyRecord = pytree.tree_map(one, record)
    return found
