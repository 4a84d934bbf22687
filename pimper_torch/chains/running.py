"""Calls of a chain's stages, with reports and kept records."""

import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any, ParamSpec, TypeVar

from torch import Tensor, nn
from torch.utils import _pytree as pytree

from pimper_torch.kernels.compile import (
    COARSE,
    PHOTOMETRY,
    SURFACE,
    SWEEP,
    all_compiled,
    load,
)
from pimper_torch.records import Record
from pimper_torch.runtime.errors import held
from pimper_torch.runtime.reporting import HASH, aside
from pimper_torch.runtime.reporting import stage as reported_stage
from pimper_torch.store import Store, digest, kept

P = ParamSpec("P")
R = TypeVar("R")

# Stages that compute records faster than these are read, and one that keeps its records itself.
_NOT_KEPT = (
    *("reconstruct", "contours", "prepare", "decompose", "warp", "gauge", "repair", "explain"),
)

# Kernels that stages wait for in the first run of an installation.
_KERNELS: Mapping[str, Sequence[str]] = {
    "silhouettes": COARSE,
    "warp": PHOTOMETRY,
    "photometry": SWEEP,
    "fuse": SURFACE,
}


@dataclass(slots=True, kw_only=True)
class ChainRun:
    """Caller of a chain's stages in one run: ``run(self.fuse, heights, contours)``.

    The record of a stage is read from the store if an earlier run kept it there; otherwise it is
    computed and kept, see :func:`~pimper_torch.store.store`. Stages of other packages are
    always called, because their code is not known, and so are stages that need gradients.

    Attributes:
        names: Name of each module among the chain's stages.
        store: Store of the records; without it, none is kept.
        last: Whether this is the last pass. Warnings of earlier passes are given only if these
            fail, because the last pass repeats them.
    """

    names: Mapping[nn.Module, str]
    store: Store | None
    last: bool = True

    def __call__(self, stage: Callable[P, R], *inputs: P.args, **named: P.kwargs) -> R:
        """Return the record of a stage or of a function."""
        arguments = (*inputs, *named.values())
        name = getattr(stage, "name", getattr(stage, "__name__", type(stage).__name__))
        if isinstance(stage, nn.Module):
            name = self.names.get(stage, name)
        if name in _KERNELS and not all_compiled():
            with reported_stage("compile"):
                load(_KERNELS[name])
        with nullcontext() if self.last else held():
            return typing.cast(R, self._kept(name, stage, arguments))

    def passes(self, scales: Sequence[float]) -> Iterator[tuple[float, bool]]:
        """Yield the scale of each pass, and whether it is the last."""
        for number, scale in enumerate(scales, start=1):
            self.last = number == len(scales)
            yield scale, self.last

    def _kept(self, name: str, stage: Callable[..., object], inputs: tuple[object, ...]) -> object:
        """Return the kept record of a stage, or compute and keep it."""
        make: Callable[[], Any] = partial(called, name, stage, *inputs)
        if self.store is None or name in _NOT_KEPT:
            return make()
        function = stage.forward if isinstance(stage, nn.Module) else stage
        cls: Any = typing.get_type_hints(function).get("return")
        if not (isinstance(cls, type) and issubclass(cls, Record)):
            return make()
        with aside(HASH):
            hashed = digest(stage, *inputs)
        if hashed is None:
            return make()
        record, _ = kept(self.store, f"{name}-{hashed}", cls, make)
        records = [value for value in inputs if isinstance(value, Record)]
        tensors = [leaf for leaf in pytree.tree_leaves(records) if isinstance(leaf, Tensor)]
        return record.to(tensors[0].device) if tensors else record


def called(name: str, call: Callable[..., R], *inputs: object) -> R:
    """Return the record of a stage, and report the call with the record's figures."""
    with reported_stage(name) as metrics:
        record = call(*inputs)
        if isinstance(record, Record):
            metrics |= record.figures()
    return record
