"""Calls of a chain's stages: kept, reported, and a few patches at a time."""

import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any, ParamSpec, TypeVar

from torch import Tensor, nn
from torch.utils import _pytree as pytree

from pimper_torch.chains.streaming import Prepares, photometry_and_heights
from pimper_torch.errors import held
from pimper_torch.journal import HASH, aside
from pimper_torch.kernels.compile import COARSE, PHOTOMETRY, SURFACE, SWEEP, all_compiled, load
from pimper_torch.memory import release_memory
from pimper_torch.patches.sources import Sources
from pimper_torch.records import PatchSet, Record, Views
from pimper_torch.reporting import called
from pimper_torch.reporting import stage as reported_stage
from pimper_torch.store import Store, digest, kept

P = ParamSpec("P")
R = TypeVar("R")

# Stages whose records are made in less time than they are read, and one that keeps its own.
_NOT_KEPT = ("reconstruct", "contours", "decompose", "repair")

# Kernels that a stage waits for in an installation's first run.
_KERNELS: Mapping[str, Sequence[str]] = {
    "silhouettes": COARSE,
    "factorize": PHOTOMETRY,
    "sweep": (*PHOTOMETRY, *SWEEP),
    "fuse": SURFACE,
}


@dataclass(frozen=True, slots=True)
class Later:
    """The record of a stage that is made when another one asks for it."""

    stage: Any
    inputs: tuple[Any, ...]


@dataclass(slots=True, kw_only=True)
class Running:
    """Calls the stages of a chain in one run: ``run(self.fuse, heights, contours)``.

    A stage's record is that of an earlier run where the store has it, and is kept else, see
    :func:`~pimper_torch.store.store`. A stage of another package is called every time, as its code
    is not known, and so is one that gradients are asked of.

    Attributes:
        store: Where records are kept; nowhere without.
        put_off: Stages whose records are made when another one asks for them: all samples of all
            views take more memory than there is.
        last: Whether this is the last pass. What stages of earlier ones warn of is told only where
            they fail, as the last one warns of it, too.
        sources: The photographs as the warp prepares them, once for all passes.
    """

    names: Mapping[nn.Module, str]
    store: Store | None
    put_off: Sequence[str] = ()
    last: bool = True
    sources: Sources | None = None

    def __call__(self, stage: Callable[P, R], *inputs: P.args, **named: P.kwargs) -> R:
        """Return the record of a stage, or of a function."""
        given = (*inputs, *named.values())
        name = getattr(stage, "__name__", type(stage).__name__)
        if isinstance(stage, nn.Module):
            name = self.names.get(stage, name)
        if name in self.put_off:
            return typing.cast(R, Later(stage, given))
        if name in _KERNELS and not all_compiled():
            with reported_stage("compile"):
                load(_KERNELS[name])
        with nullcontext() if self.last else held():
            return typing.cast(R, self._kept(name, stage, given))

    def passes(self, scales: Sequence[float]) -> Iterator[tuple[float, bool]]:
        """Walk through the scales of passes; yield each, and whether it is the last."""
        for number, scale in enumerate(scales, start=1):
            self.last = number == len(scales)
            yield scale, self.last

    def _kept(self, name: str, stage: Callable[..., object], inputs: tuple[object, ...]) -> object:
        """Find the record of a stage, or make it and keep it."""
        make: Callable[[], Any] = partial(self._made, name, stage, inputs)
        cls = None if self.store is None or name in _NOT_KEPT else _returns(stage)
        if cls is None:
            return make()
        with aside(HASH):
            hashed = digest(stage, *inputs)
        if hashed is None:
            return make()
        record, _ = kept(self.store, f"{name}-{hashed}", cls, make)
        return _beside(record, inputs)

    def _made(self, name: str, stage: Callable[..., Any], inputs: tuple[object, ...]) -> object:
        """Call a stage; what was put off is made first, or a few patches at a time with it."""
        put_off = [value for value in inputs if isinstance(value, Later)]
        if not put_off:
            return called(name, stage, *inputs)
        seen, *photometric = put_off
        views, cameras, patches = seen.inputs
        sources = self._prepared(seen.stage, views, patches)
        if photometric:
            record: object = photometry_and_heights(
                seen.stage, photometric[0].stage, stage, views, cameras, patches, sources
            )
        else:
            whole = called("warp", seen.stage, *seen.inputs, sources)
            record = called(name, stage, *(whole if one is seen else one for one in inputs))
        if self.last:
            self.sources = None  # as much memory as the photographs themselves
        release_memory()
        return record

    def _prepared(self, warp: object, views: Views, patches: PatchSet) -> Sources | None:
        """Return the photographs with the surface that occludes: the one before, or the facets."""
        if not isinstance(warp, Prepares):
            return None
        self.sources = self.sources or warp.prepare(views)
        return self.sources.hidden_by(patches.surface or patches.coarse.mesh)


def _flat(*values: object) -> Iterator[object]:
    """Yield stages and records, those of records that are made later, too."""
    for value in values:
        yield from _flat(value.stage, *value.inputs) if isinstance(value, Later) else (value,)


def _returns(call: Callable[..., object]) -> type[Record] | None:
    """Return the record that a call is annotated to return."""
    function = call.forward if isinstance(call, nn.Module) else call
    cls: Any = typing.get_type_hints(function).get("return")
    return cls if isinstance(cls, type) and issubclass(cls, Record) else None


def _beside(record: Record, inputs: tuple[object, ...]) -> Record:
    """Put a record on the device of the inputs."""
    records = [value for value in _flat(*inputs) if isinstance(value, Record)]
    tensors = [leaf for leaf in pytree.tree_leaves(records) if isinstance(leaf, Tensor)]
    return record.to(tensors[0].device) if tensors else record
