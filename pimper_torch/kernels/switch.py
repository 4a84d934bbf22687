"""The choice between compiled kernels and torch, and how kernels are compiled."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from importlib import import_module
from inspect import unwrap
from pathlib import Path
from pkgutil import iter_modules
from typing import Literal, TypeVar

import torch
from torch import Tensor

import pimper_torch.kernels
from pimper_torch.progress import track

Kernels = Literal["numba", "torch"]
Function = TypeVar("Function", bound=Callable[..., object])

_chosen: ContextVar[Kernels] = ContextVar("kernels", default="numba")


@contextmanager
def using(kernels: Kernels) -> Iterator[None]:
    """Choose inside the ``with`` block: ``"numba"``, compiled kernels; ``"torch"``, none."""
    token = _chosen.set(kernels)
    try:
        yield
    finally:
        _chosen.reset(token)


def compiled_for(*tensors: Tensor) -> bool:
    """Tell whether compiled kernels may be used: chosen, tensors on the CPU, no gradients."""
    tracked = torch.is_grad_enabled() and any(each.requires_grad for each in tensors)
    on_cpu = all(each.device.type == "cpu" for each in tensors)
    return _chosen.get() == "numba" and on_cpu and not tracked


def forget_stale() -> None:
    """Delete cached machine code older than any kernel's source: kernels inline one another.

    Where the installation is read-only, numba caches elsewhere, and nothing is deleted.
    """
    folder = Path(pimper_torch.kernels.__path__[0])
    newest = max(source.stat().st_mtime for source in folder.glob("*.py"))
    for kept in folder.glob("__pycache__/*.nb[ci]"):
        with suppress(FileNotFoundError, PermissionError):  # another process was first, or may not
            if kept.stat().st_mtime < newest:
                kept.unlink()


forget_stale()

# Relaxations of IEEE arithmetic for vectorized sums: reordering, fused and reciprocal operations.
# NaN and infinity keep their meaning.
_FAST = {"reassoc", "contract", "arcp", "nsz"}


def compiled(
    *signatures: str, fast: bool = False, inline: bool = False
) -> Callable[[Function], Function]:
    """Compile a function for the given types when its module is imported.

    The machine code is cached on disk. The function releases the interpreter's lock (GIL).

    Args:
        signatures: Without any, the function is compiled with the kernels that call it.
        fast: Whether sums may be reordered, as vectorization needs.
        inline: Whether it is inlined into its callers, as vectorized loops need.
    """
    import numba

    decorate = numba.njit(
        list(signatures) or None,
        cache=True,
        nogil=True,
        error_model="numpy",
        forceinline=inline,
        fastmath=_FAST if fast else False,
    )
    # Shape checkers wrap functions; their wrappers cannot be compiled.
    return lambda function: decorate(unwrap(function))


def compile_all() -> None:
    """Compile every kernel that is not cached yet; 50 s, once per installation."""
    names = [found.name for found in iter_modules(pimper_torch.kernels.__path__)]
    for name in track(names):
        import_module(f"{pimper_torch.kernels.__name__}.{name}")
