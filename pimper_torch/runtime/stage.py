"""Base of every stage: a module that takes records and returns one."""

import inspect
import typing
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Generic, ParamSpec, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from torch import Tensor, nn

from pimper_torch.records import Record, Views
from pimper_torch.runtime.errors import InputError, caution, held

P = ParamSpec("P")
R = TypeVar("R", covariant=True)
T = TypeVar("T")


@runtime_checkable
class _Forward(Protocol[P, R]):
    def forward(self, *args: P.args, **kwargs: P.kwargs) -> R: ...


class Stage(nn.Module):
    """A module whose call has the types of its ``forward``, for a checker of types.

    ``nn.Module`` alone may be called with anything and gives anything. A stage of one's own that
    derives from this class is checked where it is put into a chain and wherever it is called; and
    so are the records it is handed, when it runs.

    It computes on the device and in the dtype of these records: ``stage(views.to("cuda"))``.
    ``to`` and its like move parameters, those of a network for instance, and warn where a stage has
    none.
    """

    if TYPE_CHECKING:

        def __call__(self: _Forward[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
            """Run the stage.

            Raises:
                InputError: What is handed to it is of another type than it takes, or a record
                    whose values no stage can use.
            """

    def __init__(self) -> None:
        super().__init__()
        self.register_forward_pre_hook(check_handed, with_kwargs=True)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Stage":
        """Move parameters and buffers; warn where there are none, and records are to be moved."""
        if any(True for _ in chain(self.parameters(), self.buffers())):
            with held():  # stages inside that have none
                return super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        probe = torch.empty(0)
        with suppress(AssertionError, RuntimeError):  # of a device that is not there
            moved = fn(probe)
            if (moved.device, moved.dtype) == (probe.device, probe.dtype):
                return self
        caution(
            f"{type(self).__name__} has no parameters to move: it computes on the device and in "
            "the dtype of the records it is called with. Move these, such as `views.to('cuda')`.",
            stacklevel=3,
        )
        return self


class Given(Stage, Generic[T]):
    """A stage that gives what it was made with, whatever it is handed: a record that is at hand."""

    def __init__(self, record: T) -> None:
        super().__init__()
        self.record = record

    def forward(self, *_: object) -> T:
        """Return it."""
        return self.record


class Then(Stage):
    """A stage, and others behind it, each of which is handed the record of the one before.

    ``load_chain("default", warp=Then(Warp(), Mine()))`` puts a stage into the gap behind the warp.
    """

    def __init__(self, stage: nn.Module, *others: nn.Module) -> None:
        super().__init__()
        self.stage, self.others = stage, nn.ModuleList(others)

    def forward(self, *given: object) -> object:
        """Return the record of the last one."""
        record = self.stage(*given)
        for other in self.others:
            record = other(record)
        return record


def check_handed(stage: nn.Module, args: tuple[object, ...], kwargs: Mapping[str, object]) -> None:
    """Refuse records of other types than a stage takes, and those that cannot be used."""
    where = type(stage).__name__
    try:
        bound = inspect.signature(stage.forward).bind(*args, **kwargs)
    except TypeError:
        return  # torch reports what does not fit
    hints = typing.get_type_hints(stage.forward)
    for name, value in bound.arguments.items():
        hint = hints.get(name)
        kinds = [kind for kind in (typing.get_args(hint) or (hint,)) if isinstance(kind, type)]
        records = [kind for kind in kinds if issubclass(kind, Record)]
        if records and not isinstance(value, tuple(kinds)):
            wanted = " or ".join(kind.__name__ for kind in kinds)
            raise InputError(
                f"{where}: {name} is {type(value).__name__}; needed: {wanted}. "
                f"{_source(value, kinds)}"
            )
        if isinstance(value, Record):
            value.check(f"{where}: {name}")


def _source(value: object, kinds: list[type]) -> str:
    """Return where a record comes from that something else was given in place of."""
    if Views in kinds and isinstance(value, str | Path):
        return "`load_views` reads the photographs of a folder."
    if Views in kinds and isinstance(value, Tensor | np.ndarray | Sequence):
        return "`scene_of` puts images in tensors or arrays beside their cameras."
    return "It comes from whoever called the stage, in a chain the stage before."
