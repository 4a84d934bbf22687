"""Compilation of kernels: once per installation, some of them in a child process.

Machine code is cached on disk, in numba's folder. A kernel is compiled when its module is imported.
Every module has a lock there, so that no two processes compile the same kernel.
"""

import atexit
import os
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from contextvars import ContextVar
from functools import cache
from importlib import import_module
from inspect import unwrap
from pathlib import Path
from typing import Annotated, TypeVar, get_origin, get_type_hints

import pimper_torch.ground.kernels
from pimper_torch.runtime.progress import report

Function = TypeVar("Function", bound=Callable[..., object])

# The kernels of each part of a run, in the order of need.
SFM = ("line_matches", "patch_alignment")
COARSE = ("window_scores",)
PHOTOMETRY = ("resampling", "lights_and_albedo", "factorization")
SWEEP = ("sweep_costs",)
SURFACE = (
    "normal_equations",
    "sparse_products",
    "vector_updates",
    "multigrid_levels",
    "decimation",
)

# Of gradients alone: compiled where a run first asks for them.
GRADIENTS = ("factor_adjoint", "lookup_adjoint", "resampling_adjoint", "sweep_adjoint")

# Relaxations of IEEE arithmetic for vectorized sums: reordering, fused and reciprocal operations.
# NaN and infinity keep their meaning.
_FAST = {"reassoc", "contract", "arcp", "nsz"}

_NICENESS = 10  # of the child: what the run itself does comes first

# Whether a kernel that another process compiles is waited for.
_blocking: ContextVar[bool] = ContextVar("blocking", default=True)


def compiled(
    *signatures: str, fast: bool = False, annotated: bool = False
) -> Callable[[Function], Function]:
    """Compile a function for the given types when its module is imported.

    The machine code is cached on disk. The function releases the interpreter's lock (GIL).

    Args:
        signatures: Without any, the function is inlined into the kernels that call it.
        fast: Whether sums may be reordered, as vectorization needs.
        annotated: Whether it is compiled for the types that its annotations name, see
            :mod:`~pimper_torch.ground.kernels.arrays`; it returns nothing.

    Raises:
        filelock.Timeout: Another process compiles its module, and :func:`load` has others to do.
    """
    import numba
    from filelock import FileLock

    # A function that is called, not inlined, has two versions: its own machine code, and a copy in
    # each kernel, which is optimized again and rounds otherwise. The linker takes the first that is
    # loaded: its own where it has just been compiled, the copy where kernels come from disk.
    called = bool(signatures or annotated)
    decorate = numba.njit(
        cache=called,
        nogil=called,
        error_model="numpy",
        forceinline=not called,
        no_cpython_wrapper=not called,
        no_cfunc_wrapper=True,
        fastmath=_FAST if fast else False,
    )

    def compile_now(function: Function) -> Function:
        # Shape checkers wrap functions; their wrappers cannot be compiled.
        kernel = decorate(unwrap(function))
        wanted = [numba.void(*_numba_types(unwrap(function)))] if annotated else [*signatures]
        if wanted:
            module = function.__module__.rpartition(".")[2]
            with FileLock(cache_folder() / f"{module}.lock", blocking=_blocking.get()):
                for signature in wanted:
                    kernel.compile(signature)
            kernel.disable_compile()
        return kernel

    return compile_now


def _numba_types(annotated: object) -> list[object]:
    """Return numba's types of arguments of a function, or of fields of a named tuple."""
    from numba import types
    from numba.core.sigutils import normalize_signature

    found: list[object] = []
    for name, hint in get_type_hints(annotated, include_extras=True).items():
        if name == "return":
            continue
        if get_origin(hint) is Annotated:
            found.append(normalize_signature(f"void({hint.__metadata__[0]})")[0][0])
        elif issubclass(hint, tuple):
            fields = _numba_types(hint)
            alike = len({*fields}) == 1
            found.append(
                types.NamedUniTuple(fields[0], len(fields), hint)
                if alike
                else types.NamedTuple(fields, hint)
            )
        else:
            found.append(types.int64 if hint is int else types.float64)
    return found


@cache
def cache_folder() -> Path:
    """Return numba's folder of these kernels: beside them unless that is read-only."""
    import numba

    folder = Path(numba.njit(cache=True)(_newest_source).stats.cache_path)
    forget_stale(folder)
    return folder


def forget_stale(folder: Path) -> None:
    """Delete machine code older than any kernel's source: kernels inline one another."""
    newest = _newest_source()
    for kept in folder.glob("*.nb[ci]"):
        with suppress(FileNotFoundError, PermissionError):  # another process was first, or may not
            if kept.stat().st_mtime < newest:
                kept.unlink()


def _newest_source() -> float:
    """Return when a kernel was last edited."""
    folder = Path(pimper_torch.ground.kernels.__path__[0])
    return max(source.stat().st_mtime for source in folder.glob("*.py"))


def load(names: Sequence[str]) -> None:
    """Import modules of kernels; those that another process compiles come last."""
    from filelock import Timeout

    queue, others_first = deque(names), len(names)
    while queue:
        name = queue.popleft()
        token = _blocking.set(others_first <= 0)
        try:
            import_module(f"{pimper_torch.ground.kernels.__name__}.{name}")
        except Timeout:
            queue.append(name)
        finally:
            _blocking.reset(token)
        others_first -= 1
        report(len(names) - len(queue), len(names))


def compile_all() -> None:
    """Compile every kernel of a run that is not cached yet."""
    load((*SFM, *COARSE, *PHOTOMETRY, *SWEEP, *SURFACE))
    _stamp().touch()


def _stamp() -> Path:
    """Return the file that is newer than all kernels once all are compiled for this processor."""
    import numba
    from numba.core.registry import cpu_target

    _, processor, _ = cpu_target.target_context.codegen().magic_tuple()
    version = f"{sys.implementation.cache_tag}-{numba.__version__}"
    return cache_folder() / f"compiled-{version}-{processor}"


def all_compiled() -> bool:
    """Return whether no kernel of a run is left to compile."""
    stamp = _stamp()
    return stamp.exists() and stamp.stat().st_mtime >= _newest_source()


@cache
def compile_ahead() -> "subprocess.Popen[bytes] | None":
    """Start a process, once, that compiles what is not cached; ``None`` where all is.

    It ends with this one, however that ends: its standard input is closed then.
    """
    if all_compiled():
        return None
    path = [str(Path(pimper_torch.__path__[0]).parent), os.environ.get("PYTHONPATH", "")]
    child = subprocess.Popen(
        [sys.executable, "-c", "from pimper_torch.ground.kernels.compile import _child; _child()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, path))},
    )

    @atexit.register
    def end() -> None:
        child.kill()
        child.wait()

    return child


def _child() -> None:
    """Compile everything, behind whatever else the machine does."""

    def end_with_parent() -> None:
        sys.stdin.read()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    with suppress(AttributeError, OSError):  # Windows has no such number
        os.nice(_NICENESS)
    compile_all()
    os._exit(0)
