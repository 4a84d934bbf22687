"""Calls of a chain's stages, with reports and kept records."""

import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any, ParamSpec, TypeVar

from torch import Tensor, nn
from torch.utils import _pytree as pytree

from pimper_torch.kernels.compile import all_compiled, load
from pimper_torch.records import Record
from pimper_torch.runtime.errors import held
from pimper_torch.runtime.reporting import HASH, aside
from pimper_torch.runtime.reporting import stage as reported_stage
from pimper_torch.stages.stage import Stage
from pimper_torch.store import Store, actual, digest, kept

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(slots=True, kw_only=True)
class ChainRun:
    """Caller of a chain's stages in one run: ``run(self.fuse, heights, contours)``.

    The record of a stage that says how it is kept (``kept_as``) is read from the store if an
    earlier run kept it there; otherwise it is computed and kept, see
    :func:`~pimper_torch.store.store.kept`. Stages of other packages are always called, because
    their code is not known, and so are stages that need gradients.

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
        """Return the record of a stage."""
        name = type(stage).__name__
        if isinstance(stage, nn.Module):
            name = self.names.get(stage, name)
        kernels = stage.kernels if isinstance(stage, Stage) else ()
        if kernels and not all_compiled():
            with reported_stage("compile"):
                load(kernels)

        def make() -> Any:  # noqa: ANN401 - the record of any stage
            values, others = actual((inputs, named))
            return called(name, partial(stage, *values, **others))

        with nullcontext() if self.last else held():
            if self.store is None or not isinstance(stage, Stage) or stage.kept_as is None:
                return make()
            with aside(HASH):
                hashed = digest(stage, inputs, named)
            if hashed is None:
                return make()
            record, _ = kept(self.store, f"{name}-{hashed}", stage.kept_as, make)
            return typing.cast(R, _beside(record, (*inputs, *named.values())))

    def passes(self, scales: Sequence[float]) -> Iterator[tuple[float, bool]]:
        """Yield the scale of each pass, and whether it is the last."""
        for number, scale in enumerate(scales, start=1):
            self.last = number == len(scales)
            yield scale, self.last


def _beside(record: Record, inputs: Sequence[object]) -> Record:
    """Move a record to the device of the first tensor in the records among a stage's inputs."""
    leaves = pytree.tree_leaves([value for value in inputs if isinstance(value, Record)])
    tensors = [leaf for leaf in leaves if isinstance(leaf, Tensor)]
    return record.to(tensors[0].device) if tensors else record


def called(name: str, call: Callable[[], R]) -> R:
    """Return the record of a stage, and report the call with the record's figures."""
    with reported_stage(name) as metrics:
        record = call()
        if isinstance(record, Record):
            metrics |= record.figures()
    return record
