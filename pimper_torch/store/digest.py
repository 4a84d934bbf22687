"""Hashes of the exact bits of values: records, tensors, settings, stages and functions."""

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

_PACKAGE = Path(__file__).parents[1]

# Packages whose versions can change the results of stages.
_COMPUTE = (
    *("torch", "numpy", "scipy", "numba", "pycolmap", "kornia", "opencv-python-headless"),
    *("scikit-image", "trimesh", "embreex", "fcpw", "cholespy"),
)


@cache
def code() -> str:
    """Return a hash of all code and weights of the package and of the versions it computes with."""
    hashed = hashlib.blake2b(digest_size=16)
    for name in _COMPUTE:
        with suppress(PackageNotFoundError):  # optional, or installed without metadata
            hashed.update(f"{name} {version(name)} ".encode())
    for path in sorted([*_PACKAGE.rglob("*.py"), *_PACKAGE.rglob("*.safetensors")]):
        hashed.update(path.relative_to(_PACKAGE).as_posix().encode() + path.read_bytes())
    return hashed.hexdigest()


def is_known(module: str) -> bool:
    """Return whether :func:`code` covers a module: one of this package, or of torch's layers."""
    return module.startswith((f"{_PACKAGE.name}.", "torch.nn."))


# Version and hash of live tensors that were hashed or deferred. Stages pass on the same tensors,
# and writing into a tensor increments its version.
known_hashes: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def digest(*values: object) -> str | None:
    """Return a hash of values, so that equal hashes mean equal bits.

    A module is hashed by its class, attributes and submodules. The code of modules and functions
    counts, see :func:`~pimper_torch.store.digest.code`. A tensor's device counts; its
    memory layout does not, nor do fields excluded from comparison, such as paths of files.

    Args:
        values: Records and other dataclasses, tensors, modules, functions, classes, tuples, lists,
            mappings, enums, paths, numbers, texts, bytes or ``None``.

    Returns:
        Hexadecimal; ``None`` for values such as code of other packages, or with gradients.
    """
    try:
        text = json.dumps([_described(value) for value in values])
    except _UnknownError:
        return None
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


class _UnknownError(Exception):
    """A value that cannot be hashed."""


def _described(value: object) -> object:
    """Return a value as JSON types, so that different values stay different."""
    if value is None or isinstance(value, bool | int | str):
        return value
    kind = _named(type(value))
    if isinstance(value, Tensor):
        return [kind, tensor_hash(value)]
    if isinstance(value, float | complex | bytes | Path | Enum):
        return [kind, repr(value)]
    if isinstance(value, types.FunctionType | nn.Module | type):
        if not is_known(value.__module__):
            raise _UnknownError
        if not isinstance(value, nn.Module):
            return [kind, code(), _named(value)]
        public = {
            name: attribute
            for name, attribute in vars(value).items()
            if not name.startswith("_") and name != "training"
        }
        members = public | value._parameters | value._buffers | value._modules
        return [kind, code(), _described(members)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [field.name for field in dataclasses.fields(value) if field.compare]
        return [kind, *((name, _described(getattr(value, name))) for name in fields)]
    if isinstance(value, Mapping):
        return ["map", *((_described(key), _described(inner)) for key, inner in value.items())]
    if isinstance(value, tuple | list):
        return [kind, *map(_described, value)]
    raise _UnknownError


def _named(kind: type | types.FunctionType) -> str:
    """Return the full name of a class or function; refuse local ones, as names may repeat."""
    if "<" in kind.__qualname__:
        raise _UnknownError
    return f"{kind.__module__}.{kind.__qualname__}"


def tensor_hash(tensor: Tensor) -> str:
    """Return a hash of a tensor's bits, shape, type and device, computed once while it lives."""
    if tensor.requires_grad or tensor.layout != torch.strided or tensor.is_meta:
        raise _UnknownError
    # An inference tensor has no version; it cannot be written to outside inference mode.
    version = -1 if tensor.is_inference() else tensor._version
    cached: tuple[int, str] | None = known_hashes.get(tensor)  # type: ignore[no-untyped-call]
    if cached is not None and cached[0] == version:
        return cached[1]
    about = f"{tensor.dtype} {tuple(tensor.shape)} {tensor.device.type}"
    hashed = hashlib.sha256(about.encode())  # processors have instructions for it
    flat = tensor.detach().cpu().resolve_conj().resolve_neg().reshape(-1)
    if flat.stride() != (1,):  # a tensor of one element may have any stride
        flat = flat.clone(memory_format=torch.contiguous_format)
    for chunk in torch.split(flat.view(torch.uint8), LARGE):
        hashed.update(chunk.numpy().data)
        drop_pages()
    known_hashes[tensor] = (version, hashed.hexdigest())
    return hashed.hexdigest()
