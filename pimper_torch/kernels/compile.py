"""Compilation of kernels: once for each version of their code, in child processes.

Machine code is cached in a user folder named by a hash of the kernels' sources, numba's version and
the processor, so all installations of the same code share it. The code of a module depends on the
modules that its process compiled before. So each row of modules is compiled completely and in order
by a separate process, and a run loads the machine code from disk: the same code every time.
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
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.metadata import version
from inspect import unwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, TypeVar, get_origin, get_type_hints

import pimper_torch.kernels
from pimper_torch.runtime.errors import caution
from pimper_torch.runtime.progress import report
from pimper_torch.runtime.user_cache import user_cache

Function = TypeVar("Function", bound=Callable[..., object])

# Kernels of each part of a run, in the order of their use.
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

# Only for gradients; the last one takes most of the time.
GRADIENTS = ("resampling_adjoint", "sweep_adjoint", "factor_adjoint")

# Rows of modules that one process compiles, in order: those of a run take about as long.
_SECOND = ("factorization", "multigrid_levels", "decimation")
_FIRST = (*SFM, *COARSE, *PHOTOMETRY, *SWEEP, *SURFACE)
ROWS = (tuple(name for name in _FIRST if name not in _SECOND), _SECOND, GRADIENTS)

# Relaxations of IEEE arithmetic for vectorized sums: reordering, fused and reciprocal operations.
# NaN and infinity keep their meaning.
_FAST = {"reassoc", "contract", "arcp", "nsz"}

_PATIENCE_S = 1200.0  # a choice: a row takes a quarter of that on two cores


def compiled(
    *signatures: str, fast: bool = False, annotated: bool = False
) -> Callable[[Function], Function]:
    """Return a decorator that compiles a function when its module is imported.

    The machine code is cached on disk. The function releases the interpreter's lock (GIL).

    Args:
        signatures: Types of arguments; without any, the function is inlined into its callers.
        fast: Whether sums may be reordered, as vectorization requires.
        annotated: Whether the types are those of its annotations, see
            :mod:`~pimper_torch.kernels.signatures`; the function returns ``None``.
    """
    import numba

    # A function that is not inlined has two versions: its own machine code, and a copy in each
    # calling kernel, which is optimized again and rounds differently. The linker uses the first one
    # loaded: its own if it has just been compiled, the copy if kernels are loaded from disk.
    called = bool(signatures or annotated)
    decorate = numba.njit(
        nogil=called,
        error_model="numpy",
        forceinline=not called,
        no_cfunc_wrapper=True,
        fastmath=_FAST if fast else False,
    )

    def compile_now(function: Function) -> Function:
        # Shape checkers wrap functions, and the wrappers cannot be compiled.
        kernel = decorate(unwrap(function))
        if called:
            kernel._cache = _cache_class()(kernel.py_func)
            types = [numba.void(*_numba_types(kernel.py_func))] if annotated else signatures
            for signature in types:
                with suppress(OSError):  # saving is the last step: the folder may be read-only
                    kernel.compile(signature)
            kernel.disable_compile()
        return kernel

    return compile_now


def _numba_types(annotated: object) -> list[object]:
    """Return numba's types of a function's arguments, or of a named tuple's fields."""
    from numba import types
    from numba.core.sigutils import normalize_signature

    result: list[object] = []
    for name, hint in get_type_hints(annotated, include_extras=True).items():
        if name == "return":
            continue
        if get_origin(hint) is Annotated:
            result.append(normalize_signature(f"void({hint.__metadata__[0]})")[0][0])
        elif issubclass(hint, tuple):
            result.append(types.BaseTuple.from_types(_numba_types(hint), hint))
        else:
            result.append(types.int64 if hint is int else types.float64)
    return result


@cache
def _cache_class() -> Callable[[object], object]:
    """Return a class for numba's cache in :func:`cache_folder`, which identifies the code."""
    from numba.core.caching import CompileResultCacheImpl, FunctionCache

    locator = SimpleNamespace(
        get_cache_path=lambda: str(cache_folder()),
        get_source_stamp=str,
        get_disambiguator=str,
        ensure_cache_path=lambda: None,
    )
    locators = [SimpleNamespace(from_function=lambda *_: locator)]
    implementation = type("Kernels", (CompileResultCacheImpl,), {"_locator_classes": locators})
    return type("KernelCache", (FunctionCache,), {"_impl_class": implementation})


@cache
def cache_folder() -> Path:
    """Return the folder of machine code, accessible to the user only: code is unpickled from it.

    It is in ``NUMBA_CACHE_DIR`` or the user's cache. If that is incomplete and not writable, it is
    next to the kernels, or else a temporary folder, with a warning.
    """
    import numba
    from numba.core.registry import cpu_target

    beside = Path(pimper_torch.kernels.__path__[0], "__pycache__")
    processor = cpu_target.target_context.codegen().magic_tuple()
    compiler = (sys.implementation.cache_tag, numba.__version__, version("llvmlite"), processor)
    code = hashlib.sha256(repr(compiler).encode())
    for source in sources():
        code.update(source.read_bytes())
    name = f"kernels-{code.hexdigest()[:32]}"
    places = [beside / name]
    with suppress(RuntimeError):  # the user has no home
        places.insert(0, Path(numba.config.CACHE_DIR or user_cache(), name))
    for folder in places:
        with suppress(OSError):
            folder.mkdir(0o700, parents=True, exist_ok=True)
            if _is_private(folder) and (os.access(folder, os.W_OK) or all_compiled(folder)):
                with suppress(OSError):
                    os.utime(folder)  # marks it as in use for forget_unused
                return folder
    caution(
        f"{places[0]}: this user cannot write there, or others can, so kernels are compiled in "
        "every run. Set NUMBA_CACHE_DIR to a folder of this user."
    )
    folder = Path(tempfile.mkdtemp(), name)
    folder.mkdir(0o700)
    atexit.register(shutil.rmtree, folder.parent, ignore_errors=True)
    return folder


def sources() -> list[Path]:
    """Return the files of all folders of kernels: this one, and those of stages."""
    return sorted(Path(pimper_torch.kernels.__path__[0]).parent.rglob("kernels/*.py"))


@cache
def modules() -> Mapping[str, str]:
    """Return the modules of kernels by the names of their files, which are unique."""
    package = Path(pimper_torch.__path__[0])
    inside = [source.relative_to(package.parent).with_suffix("") for source in sources()]
    return {path.name: ".".join(path.parts) for path in inside}


def _is_private(folder: Path) -> bool:
    """Return whether only the user has access to a folder."""
    status = folder.lstat()
    private = os.name == "nt" or (status.st_uid == os.getuid() and not status.st_mode & 0o077)
    return stat.S_ISDIR(status.st_mode) and private


def load(names: Sequence[str]) -> None:
    """Import modules of kernels when the children have compiled them.

    If a child died, this process compiles the rest.
    """
    late, gradients = time.monotonic() + _PATIENCE_S, not set(GRADIENTS).isdisjoint(names)
    for done, name in enumerate(names, start=1):
        while not _is_done(name) and any(c.poll() is None for c in compile_ahead(gradients)):
            time.sleep(0.05)
            if time.monotonic() > late:
                late += _PATIENCE_S
                caution(
                    f"{cache_folder()}: kernels are not compiled yet. If no other run compiles "
                    "them, delete the files *.lock there."
                )
        import_module(modules().get(name, name))
        report(done, len(names))


def all_compiled(folder: Path | None = None) -> bool:
    """Return whether all kernels of a run are cached, by default in :func:`cache_folder`."""
    return all(_is_done(name, folder) for name in _FIRST)


def _is_done(name: str, folder: Path | None = None) -> bool:
    """Return whether a child has completely compiled a module."""
    return Path(folder or cache_folder(), f"{name}.done").exists()


def compile_ahead(gradients: bool = False) -> "list[subprocess.Popen[bytes]]":
    """Return the processes that compile what is not cached, started once; also for gradients.

    They end with this process in any case, because their standard input is closed then.
    """
    children = map(_started, range(len(ROWS) if gradients else len(ROWS) - 1))
    return [child for child in children if child is not None]


@cache
def _started(row: int) -> "subprocess.Popen[bytes] | None":
    if all(map(_is_done, ROWS[row])):
        return None
    path = [str(Path(pimper_torch.__path__[0]).parent), os.environ.get("PYTHONPATH", "")]
    variables = {
        "PYTHONPATH": os.pathsep.join(filter(None, path)),
        "NUMBA_CACHE_DIR": str(cache_folder().parent),
    }
    return subprocess.Popen(
        [sys.executable, "-c", f"from {__name__} import _child; _child({row})"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | variables,
    )


def _child(row: int) -> None:
    """Compile a row of modules, at low priority, unless another process compiles it."""
    from filelock import FileLock

    def end_with_parent() -> None:
        sys.stdin.read()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    with suppress(AttributeError, OSError):  # not on Windows
        os.nice(10)  # the run itself has priority
    folder = cache_folder()
    lock = FileLock(folder / f"{row}.lock", timeout=_PATIENCE_S)
    # After a timeout, or on a disk without locks, both compile: numba replaces files as a whole.
    with suppress(OSError, NotImplementedError):
        lock.acquire()
    if not all(map(_is_done, ROWS[row])):
        # Code depends on modules compiled before: gradients are last, others load no foreign code.
        if ROWS[row] == GRADIENTS:
            load(_FIRST)
        else:
            _cache_class().load_overload = lambda *_: None  # type: ignore[attr-defined]
        for name in ROWS[row]:
            import_module(modules().get(name, name))
            (folder / f"{name}.done").touch()
    lock.release()
    forget_unused(folder.parent)
    os._exit(0)


def forget_unused(parent: Path) -> None:
    """Delete folders of machine code not used for 30 days, a choice."""
    for folder in parent.glob(f"kernels-{'[0-9a-f]' * 32}"):
        if time.time() - folder.stat().st_mtime > 30 * 86_400 and _is_private(folder):
            shutil.rmtree(folder, ignore_errors=True)
