"""Compilation of kernels: once for each state of their code, in child processes.

Machine code is kept in a folder of the user's that is named by a hash of the kernels' sources, of
numba's version and of the processor: every installation of the same code finds it there. It depends
on what its process compiled before. So each row of modules is compiled by a process of its own,
whole and in order, and a run executes what it loads from disk: the same code every time.
"""

import atexit
import hashlib
import os
import shutil
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.metadata import version
from inspect import unwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, TypeVar, get_origin, get_type_hints

import pimper_torch.ground.kernels
from pimper_torch.runtime.progress import report
from pimper_torch.runtime.user_cache import user_cache

Function = TypeVar("Function", bound=Callable[..., object])

# The kernels of each part of a run, in the order of need.
SFM = ("line_matches", "patch_alignment")
COARSE = ("hull_votes", "window_scores")
PHOTOMETRY = ("resampling", "lights_and_albedo", "factorization")
SWEEP = ("sweep_costs",)
SURFACE = (
    "normal_equations",
    "sparse_products",
    "vector_updates",
    "multigrid_levels",
    "decimation",
)

# What is compiled by a process each, in order: both take about as long.
_SECOND = ("factorization", "multigrid_levels", "decimation")
_FIRST = (*SFM, *COARSE, *PHOTOMETRY, *SWEEP, *SURFACE)
ROWS = (tuple(name for name in _FIRST if name not in _SECOND), _SECOND)

# Of gradients alone: compiled where a run first asks for them.
GRADIENTS = ("factor_adjoint", "resampling_adjoint", "sweep_adjoint")

# Relaxations of IEEE arithmetic for vectorized sums: reordering, fused and reciprocal operations.
# NaN and infinity keep their meaning.
_FAST = {"reassoc", "contract", "arcp", "nsz"}

_NICENESS = 10  # of the children: what the run itself does comes first


def compiled(
    *signatures: str, fast: bool = False, annotated: bool = False
) -> Callable[[Function], Function]:
    """Compile a function for the given types when its module is imported.

    The machine code is cached on disk. The function releases the interpreter's lock (GIL).

    Args:
        signatures: Without any, the function is inlined into the kernels that call it.
        fast: Whether sums may be reordered, as vectorization needs.
        annotated: Whether it is compiled for the types that its annotations name, see
            :mod:`~pimper_torch.ground.kernels.signatures`; it returns nothing.
    """
    import numba
    from filelock import FileLock

    # A function that is called, not inlined, has two versions: its own machine code, and a copy in
    # each kernel, which is optimized again and rounds otherwise. The linker takes the first that is
    # loaded: its own where it has just been compiled, the copy where kernels come from disk.
    called = bool(signatures or annotated)
    decorate = numba.njit(
        nogil=called,
        error_model="numpy",
        forceinline=not called,
        no_cfunc_wrapper=True,
        fastmath=_FAST if fast else False,
    )

    def compile_now(function: Function) -> Function:
        # Shape checkers wrap functions; their wrappers cannot be compiled.
        kernel = decorate(unwrap(function))
        if called:
            kernel._cache = _cache_class()(kernel.py_func)
            wanted = [numba.void(*_numba_types(kernel.py_func))] if annotated else signatures
            module = function.__module__.rpartition(".")[2]
            with FileLock(cache_folder() / f"{module}.lock"):
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
def _cache_class() -> Callable[[object], object]:
    """Return numba's cache of a function, in :func:`cache_folder`: its name says all else."""
    from numba.core.caching import CompileResultCacheImpl, FunctionCache

    place = SimpleNamespace(
        get_cache_path=lambda: str(cache_folder()),
        get_source_stamp=str,
        get_disambiguator=str,
        ensure_cache_path=lambda: None,
    )
    found = [SimpleNamespace(from_function=lambda *_: place)]
    implementation = type("Kernels", (CompileResultCacheImpl,), {"_locator_classes": found})
    return type("KernelCache", (FunctionCache,), {"_impl_class": implementation})


@cache
def cache_folder() -> Path:
    """Return the folder of machine code, which is the user's alone, as code is unpickled from it.

    It is in ``NUMBA_CACHE_DIR`` or the user's cache, or beside the kernels where that cannot be
    written, or a temporary folder.
    """
    import numba
    from numba.core.registry import cpu_target

    sources = Path(pimper_torch.ground.kernels.__path__[0])
    processor = cpu_target.target_context.codegen().magic_tuple()
    compiler = (sys.implementation.cache_tag, numba.__version__, version("llvmlite"), processor)
    code = hashlib.sha256(repr(compiler).encode())
    for source in sorted(sources.glob("*.py")):
        code.update(source.read_bytes())
    name = f"kernels-{code.hexdigest()[:32]}"
    chosen = Path(numba.config.CACHE_DIR or user_cache())
    for folder in (chosen / name, sources / "__pycache__" / name):
        with suppress(OSError):
            folder.mkdir(0o700, parents=True, exist_ok=True)
            if _of_user_alone(folder):
                os.utime(folder)  # in use
                return folder
    folder = Path(tempfile.mkdtemp(), name)
    folder.mkdir(0o700)
    atexit.register(shutil.rmtree, folder.parent, ignore_errors=True)
    return folder


def _of_user_alone(folder: Path) -> bool:
    """Return whether the user may write there, and nobody else."""
    about = folder.lstat()
    alone = os.name == "nt" or (about.st_uid == os.getuid() and not about.st_mode & 0o077)
    return stat.S_ISDIR(about.st_mode) and alone and os.access(folder, os.W_OK)


def load(names: Sequence[str]) -> None:
    """Import modules of kernels, as soon as the children have compiled them.

    Where a child died, what it left is compiled here.
    """
    for done, name in enumerate(names, start=1):
        while not _is_done(name) and any(child.poll() is None for child in compile_ahead()):
            time.sleep(0.05)
        import_module(f"{pimper_torch.ground.kernels.__name__}.{name}")
        report(done, len(names))


def compile_all() -> None:
    """Compile every kernel of a run that is not cached yet."""
    load([name for row in ROWS for name in row])


def all_compiled() -> bool:
    """Return whether no kernel of a run is left to compile."""
    return all(_is_done(name) for row in ROWS for name in row)


def _is_done(name: str) -> bool:
    """Return whether a child has compiled a module whole."""
    return (cache_folder() / f"{name}.done").exists()


@cache
def compile_ahead() -> "tuple[subprocess.Popen[bytes], ...]":
    """Start processes, once, that compile what is not cached; none where all is.

    They end with this one, however that ends: their standard input is closed then.
    """
    path = [str(Path(pimper_torch.__path__[0]).parent), os.environ.get("PYTHONPATH", "")]
    found = {
        "PYTHONPATH": os.pathsep.join(filter(None, path)),
        "NUMBA_CACHE_DIR": str(cache_folder().parent),
    }
    return tuple(
        subprocess.Popen(
            [sys.executable, "-c", f"from {__name__} import _child; _child({row})"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | found,
        )
        for row, names in enumerate(ROWS)
        if not all(map(_is_done, names))
    )


def _child(row: int) -> None:
    """Compile a row, behind whatever else the machine does."""
    from filelock import FileLock

    def end_with_parent() -> None:
        sys.stdin.read()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    with suppress(AttributeError, OSError):  # Windows has no such number
        os.nice(_NICENESS)
    folder = cache_folder()
    with FileLock(folder / f"{row}.lock"):
        if not all(map(_is_done, ROWS[row])):
            # What others left is not loaded: code depends on what was compiled before it.
            _cache_class().load_overload = lambda *_: None  # type: ignore[attr-defined]
            for name in ROWS[row]:
                import_module(f"{pimper_torch.ground.kernels.__name__}.{name}")
                (folder / f"{name}.done").touch()
    forget_unused(folder.parent)
    os._exit(0)


def forget_unused(parent: Path) -> None:
    """Delete folders of code that no run has used for 30 days, a choice."""
    for folder in parent.glob(f"kernels-{'[0-9a-f]' * 32}"):
        if time.time() - folder.stat().st_mtime > 30 * 86_400 and _of_user_alone(folder):
            shutil.rmtree(folder, ignore_errors=True)
