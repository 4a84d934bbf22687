"""Base class of the records that stages exchange."""

import dataclasses
import types
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

import torch
from jaxtyping import AbstractArray, jaxtyped
from torch import Tensor
from torch.utils import _pytree as pytree

from pimper_torch.records.value_checks import Faults
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.events import Event
from pimper_torch.runtime.later import later
from pimper_torch.runtime.mapped import take_rows

AnyRecord = TypeVar("AnyRecord", bound="Record")
Function = TypeVar("Function", bound=Callable[..., Any])
Index = Sequence[int] | slice | Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """Frozen dataclass of tensors that can be moved, indexed, concatenated and copied with changes.

    Shapes and dtypes of tensors are checked against the annotations when a record is made;
    :meth:`check` verifies the values where a record enters a stage. Fields cannot be rebound,
    but tensors are not write-protected; stages never write into their inputs.

    Every record is a pytree (``torch.utils._pytree``) with its tensors as leaves.
    """

    def __init_subclass__(cls, **settings: Any) -> None:  # noqa: ANN401 - depends on the base
        super(Record, cls).__init_subclass__(**settings)
        if "__slots__" in cls.__dict__:  # the class that `dataclass` creates, not the written one
            pytree.register_pytree_node(
                cls,
                _flatten,
                _unflatten,
                serialized_type_name=f"{cls.__module__}.{cls.__qualname__}",
                flatten_with_keys_fn=_flatten_with_keys,
            )
            torch.serialization.add_safe_globals([cls])  # only data, also for `weights_only`

    def __post_init__(self) -> None:
        with jaxtyped("context"):
            for name, hint in _arrays(type(self)).items():
                value = getattr(self, name)
                if not isinstance(value, hint):
                    raise InputError(
                        f"{type(self).__name__}.{name} is {_brief(value)}; needed: "
                        f"{_expected(hint)}{_preceding(self, name)}."
                    )

    def check(self, where: str) -> None:
        """Raise if a value is invalid for every stage, such as a normal that is not unit.

        Raises:
            InputError: Names the field, the value found and the value needed.
        """
        for path, leaf in pytree.tree_leaves_with_path(self):
            if getattr(leaf, "dtype", None) in (torch.float16, torch.bfloat16):
                raise InputError(
                    f"{where}: {type(self).__name__}{pytree.keystr(path)} is {_brief(leaf)}; "
                    "needed: float32 or float64, as from `.to(torch.float32)`."
                )
        for name, found, needed in self.faults():
            raise InputError(f"{where}: {type(self).__name__}.{name} {found}; needed: {needed}.")

    def faults(self) -> Faults:
        """List invalid values: field, value found, value needed."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Record):
                for name, found, needed in value.faults():
                    yield f"{field.name}.{name}", found, needed

    def figures(self) -> dict[str, int | float]:
        """Return counts and fractions for the report of the stage that made the record."""
        return {}

    def to(
        self: AnyRecord, target: torch.device | str | torch.dtype, dtype: torch.dtype | None = None
    ) -> AnyRecord:
        """Copy every tensor, also in nested records and tuples, to a device, a dtype, or both.

        Args:
            target: A device, or only a dtype: ``to("cuda")``, ``to(torch.float64)``,
                ``to("cuda", torch.float64)``.
            dtype: Of floating-point tensors. Integers and masks keep theirs.
        """
        device = None if isinstance(target, torch.dtype) else torch.device(target)
        kind = target if isinstance(target, torch.dtype) else dtype

        def moved(tensor: Tensor) -> Tensor:
            return tensor.to(device=device, dtype=kind if tensor.is_floating_point() else None)

        return pytree.tree_map_only(Tensor, moved, self)

    def detach(self: AnyRecord) -> AnyRecord:
        """Return a copy that is detached from the autograd graph."""
        return pytree.tree_map_only(Tensor, Tensor.detach, self)

    def replace(self: AnyRecord, **changes: object) -> AnyRecord:
        """Return a copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def take(self: AnyRecord, index: Index) -> AnyRecord:
        """Index the first axis, of every field that has it.

        The first axis is that of the first tensor, such as ``view``; tuples of names with one entry
        per index are indexed, too. Selecting all entries in order makes no copy.
        """
        fields, count = _along(self)
        if not isinstance(index, Tensor | slice):
            if list(index) == list(range(count)):
                return self
            index = torch.tensor(index, dtype=torch.long, device="cpu")
        changes: dict[str, object] = {}
        for name in fields:
            value = getattr(self, name)
            if isinstance(value, tuple):
                order = torch.arange(count, device="cpu")
                kept = order[index.cpu() if isinstance(index, Tensor) else index].tolist()
                changes[name] = tuple(value[item] for item in kept)
            elif isinstance(value, Record):
                changes[name] = value.take(index)
            elif value is not None:
                rows = index.to(value.device) if isinstance(index, Tensor) else index
                changes[name] = take_rows(value, rows)
        return self.replace(**changes)

    @classmethod
    def cat(cls: type[AnyRecord], records: Sequence[AnyRecord]) -> AnyRecord:
        """Concatenate records along their first axis; inverse of :meth:`take`.

        Usable as ``collate_fn`` of a ``DataLoader``. Fields without that axis are the first's.

        Raises:
            InputError: ``records`` is empty, or only some of them have a field.
        """
        if not records:
            raise InputError(f"{cls.__name__}.cat got no record; needed: at least one.")
        fields, _ = _along(records[0])
        changes: dict[str, object] = {}
        for name in fields:
            values = [getattr(record, name) for record in records]
            if all(value is None for value in values):
                continue
            if any(value is None for value in values):
                raise InputError(
                    f"{cls.__name__}.cat: some records have {name} and others do not; needed: "
                    "all or none."
                )
            if isinstance(values[0], tuple):
                changes[name] = tuple(item for value in values for item in value)
            elif isinstance(values[0], Record):
                changes[name] = type(values[0]).cat(values)
            else:
                changes[name] = torch.cat(values)
        return records[0].replace(**changes)

    def __str__(self) -> str:
        fields = [field for field in dataclasses.fields(self) if field.repr]
        lines = [f"  {field.name}: {_summary(getattr(self, field.name))}" for field in fields]
        return "\n".join([type(self).__name__, *lines])

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:  # noqa: ANN401 - IPython's
        printer.text("..." if cycle else str(self))

    def _repr_html_(self) -> str | None:
        html: str | None = later("viz.cells.cell")(self)
        return html

    def lengths(self) -> dict[str, int]:
        """Return the length of every named axis; tensors of the record precede nested records.

        >>> from pimper_torch.records import Mesh
        >>> Mesh(vertices_world=torch.zeros(4, 3), faces=torch.zeros(2, 3).long()).lengths()
        {'vertex': 4, 'face': 2}
        """
        lengths: dict[str, int] = {}
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        for name, hint in _arrays(type(self)).items():
            if values[name] is not None:
                words = _array_of(hint).dim_str.split()
                lengths |= {
                    word: size
                    for word, size in zip(words, values[name].shape, strict=False)
                    if word.isidentifier() and size
                }
        for value in values.values():
            lengths = lengths | value.lengths() | lengths if isinstance(value, Record) else lengths
        return lengths

    def __repr__(self) -> str:
        fields = ", ".join(
            f"{field.name}={_brief(getattr(self, field.name))}"
            for field in dataclasses.fields(self)
            if field.repr
        )
        return f"{type(self).__name__}({fields})"


def _cached(function: Function) -> Function:
    """Cache a function of a class; mypy treats dataclass types as unhashable."""
    return cache(function)  # type: ignore[return-value]


@_cached
def _hints(cls: type[Record]) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


@_cached
def _arrays(cls: type[Record]) -> dict[str, Any]:
    """Return the annotations of fields that are shaped tensors or optional ones."""
    return {name: hint for name, hint in _hints(cls).items() if _array_of(hint) is not None}


def choices(hint: object) -> tuple[Any, ...]:
    """Return the members of a union; any other annotation is its only member."""
    blend = typing.get_origin(hint) in (typing.Union, types.UnionType)
    return typing.get_args(hint) if blend else (hint,)


def _array_of(hint: Any) -> Any:  # noqa: ANN401 - jaxtyping's types have no common name
    types_of = (choice for choice in choices(hint) if isinstance(choice, type))
    return next((choice for choice in types_of if issubclass(choice, AbstractArray)), None)


def _axis(hint: Any) -> str:  # noqa: ANN401
    return (_array_of(hint).dim_str.split() or [""])[0]


def _along(record: Record) -> tuple[list[str], int]:
    """Return the names of the fields along the first tensor's first axis, and its length."""
    cls = type(record)
    hints, arrays = _hints(cls), _arrays(cls)
    if not arrays:
        raise InputError(f"{cls.__name__} has no tensors to index.")
    first = next(iter(arrays))
    axis, count = _axis(arrays[first]), len(getattr(record, first))
    names = []
    for field in dataclasses.fields(cls):
        value = getattr(record, field.name)
        along = field.name in arrays and _axis(arrays[field.name]) == axis
        labels = hints[field.name] == tuple[str, ...] and len(value) == count
        inner = isinstance(value, Record) and bool(_arrays(type(value)))
        if along or labels or (inner and _axis(next(iter(_arrays(type(value)).values()))) == axis):
            names.append(field.name)
    return names, count


def _nodes(record: Record) -> tuple[list[tuple[str, Any]], tuple[object, ...]]:
    """Separate the fields annotated as tensors from the rest."""
    cls = type(record)
    children: list[tuple[str, Any]] = []
    rest: list[tuple[str, Any]] = []
    for name, hint in _hints(cls).items():
        value = getattr(record, name)
        fields = children if _holds_tensors(hint) and value is not None else rest
        fields.append((name, value))
    return children, (cls, tuple(name for name, _ in children), tuple(rest))


@_cached
def _holds_tensors(hint: object) -> bool:
    if isinstance(hint, type) and issubclass(hint, AbstractArray | Tensor | Record):
        return True
    return any(_holds_tensors(argument) for argument in typing.get_args(hint))


def _flatten(record: Record) -> tuple[list[Any], Any]:
    children, context = _nodes(record)
    return [value for _, value in children], context


def _flatten_with_keys(record: Record) -> tuple[list[tuple[Any, Any]], Any]:
    children, context = _nodes(record)
    return [(pytree.GetAttrKey(name), value) for name, value in children], context


def _unflatten(values: Any, context: Any) -> Record:  # noqa: ANN401 - torch's signature
    """Make a record of any leaves, unchecked: pytree functions replace tensors by other objects."""
    cls, names, rest = context
    record: Record = object.__new__(cls)
    for name, value in (*zip(names, values, strict=True), *rest):
        object.__setattr__(record, name, value)
    return record


def _brief(value: object) -> str:
    if isinstance(value, Tensor):
        kind = str(value.dtype).removeprefix("torch.")
        return f"{kind}{list(value.shape)}"
    if isinstance(value, tuple) and len(value) > 3:
        return f"({_brief(value[0])}, ... {len(value)} in all)"
    return repr(value)


def _summary(value: object) -> str:
    if isinstance(value, Record):
        axes = ", ".join(f"{axis} {size:,}" for axis, size in value.lengths().items())
        return f"{type(value).__name__}({axes})"
    if isinstance(value, tuple) and value and isinstance(value[0], Record | Event):
        return f"{len(value)} {type(value[0]).__name__}"
    return _brief(value)


def _expected(hint: Any) -> str:  # noqa: ANN401
    array = _array_of(hint)
    optional = " or None" if type(None) in choices(hint) else ""
    return f"{array.__name__.partition('[')[0]} of shape ({array.dim_str}){optional}"


def _preceding(record: Record, name: str) -> str:
    """Describe the preceding tensors, which bind the axes' names."""
    names = [*_arrays(type(record))]
    values = ((other, getattr(record, other)) for other in names[: names.index(name)])
    before = [f"{other} {_brief(value)}" for other, value in values if isinstance(value, Tensor)]
    return f", next to {', '.join(before)}" if before else ""
