"""The base of every record that travels between stages."""

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
from pimper_torch.runtime.mapped import take_rows

AnyRecord = TypeVar("AnyRecord", bound="Record")
Function = TypeVar("Function", bound=Callable[..., Any])
Index = Sequence[int] | slice | Tensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """Frozen data with a few verbs: move it, take a part of it, change a field in a copy.

    Shapes and kinds of tensors are checked against the fields when a record is made; what
    their values have to be, :meth:`check` asks where a record enters a stage. Frozen stops
    rebinding, not writing into a tensor; stages never write into what they were handed.

    Every record is a pytree (``torch.utils._pytree``), whose leaves are its tensors.
    """

    def __init_subclass__(cls, **settings: Any) -> None:  # noqa: ANN401 - whatever a base takes
        super(Record, cls).__init_subclass__(**settings)
        if "__slots__" in cls.__dict__:  # what `dataclass` makes of the class that was written
            pytree.register_pytree_node(
                cls,
                _flatten,
                _unflatten,
                serialized_type_name=f"{cls.__module__}.{cls.__qualname__}",
                flatten_with_keys_fn=_flatten_with_keys,
            )

    def __post_init__(self) -> None:
        with jaxtyped("context"):
            for name, hint in _arrays(type(self)).items():
                value = getattr(self, name)
                if not isinstance(value, hint):
                    raise InputError(
                        f"{type(self).__name__}.{name} is {_brief(value)}; needed: {_wanted(hint)}"
                        f"{_others(self, name)}."
                    )

    def check(self, where: str) -> None:
        """Refuse values that no stage can use, such as normals that are not unit.

        Raises:
            InputError: Names the field, what was found and what was needed.
        """
        for name, found, needed in self.faults():
            raise InputError(f"{where}: {type(self).__name__}.{name} {found}; needed: {needed}.")

    def faults(self) -> Faults:
        """List what is wrong with the values: the field, what was found, what is needed."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Record):
                for name, found, needed in value.faults():
                    yield f"{field.name}.{name}", found, needed

    def to(
        self: AnyRecord, target: torch.device | str | torch.dtype, dtype: torch.dtype | None = None
    ) -> AnyRecord:
        """Copy every tensor, in nested records and tuples too, to a device, a dtype, or both.

        Args:
            target: A device, or a dtype alone: ``to("cuda")``, ``to(torch.float64)``,
                ``to("cuda", torch.float64)``.
            dtype: Of floating-point tensors. Integers and masks keep theirs.
        """
        device = None if isinstance(target, torch.dtype) else torch.device(target)
        kind = target if isinstance(target, torch.dtype) else dtype

        def moved(tensor: Tensor) -> Tensor:
            return tensor.to(device=device, dtype=kind if tensor.is_floating_point() else None)

        return pytree.tree_map_only(Tensor, moved, self)

    def detach(self: AnyRecord) -> AnyRecord:
        """Return the same values, cut off from what they were computed from."""
        return pytree.tree_map_only(Tensor, Tensor.detach, self)

    def replace(self: AnyRecord, **changes: object) -> AnyRecord:
        """Return a copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def take(self: AnyRecord, index: Index) -> AnyRecord:
        """Keep some entries of the first axis, in the order given, of every field that has it.

        The first axis is that of the first tensor, such as ``view``; names go with it. All entries
        in their order are not copied.
        """
        fields, count = _along(self)
        if not isinstance(index, Tensor | slice):
            if list(index) == list(range(count)):
                return self
            index = torch.tensor(index, dtype=torch.long)
        changes: dict[str, object] = {}
        for name in fields:
            value = getattr(self, name)
            if isinstance(value, tuple):
                kept = torch.arange(count)[index.cpu() if isinstance(index, Tensor) else index]
                changes[name] = tuple(value[item] for item in kept.tolist())
            elif isinstance(value, Record):
                changes[name] = value.take(index)
            elif value is not None:
                place = index.to(value.device) if isinstance(index, Tensor) else index
                changes[name] = take_rows(value, place)
        return self.replace(**changes)

    @classmethod
    def cat(cls: type[AnyRecord], records: Sequence[AnyRecord]) -> AnyRecord:
        """Put records one behind the other along their first axis; inverse of :meth:`take`.

        Serves as ``collate_fn`` of a ``DataLoader``. Fields without that axis are the first's.

        Raises:
            InputError: There is no record, or some have a field that others lack.
        """
        if not records:
            raise InputError(f"{cls.__name__}.cat got no record; needed: one at least.")
        fields, _ = _along(records[0])
        changes: dict[str, object] = {}
        for name in fields:
            values = [getattr(record, name) for record in records]
            if all(value is None for value in values):
                continue
            if any(value is None for value in values):
                raise InputError(
                    f"{cls.__name__}.cat: some records have {name}, others none; needed: it in all "
                    "or in none."
                )
            if isinstance(values[0], tuple):
                changes[name] = tuple(item for value in values for item in value)
            elif isinstance(values[0], Record):
                changes[name] = type(values[0]).cat(values)
            else:
                changes[name] = torch.cat(values)
        return records[0].replace(**changes)

    def __str__(self) -> str:
        shown = [field for field in dataclasses.fields(self) if field.repr]
        lines = [f"  {field.name}: {_told(getattr(self, field.name))}" for field in shown]
        return "\n".join([type(self).__name__, *lines])

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:  # noqa: ANN401 - IPython's
        printer.text("..." if cycle else str(self))

    def lengths(self) -> dict[str, int]:
        """Return the length of every named axis, of its own tensors before those of records inside.

        >>> from pimper_torch.records import Mesh
        >>> Mesh(vertices_world=torch.zeros(4, 3), faces=torch.zeros(2, 3).long()).lengths()
        {'vertex': 4, 'face': 2}
        """
        found: dict[str, int] = {}
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        for name, hint in _arrays(type(self)).items():
            if values[name] is not None:
                words = _array_of(hint).dim_str.split()
                found |= {
                    word: size
                    for word, size in zip(words, values[name].shape, strict=False)
                    if word.isidentifier() and size
                }
        for value in values.values():
            found = found | value.lengths() | found if isinstance(value, Record) else found
        return found

    def __repr__(self) -> str:
        fields = ", ".join(
            f"{field.name}={_brief(getattr(self, field.name))}"
            for field in dataclasses.fields(self)
            if field.repr
        )
        return f"{type(self).__name__}({fields})"


def _remembered(function: Function) -> Function:
    """Ask a function once for each class; mypy takes classes of dataclasses for unhashable."""
    return cache(function)  # type: ignore[return-value]


@_remembered
def _hints(cls: type[Record]) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


@_remembered
def _arrays(cls: type[Record]) -> dict[str, Any]:
    """Return the fields that are tensors of a stated shape, or may be."""
    return {name: hint for name, hint in _hints(cls).items() if _array_of(hint) is not None}


def choices(hint: object) -> tuple[Any, ...]:
    """List the annotations that a union is of; any other is the only one."""
    blend = typing.get_origin(hint) in (typing.Union, types.UnionType)
    return typing.get_args(hint) if blend else (hint,)


def _array_of(hint: Any) -> Any:  # noqa: ANN401 - jaxtyping's types have no name of their own
    arrays = (one for one in choices(hint) if isinstance(one, type))
    return next((one for one in arrays if issubclass(one, AbstractArray)), None)


def _axis(hint: Any) -> str:  # noqa: ANN401
    return (_array_of(hint).dim_str.split() or [""])[0]


def _along(record: Record) -> tuple[list[str], int]:
    """Name the fields that have the first axis of the first tensor, and give its length."""
    cls = type(record)
    hints, arrays = _hints(cls), _arrays(cls)
    if not arrays:
        raise InputError(f"{cls.__name__} has no tensors to take a part of.")
    first = next(iter(arrays))
    axis, count = _axis(arrays[first]), len(getattr(record, first))
    found = []
    for field in dataclasses.fields(cls):
        value = getattr(record, field.name)
        along = field.name in arrays and _axis(arrays[field.name]) == axis
        names = hints[field.name] == tuple[str, ...] and len(value) == count
        inner = isinstance(value, Record) and bool(_arrays(type(value)))
        if along or names or (inner and _axis(next(iter(_arrays(type(value)).values()))) == axis):
            found.append(field.name)
    return found, count


def _nodes(record: Record) -> tuple[list[tuple[str, Any]], tuple[object, ...]]:
    """Separate the fields for tensors from the rest, whatever stands in them."""
    cls = type(record)
    children: list[tuple[str, Any]] = []
    rest: list[tuple[str, Any]] = []
    for name, hint in _hints(cls).items():
        value = getattr(record, name)
        place = children if _holds_tensors(hint) and value is not None else rest
        place.append((name, value))
    return children, (cls, tuple(name for name, _ in children), tuple(rest))


@_remembered
def _holds_tensors(hint: object) -> bool:
    if isinstance(hint, type) and issubclass(hint, AbstractArray | Tensor | Record):
        return True
    return any(_holds_tensors(part) for part in typing.get_args(hint))


def _flatten(record: Record) -> tuple[list[Any], Any]:
    children, context = _nodes(record)
    return [value for _, value in children], context


def _flatten_with_keys(record: Record) -> tuple[list[tuple[Any, Any]], Any]:
    children, context = _nodes(record)
    return [(pytree.GetAttrKey(name), value) for name, value in children], context


def _unflatten(values: Any, context: Any) -> Record:  # noqa: ANN401 - torch's signature
    """Make a record of any leaves: what stands for tensors, such as axes, has no shape."""
    cls, names, rest = context
    made: Record = object.__new__(cls)
    for name, value in (*zip(names, values, strict=True), *rest):
        object.__setattr__(made, name, value)
    return made


def _brief(value: object) -> str:
    if isinstance(value, Tensor):
        kind = str(value.dtype).removeprefix("torch.")
        return f"{kind}{list(value.shape)}"
    if isinstance(value, tuple) and len(value) > 3:
        return f"({_brief(value[0])}, ... {len(value)} in all)"
    return repr(value)


def _told(value: object) -> str:
    if isinstance(value, Record):
        axes = ", ".join(f"{axis} {size:,}" for axis, size in value.lengths().items())
        return f"{type(value).__name__}({axes})"
    if isinstance(value, tuple) and value and isinstance(value[0], Record):
        return f"{len(value)} {type(value[0]).__name__}"
    return _brief(value)


def _wanted(hint: Any) -> str:  # noqa: ANN401
    array = _array_of(hint)
    optional = " or None" if type(None) in choices(hint) else ""
    return f"{array.__name__.partition('[')[0]} of shape ({array.dim_str}){optional}"


def _others(record: Record, name: str) -> str:
    """Report the fields before, whose shapes bind the same names."""
    names = [*_arrays(type(record))]
    values = ((other, getattr(record, other)) for other in names[: names.index(name)])
    before = [f"{other} {_brief(value)}" for other, value in values if isinstance(value, Tensor)]
    return f", beside {', '.join(before)}" if before else ""
