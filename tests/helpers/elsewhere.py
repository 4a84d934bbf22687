"""A simulated device: tensors appear to be on it, and the CPU computes them.

As on a GPU, operations on tensors of two devices are refused, and so is numpy.
"""

from types import TracebackType
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

ELSEWHERE = torch.device("meta")
# Operations that accept CPU tensors as indices or values, or copy between devices.
_CROSSING = {"__getitem__", "__setitem__", "index", "index_put_", "_index_put_impl_"}
# Functions in which torch handles the device by itself.
_PLAIN = {"__get__", "to", "cpu", "as_tensor"}
_NUMPY = {"numpy", "__array__", "data_ptr"}


class Far(Tensor):
    """A tensor on the simulated device, with the CPU tensor of its values."""

    @staticmethod
    def __new__(cls, near: Tensor) -> "Far":
        return Tensor._make_wrapper_subclass(
            cls, near.shape, strides=near.stride(), dtype=near.dtype, device=ELSEWHERE
        )

    def __init__(self, near: Tensor) -> None:
        self.near = near

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(func, func._opname, args, kwargs or {})


def _computed(func: Any, name: str, args: Any, kwargs: Any) -> Any:
    """Compute on the CPU for tensors of the simulated device; refuse mixed devices."""
    tensors = [leaf for leaf in pytree.tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    mine = {id(one.near): one for one in tensors if isinstance(one, Far)}
    device = kwargs.get("device")
    comes, goes = (device is not None and torch.device(device).type == x for x in ("cpu", "meta"))
    if not mine and not goes:
        return func(*args, **kwargs)
    copied = name in ("copy_", "_to_copy") or (
        name == "__setitem__"
        and not any(isinstance(x, Tensor) for x in pytree.tree_leaves(args[1]))
    )
    crossing = copied or (name in _CROSSING and isinstance(args[0], Far))
    if not crossing and any(one.ndim and not isinstance(one, Far) for one in tensors):
        raise RuntimeError(f"{name}: tensors of two devices")
    into = isinstance(args[0], Far) if name == "copy_" else not comes
    args, kwargs = pytree.tree_map_only(Far, lambda one: one.near, (args, kwargs))
    found = func(*args, **kwargs | ({} if device is None else {"device": "cpu"}))
    if not into:
        return found
    return pytree.tree_map_only(
        Tensor, lambda one: mine[id(one)] if id(one) in mine else Far(one), found
    )


class _Operations(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(func, func._opname, args, kwargs or {})


class Elsewhere(TorchFunctionMode):
    """Within the block and its thread, tensors can be created and computed on the device."""

    def __enter__(self) -> "Elsewhere":
        self._operations = _Operations()
        self._operations.__enter__()
        super().__enter__()
        return self

    def __exit__(self, kind: type | None, error: Any, trace: TracebackType | None) -> None:
        super().__exit__(kind, error, trace)
        self._operations.__exit__(kind, error, trace)

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name, kwargs = func.__name__, kwargs or {}
        if name in _NUMPY and isinstance(args[0], Far):
            raise TypeError("numpy takes tensors of the CPU")
        if name in _PLAIN and (name != "as_tensor" or isinstance(args[0], Tensor)):
            return func(*args, **kwargs)
        return _computed(func, name, args, kwargs)


def sent(record: Any) -> Any:
    """Move the tensors of records to the simulated device."""
    return pytree.tree_map_only(Tensor, Far, record)
