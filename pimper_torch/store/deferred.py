"""Tensors with a known hash that are read only if a stage needs their values."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils.weak import WeakTensorKeyDictionary

from pimper_torch.store.digest import known_hashes

Value = TypeVar("Value")

_readers: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def deferred(shape: Sequence[int], hashed: str, read: Callable[[], Tensor]) -> Tensor:
    """Return a tensor of NaN without memory, which has the hash of the one that it stands for.

    Args:
        hashed: By :func:`~pimper_torch.store.digest.tensor_hash`.
        read: Returns the tensor itself, for :func:`actual`.
    """
    tensor = torch.full((1,) * len(shape), torch.nan).expand(*shape)
    known_hashes[tensor], _readers[tensor] = (tensor._version, hashed), read
    return tensor


def actual(value: Value) -> Value:
    """Return records, or tuples and mappings of them, with deferred tensors read."""

    def is_deferred(leaf: object) -> bool:
        return isinstance(leaf, Tensor) and leaf in _readers

    if any(map(is_deferred, pytree.tree_leaves(value))):
        value = pytree.tree_map(lambda leaf: _readers[leaf]() if is_deferred(leaf) else leaf, value)
    return value
