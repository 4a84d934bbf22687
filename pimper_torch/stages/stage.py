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
from pimper_torch.runtime.torch_settings import isolated

P = ParamSpec("P")
R = TypeVar("R", covariant=True)
T = TypeVar("T")


@runtime_checkable
class _Forward(Protocol[P, R]):
    def forward(self, *args: P.args, **kwargs: P.kwargs) -> R: ...


class Stage(nn.Module):
    """Module whose call has the types of its ``forward``, for type checkers.

    A plain ``nn.Module`` accepts and returns any type. A custom stage of this class is type-checked
    where it is inserted into a chain or called. Its input records are checked at run time.

    It computes on the device and in the dtype of these records: ``stage(views.to("cuda"))``.
    ``to`` and similar methods move parameters, as of a network, and warn if a stage has none.

    Attributes:
        kept_as: Class of the record, if a chain's store keeps it for later runs; ``None`` for
            records that are computed faster than they are read.
        kernels: Modules of compiled kernels that the stage waits for.
    """

    kept_as: type[Record] | None = None
    kernels: Sequence[str] = ()

    if TYPE_CHECKING:

        def __call__(self: _Forward[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
            """Return the record of the stage.

            Raises:
                InputError: An input has the wrong type, or is a record with unusable values.
            """

    _call_impl = isolated(nn.Module._call_impl)

    def __init__(self) -> None:
        super().__init__()
        self.register_forward_pre_hook(check_handed, with_kwargs=True)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Stage":
        """Move parameters and buffers; warn if a stage has none, as records must be moved."""
        if any(True for _ in chain(self.parameters(), self.buffers())):
            with held():  # nested stages may have none
                return super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        probe = torch.empty(0)
        with suppress(AssertionError, RuntimeError):  # the device is missing
            moved = fn(probe)
            if (moved.device, moved.dtype) == (probe.device, probe.dtype):
                return self
        caution(
            f"{type(self).__name__} has no parameters to move: it computes on the device and in "
            "the dtype of its input records. Move the records, such as `views.to('cuda')`.",
            stacklevel=3,
        )
        return self


class Given(Stage, Generic[T]):
    """Stage that returns a given record and ignores its inputs."""

    def __init__(self, record: T) -> None:
        super().__init__()
        self.record = record

    def forward(self, *_: object) -> T:
        """Return the record."""
        return self.record


class Then(Stage):
    """Sequence of stages, each of which receives the record of the one before.

    ``load_chain("default", warp=Then(Warp(), Mine()))`` inserts a stage after the warp. The record
    of the sequence is kept as that of its last stage.
    """

    def __init__(self, stage: nn.Module, *others: nn.Module) -> None:
        super().__init__()
        self.stage, self.others = stage, nn.ModuleList(others)
        parts = [part for part in (stage, *others) if isinstance(part, Stage)]
        self.kept_as = getattr((stage, *others)[-1], "kept_as", None)
        self.kernels = tuple(name for part in parts for name in part.kernels)

    def forward(self, *given: object, **named: object) -> object:
        """Return the record of the last stage."""
        record = self.stage(*given, **named)
        for other in self.others:
            record = other(record)
        return record


def check_handed(stage: nn.Module, args: tuple[object, ...], kwargs: Mapping[str, object]) -> None:
    """Refuse inputs of the wrong type, and records with unusable values."""
    where = type(stage).__name__
    try:
        bound = inspect.signature(stage.forward).bind(*args, **kwargs)
    except TypeError:
        return  # torch reports wrong arguments
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
    """Return advice how to obtain a record of the right kind, given a wrong value."""
    if Views in kinds and isinstance(value, str | Path):
        return "`load_views` reads the photographs of a folder."
    if Views in kinds and isinstance(value, Tensor | np.ndarray | Sequence):
        return "`scene_of` combines images in tensors or arrays with their cameras."
    return "The caller of the stage passed it; in a chain, the stage before."
