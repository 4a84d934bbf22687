"""Records as files: tensors as safetensors, everything else as JSON in the file's header.

The metadata in the header have one entry, ``pimper_torch``, with the text of the JSON object
``{"format": 1, "record": ...}``. A record is ``{"record": class, "fields": {name: value}}``, a
tensor ``{"tensor": name}``, a tuple a list; numbers, texts and ``null`` stand for themselves.
Classes are found by the annotations of the fields: a file can name no other, and holds no code.
"""

import dataclasses
import json
import math
import secrets
import types
import typing
from bisect import bisect
from collections.abc import Mapping
from contextlib import suppress
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import torch
from jaxtyping import AbstractArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from pimper_torch.records.record import Record
from pimper_torch.runtime.errors import InputError, OutputError

AnyRecord = TypeVar("AnyRecord", bound=Record)

_FORMAT = 1
_KEY = "pimper_torch"
# A choice: the structure of a run's last step is below 1 MB, and a stranger's file can't make
# the parser fill the memory.
_MAX_STRUCTURE = 2**25
_DTYPES = frozenset(
    {torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64}
    | {torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.complex64}
)
_UNLIKE = object()
_AGAIN = "Save the record again with `save_record`."


def save_record(record: Record, path: str | Path) -> None:
    """Write a record, with all records inside it, to one file for :func:`load_record`.

    The file is safetensors, which other programs read too; a tensor is called by the fields that
    lead to it, such as ``cameras.intrinsics``. Tensors are written from their own memory, those of
    a GPU by way of the CPU. A tensor that several fields share is written once. What tensors were
    computed from is not kept.

    Args:
        path: A former file is replaced when the new one is complete. Folders are made.

    Raises:
        InputError: A field holds something else than records, tensors, tuples, lists, mappings,
            enums, paths, numbers, texts and ``None``.
    """
    path = Path(path)
    writer = _Writer()
    structure = {"format": _FORMAT, "record": writer.plain(record, "")}
    text = json.dumps(structure, allow_nan=False)
    if len(text) > _MAX_STRUCTURE:
        raise InputError(
            f"{type(record).__name__}: what is not tensors takes {len(text)} bytes; needed: "
            f"{_MAX_STRUCTURE} at most. Save its parts one by one, or hold numbers as tensors."
        )
    trial = path.with_name(f".{path.name}.new-{secrets.token_hex(4)}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save_file(writer.tensors, trial, metadata={_KEY: text})
        trial.replace(path)
    except (OSError, SafetensorError) as error:
        raise OutputError(
            f"{path}: writing failed ({error}); nothing was left there. Free space or write "
            "elsewhere."
        ) from error
    finally:
        with suppress(OSError):  # it is gone where all went well
            trial.unlink()


def load_record(cls: type[AnyRecord], path: str | Path) -> AnyRecord:
    """Read a record that :func:`save_record` wrote, bit for bit.

    The file is mapped into memory: pages are read when they are used, and writing into a tensor
    does not change the file. Fields that shared a tensor share one again. All structure, names and
    shapes are checked before a tensor's memory is touched; values are checked by the stages that
    take the record (:meth:`~pimper_torch.records.record.Record.check`). Paths in a record are
    returned, never opened.

    Returns:
        The record, on the CPU.

    Raises:
        InputError: There is no such file, it is damaged, of another format, or holds another record
            than ``cls``, as its fields are annotated.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: is no file; needed: a file that `save_record` wrote.")
    try:
        with safe_open(path, framework="pt") as file:
            structure, names = _structure(path, file.metadata()), file.keys()
            reader = _Reader(path, {name: file.get_tensor(name) for name in names})
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror or 'the system refuses'}). {_AGAIN}"
        ) from error
    except SafetensorError as error:
        raise InputError(
            f"{path}: cannot be read as safetensors, it seems cut short or damaged; needed: a "
            f"whole file. {_AGAIN}"
        ) from error
    record: AnyRecord = reader.value(structure, cls, cls.__name__)
    if reader.unused:
        raise InputError(
            f"{path}: has tensors that no field names, such as {min(reader.unused)!r}; needed: "
            f"those of {cls.__name__} alone. {_AGAIN}"
        )
    return record


class _Writer:
    """Turns values into JSON, and collects tensors by the fields that lead to them."""

    def __init__(self) -> None:
        self.tensors: dict[str, Tensor] = {}
        self._names: dict[object, str] = {}
        self._taken: list[tuple[int, float]] = []  # memory: where each tensor begins and ends

    def plain(self, value: object, where: str) -> object:
        if isinstance(value, Record):
            fields = {
                field.name: self.plain(getattr(value, field.name), _inside(where, field.name))
                for field in dataclasses.fields(value)
            }
            return {"record": type(value).__name__, "fields": fields}
        if isinstance(value, Tensor):
            return {"tensor": self._name(value, where)}
        if isinstance(value, tuple):
            return self._listed(value, where)
        if isinstance(value, list):
            return {"list": self._listed(value, where)}
        if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
            return {"map": {key: self.plain(value[key], _inside(where, key)) for key in value}}
        if isinstance(value, Enum):
            return {"enum": value.name}
        if isinstance(value, Path):
            return {"path": str(value)}
        if isinstance(value, float) and not math.isfinite(value):
            return {"float": str(float(value))}
        if value is None or isinstance(value, bool | int | float | str):
            return value
        raise InputError(
            f"{where} is a {type(value).__name__}, which a file cannot hold; needed: records, "
            "tensors, tuples, lists, mappings, enums, paths, numbers, texts or None."
        )

    def _listed(self, values: tuple[object, ...] | list[object], where: str) -> list[object]:
        return [self.plain(item, _inside(where, index)) for index, item in enumerate(values)]

    def _name(self, tensor: Tensor, where: str) -> str:
        if tensor.dtype not in _DTYPES or tensor.layout != torch.strided or tensor.is_meta:
            raise InputError(
                f"{where} is a tensor of {tensor.dtype}, {tensor.layout}, on {tensor.device}; "
                "needed: a dense one with values, of a type that safetensors has."
            )
        memory = (tensor.device, tensor.data_ptr(), tensor.dtype, tensor.shape, tensor.stride())
        lazy = (tensor.is_conj(), tensor.is_neg())
        name = self._names.setdefault((*memory, *lazy), where)
        if name == where:
            self.tensors[name] = self._separate(tensor.detach().cpu().resolve_conj().resolve_neg())
        return name

    def _separate(self, tensor: Tensor) -> Tensor:
        """Return contiguous memory that no tensor before has a part of, as safetensors needs.

        What was taken before is disjoint and sorted, so that only its two neighbours can overlap.
        """
        tensor = tensor.contiguous()
        first, end = tensor.data_ptr(), tensor.data_ptr() + tensor.nbytes
        place = bisect(self._taken, (first, math.inf))
        around = self._taken[max(0, place - 1) : place + 1]
        if any(first < other_end and other < end for other, other_end in around):
            return tensor.clone()
        if tensor.nbytes:
            self._taken.insert(place, (first, end))
        return tensor


class _Reader:
    """Turns JSON into what the annotations ask for, or says where it is something else."""

    def __init__(self, path: Path, tensors: Mapping[str, Tensor]) -> None:
        self.path = path
        self.tensors = tensors
        self.unused = set(tensors)

    def value(self, found: Any, hint: Any, where: str) -> Any:  # noqa: ANN401 - JSON
        if typing.get_origin(hint) in (typing.Union, types.UnionType):
            choices = typing.get_args(hint)
        else:
            choices = (hint,)
        for choice in choices:
            made = self._made(found, choice, where)
            if made is not _UNLIKE:
                return made
        raise self._refused(where, f"is {_shortly(found)}", " or ".join(map(_named, choices)))

    def _made(self, found: Any, hint: Any, where: str) -> Any:  # noqa: ANN401
        """Return the value, or ``_UNLIKE`` where it is of another kind than the annotation."""
        origin, hints = typing.get_origin(hint) or hint, typing.get_args(hint)
        if origin is typing.Literal:
            same = any(type(found) is type(one) and found == one for one in hints)
            return found if same else _UNLIKE
        if isinstance(found, list):
            return self._tuple(found, hints, where) if origin in (object, tuple) else _UNLIKE
        if not isinstance(found, dict):
            kinds = (float, int) if origin is float else (origin,)
            return found if origin is object or type(found) in kinds else _UNLIKE
        match sorted(found.items()):
            case [("fields", dict(fields)), ("record", name)] if _is_a(hint, Record):
                return self._record(fields, hint, where) if name == hint.__name__ else _UNLIKE
            case [("tensor", str(name))] if _is_a(hint, AbstractArray | Tensor):
                return self._tensor(name, where)
            case [("map", dict(content))] if origin is object or _is_a(origin, Mapping):
                inner = (*hints, object, object)[1]
                items = content.items()
                return {key: self.value(item, inner, _inside(where, key)) for key, item in items}
            case [("list", list(content))] if origin in (object, list):
                inner = (*hints, object)[0]
                pairs = enumerate(content)
                return [self.value(item, inner, _inside(where, at)) for at, item in pairs]
            case [("enum", str(name))] if _is_a(hint, Enum):
                if name not in hint.__members__:
                    known = f"one of {', '.join(hint.__members__)}"
                    raise self._refused(where, f"is {name!r}", known)
                return hint[name]
            case [("path", str(text))] if _is_a(hint, Path):
                if "\0" in text:
                    raise self._refused(where, f"is {text!r}", "a path")
                return Path(text)
            case [("float", "nan" | "inf" | "-inf" as text)] if origin in (object, float):
                return float(text)
        return _UNLIKE

    def _record(self, fields: Mapping[str, Any], cls: Any, where: str) -> Record:  # noqa: ANN401
        hints, known = typing.get_type_hints(cls), {field.name for field in dataclasses.fields(cls)}
        if fields.keys() != known:
            lacking, foreign = sorted(known - fields.keys()), sorted(fields.keys() - known)
            parts = [f"lacks {', '.join(lacking)}"] if lacking else []
            parts += [f"has the unknown {', '.join(map(_shortly, foreign))}"] if foreign else []
            raise self._refused(where, " and ".join(parts), f"the fields of {cls.__name__}")
        made = {
            name: self.value(fields[name], hints[name], _inside(where, name)) for name in fields
        }
        try:
            record: Record = cls(**made)
        except InputError as error:
            raise InputError(f"{self.path}: {where}: {error} {_AGAIN}") from error
        return record

    def _tensor(self, name: str, where: str) -> Tensor:
        if name not in self.tensors:
            raise self._refused(where, f"names {_shortly(name)}", "a tensor of the file")
        self.unused.discard(name)
        return self.tensors[name]

    def _tuple(self, found: list[Any], hints: tuple[Any, ...], where: str) -> tuple[Any, ...]:
        if not hints or hints[-1] is Ellipsis:
            hints = (*hints, object)[:1] * len(found)
        if len(hints) != len(found):
            raise self._refused(where, f"has {len(found)} entries", str(len(hints)))
        pairs = enumerate(zip(found, hints, strict=True))
        return tuple(self.value(item, hint, _inside(where, at)) for at, (item, hint) in pairs)

    def _refused(self, where: str, found: str, needed: str) -> InputError:
        return InputError(f"{self.path}: {where} {found}; needed: {needed}. {_AGAIN}")


def _structure(path: Path, metadata: Mapping[str, str] | None) -> object:
    """Parse the record's structure, and check the format."""
    text = (metadata or {}).get(_KEY)
    if text is None:
        raise InputError(f"{path}: holds tensors but no record; needed: what `save_record` writes.")
    if len(text) > _MAX_STRUCTURE:
        needed = f"needed: {_MAX_STRUCTURE} bytes at most"
        raise InputError(f"{path}: its structure takes {len(text)} bytes; {needed}. {_AGAIN}")
    try:
        structure = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: its structure is no JSON ({error}); needed: what `save_record` writes. "
            f"{_AGAIN}"
        ) from error
    version = structure.get("format") if isinstance(structure, dict) else None
    if version != _FORMAT or structure.keys() != {"format", "record"}:
        raise InputError(
            f"{path}: is of format {_shortly(version)}; needed: format {_FORMAT}. Save the record "
            "again with this version of pimper_torch, or load it with the version that wrote it."
        )
    return structure["record"]


def _is_a(hint: object, cls: type | types.UnionType) -> bool:
    return isinstance(hint, type) and issubclass(hint, cls)


def _inside(where: str, name: object) -> str:
    return f"{where}.{name}" if where else str(name)


def _shortly(found: object) -> str:
    """Show what a file says in a line, a record by its class."""
    if isinstance(found, dict) and isinstance(found.get("record"), str):
        return f"the record {found['record'][:60]}"
    text = json.dumps(found)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _named(hint: Any) -> str:  # noqa: ANN401
    """Name an annotation."""
    if _is_a(hint, AbstractArray | Tensor):
        return "a tensor"
    plain = typing.get_origin(hint) is None and isinstance(hint, type)
    return "None" if hint is types.NoneType else hint.__name__ if plain else str(hint)
