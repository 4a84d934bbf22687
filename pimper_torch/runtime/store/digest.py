"""A hash of what values hold, bit for bit: records, tensors, settings, stages and functions."""

import dataclasses
import hashlib
import json
import types
from collections.abc import Mapping
from contextlib import suppress
from enum import Enum
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.utils.weak import WeakTensorKeyDictionary

from pimper_torch.runtime.mapped import LARGE, drop_pages

_PACKAGE = Path(__file__).parents[2]


# Packages that stages compute with.
_COMPUTE = (
    *("torch", "numpy", "scipy", "numba", "pycolmap", "kornia", "opencv-python-headless"),
    *("scikit-image", "trimesh", "embreex", "fcpw", "cholespy"),
)


@cache
def code() -> str:
    """Hash all source files of the package, and the versions of what it computes with."""
    hashed = hashlib.blake2b(digest_size=16)
    for name in _COMPUTE:
        with suppress(PackageNotFoundError):  # as where another program installed it
            hashed.update(f"{name} {version(name)} ".encode())
    for path in sorted(_PACKAGE.rglob("*.py")):
        hashed.update(path.relative_to(_PACKAGE).as_posix().encode() + path.read_bytes())
    return hashed.hexdigest()


def is_known(module: str) -> bool:
    """Return whether :func:`code` covers a module: one of this package, or of torch's layers."""
    return module.startswith((f"{_PACKAGE.name}.", "torch.nn."))


# Of tensors that were hashed, while they live: their version when they were, and the hash. Stages
# hand on the same tensors, and writing into a tensor counts up its version.
_known: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def digest(*values: object) -> str | None:
    """Hash values, so that equal hashes mean equal bits.

    A module is what it is made with: its class, attributes and submodules. The code of modules and
    functions counts, see :func:`~pimper_torch.runtime.store.digest.code`. A tensor's device counts,
    its memory layout doesn't, nor do fields that are not compared, as where files lie.

    Args:
        values: Records and other dataclasses, tensors, modules, functions, tuples, lists, mappings,
            enums, paths, numbers, texts, bytes or ``None``.

    Returns:
        Hexadecimal; ``None`` where something cannot be hashed, as code of other packages, or
        gradients are asked for.
    """
    try:
        text = json.dumps([_described(value) for value in values])
    except _UnknownError:
        return None
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


class _UnknownError(Exception):
    """A value that cannot be hashed."""


def _described(value: object) -> object:
    """Turn a value into what JSON holds, one to one."""
    if value is None or isinstance(value, bool | int | str):
        return value
    kind = _named(type(value))
    if isinstance(value, Tensor):
        return [kind, _tensor(value)]
    if isinstance(value, float | complex | bytes | Path | Enum):
        return [kind, repr(value)]
    if isinstance(value, types.FunctionType | nn.Module):
        if not is_known(value.__module__):
            raise _UnknownError
        if isinstance(value, types.FunctionType):
            return [kind, code(), _named(value)]
        own = {
            name: held
            for name, held in vars(value).items()
            if not name.startswith("_") and name != "training"
        }
        return [kind, code(), _described(own | value._parameters | value._buffers | value._modules)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [field.name for field in dataclasses.fields(value) if field.compare]
        return [kind, *((name, _described(getattr(value, name))) for name in fields)]
    if isinstance(value, Mapping):
        return ["map", *((_described(key), _described(inner)) for key, inner in value.items())]
    if isinstance(value, tuple | list):
        return [kind, *map(_described, value)]
    raise _UnknownError


def _named(thing: type | types.FunctionType) -> str:
    """Name a class or function; those made inside a function may differ under one name."""
    if "<" in thing.__qualname__:
        raise _UnknownError
    return f"{thing.__module__}.{thing.__qualname__}"


def _tensor(tensor: Tensor) -> str:
    if tensor.requires_grad or tensor.layout != torch.strided or tensor.is_meta:
        raise _UnknownError
    # An inference tensor has no version; it cannot be written into outside inference mode.
    version = -1 if tensor.is_inference() else tensor._version
    known: tuple[int, str] | None = _known.get(tensor)  # type: ignore[no-untyped-call]
    if known is not None and known[0] == version:
        return known[1]
    about = f"{tensor.dtype} {tuple(tensor.shape)} {tensor.device.type}"
    hashed = hashlib.blake2b(about.encode(), digest_size=16)
    flat = tensor.detach().cpu().resolve_conj().resolve_neg().reshape(-1)
    if flat.stride() != (1,):  # one entry may have any stride
        flat = flat.clone(memory_format=torch.contiguous_format)
    for part in torch.split(flat.view(torch.uint8), LARGE):
        hashed.update(part.numpy().data)
        drop_pages()
    found = hashed.hexdigest()
    _known[tensor] = (version, found)
    return found
