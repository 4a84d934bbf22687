"""Records as files: tensors as safetensors, everything else as JSON in the file's header.

The JSON is an entry of the header's metadata, under a key that contains the format's version. A
record is ``{"record": class, "fields": {name: value}}``, a tensor ``{"tensor": name}``, and a tuple
a list; other values are plain JSON. Classes are found by the annotations of the fields: a file can
name no others, and contains no code.

Files of ``torch.save`` are read by ``torch.load`` with ``weights_only=True`` once the classes of
their records are imported, without checks of shapes.
"""

import dataclasses
import json
import secrets
import types
import typing
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from jaxtyping import AbstractArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from torch.utils import _pytree as pytree

from pimper_torch.records.record import AnyRecord, Record, choices
from pimper_torch.runtime.errors import InputError, OutputError
from pimper_torch.runtime.events import Event, Failure, Removal, StageReport

_KEY = "pimper_torch record 2"
# A choice: a run's last record has less than 1 MB of structure, and a malicious file must not make
# the parser fill the memory.
_MAX_STRUCTURE = 2**25
_AGAIN = "Save the record again with `save_record`."
# They contain only data; every class of records declares itself.
torch.serialization.add_safe_globals([Record, Failure, Removal, StageReport])


def save_record(record: Record, path: str | Path, about: Mapping[str, str] | None = None) -> None:
    """Write a record, with all records inside it, to one file for :func:`load_record`.

    The file is safetensors, readable by other programs; a tensor is named by the path of its
    fields, such as ``cameras.intrinsics``. Tensors are written from their own memory, those of
    a GPU via the CPU. A tensor that several fields share is written once. The autograd graph is
    not kept.

    Args:
        path: An existing file is replaced when the new one is complete. Folders are created.
        about: More entries of the header's metadata.

    Raises:
        InputError: A field contains a type other than records, dense tensors, tuples, mappings with
            string keys, numbers, strings and ``None``.
        OutputError: Writing failed; an existing file is unchanged.
    """
    path = Path(path)
    tensors: dict[int, tuple[str, Tensor]] = {}
    for keys, leaf in pytree.tree_flatten_with_path(record)[0]:
        if isinstance(leaf, Tensor):
            tensors.setdefault(id(leaf), (pytree.keystr(keys).removeprefix("."), leaf))
    text = as_json(record, {key: name for key, (name, _) in tensors.items()})
    # Refuses values that could not be read back.
    of_json(json.loads(text), type(record), type(record).__name__, dict(tensors.values()))
    trial = path.with_name(f".{path.name}.new-{secrets.token_hex(4)}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save_file(_apart(tensors.values()), trial, metadata={_KEY: text, **(about or {})})
        trial.replace(path)
    except (OSError, SafetensorError) as error:
        raise OutputError(
            f"{path}: writing failed ({error}); no file was left behind. Free space or write "
            "elsewhere."
        ) from error
    finally:
        with suppress(OSError):  # already renamed if all went well
            trial.unlink()


def load_record(cls: type[AnyRecord], path: str | Path) -> AnyRecord:
    """Read a record that :func:`save_record` wrote, bit for bit.

    The file is memory-mapped: pages are read on first use, and writing into a tensor does not
    change the file. Fields that shared a tensor share it again. Structure, names and shapes are
    checked before a tensor's memory is read; stages check the values when they
    use the record (:meth:`~pimper_torch.records.record.Record.check`).

    Returns:
        The record, on the CPU.

    Raises:
        InputError: The file does not exist, is damaged, has a wrong format, or contains a record
            other than ``cls`` as its fields are annotated.
    """
    return load_with_metadata(cls, path)[0]


def load_with_metadata(
    cls: type[AnyRecord], path: str | Path
) -> tuple[AnyRecord, Mapping[str, str]]:
    """Read a record like :func:`load_record`, and the metadata in the file's header."""
    if not Path(path).is_file():
        raise InputError(f"{path}: is not a file; needed: a file that `save_record` wrote.")
    try:
        with safe_open(path, framework="pt") as file:
            metadata: dict[str, str] = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        text = metadata.get(_KEY, "")
        if not 0 < len(text) <= _MAX_STRUCTURE:
            keys = ", ".join(sorted(metadata))[:60] or "only tensors"
            raise InputError(
                f"contains {keys}; needed: {_KEY!r}, as this version of pimper_torch writes it, of "
                f"at most {_MAX_STRUCTURE} bytes."
            )
        record: AnyRecord = of_json(json.loads(text), cls, cls.__name__, tensors)
    except InputError as error:
        raise InputError(f"{path}: {error} {_AGAIN}") from error
    except (OSError, SafetensorError, ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}), it seems truncated or damaged; needed: a complete "
            f"file. {_AGAIN}"
        ) from error
    return record, metadata


def as_json(value: object, names: Mapping[int, str] | None = None) -> str:
    """Write a value as JSON for :func:`of_json`.

    Args:
        names: Names of tensors, by their ``id``.
    """

    def plain(value: object) -> object:
        if isinstance(value, Record | Event):
            fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
            return {"record": type(value).__name__, "fields": fields}
        kind = ""
        if isinstance(value, Tensor):
            # safetensors supports dense tensors of every type but complex128.
            dense = value.layout == torch.strided and not value.is_meta
            if names and id(value) in names and dense and value.dtype != torch.complex128:
                return {"tensor": names[id(value)]}
            kind = f"{value.dtype} {value.layout} "
        raise InputError(
            f"A file cannot contain a {kind}{type(value).__name__}; needed: records, dense tensors "
            "with values, tuples, mappings with string keys, numbers, strings or None."
        )

    return json.dumps(value, default=plain)


def of_json(value: Any, hint: Any, where: str, tensors: Mapping[str, Tensor]) -> Any:  # noqa: ANN401 - JSON
    """Convert parsed JSON of :func:`as_json` to the annotated type, or raise."""
    kind = next((choice for choice in choices(hint) if _fits(value, choice, tensors)), None)
    if kind is None:
        needed = getattr(hint, "__name__", hint)
        raise InputError(f"{where} is {json.dumps(value)[:60]}; needed: {needed}.")

    def inner(item: object, hint: object, name: object) -> Any:  # noqa: ANN401
        return of_json(item, hint, f"{where}.{name}", tensors)

    hints = typing.get_args(kind)
    if _is_a(kind, Record | Event):
        names = [field.name for field in dataclasses.fields(kind)]
        hint_of = typing.get_type_hints(kind)
        fields = value["fields"]
        if fields.keys() != set(names):
            keys = ", ".join(fields)[:200]
            raise InputError(f"{where} has the fields {keys}; needed: {', '.join(names)}.")
        return kind(**{name: inner(fields[name], hint_of[name], name) for name in names})
    if isinstance(value, list):
        items = hints[:1] * len(value) if hints[-1:] == (...,) else hints
        return tuple(map(inner, value, items, range(len(value))))
    if _is_a(kind, AbstractArray | Tensor):
        return tensors[value["tensor"]]
    if isinstance(value, dict):
        return {key: inner(item, hints[1], key) for key, item in value.items()}
    return value


def _fits(value: Any, hint: Any, tensors: Mapping[str, Tensor]) -> bool:  # noqa: ANN401
    """Return whether JSON has the annotated type, regardless of its items."""
    origin, hints = typing.get_origin(hint) or hint, typing.get_args(hint)
    if origin is typing.Literal:
        return any(type(value) is type(choice) and value == choice for choice in hints)
    match value:
        case {"record": name, "fields": dict()} if _is_a(hint, Record | Event):
            return bool(name == hint.__name__)
        case {"tensor": str(name)} if _is_a(hint, AbstractArray | Tensor):
            return name in tensors
        case dict():
            return _is_a(origin, Mapping) and hints[:1] == (str,)
        case list():
            return origin is tuple and (hints[-1:] == (...,) or len(hints) == len(value))
    return type(value) is origin or (type(value) is int and origin is float)


def _is_a(hint: object, cls: type | types.UnionType) -> bool:
    return isinstance(hint, type) and issubclass(hint, cls)


def _apart(tensors: Iterable[tuple[str, Tensor]]) -> dict[str, Tensor]:
    """Return contiguous tensors on the CPU that share no memory, as safetensors needs them."""
    separate = {
        name: tensor.detach().cpu().resolve_conj().resolve_neg().contiguous()
        for name, tensor in tensors
    }
    end = 0
    for name, tensor in sorted(separate.items(), key=lambda item: item[1].data_ptr()):
        if tensor.data_ptr() < end:
            separate[name] = tensor.clone()
        else:
            end = tensor.data_ptr() + tensor.nbytes
    return separate
