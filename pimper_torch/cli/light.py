"""Command lines understood without loading torch, so that help and refusals come at once.

Settings stand beside their stages, in modules that load torch, which takes seconds. Arguments do
not need it: here these modules are imported while packages that take long to load are absent, and
forgotten afterwards.
"""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import tyro  # noqa: F401 - whatever it looks for must not be absent

_PACKAGE = __name__.partition(".")[0]
_HEAVY = (
    *("av", "cholespy", "cv2", "embreex", "fcpw", "jaxtyping", "kornia", "kornia_rs", "matplotlib"),
    *("numba", "numpy", "pi_heif", "PIL", "pycolmap", "rawpy", "safetensors", "scipy", "skimage"),
    *("tifffile", "torch", "trimesh"),
)


@contextmanager
def absent(other: str = _PACKAGE) -> Iterator[None]:
    """Import modules in the block without what takes long to load, and forget them after it.

    Their classes are not those of the package: they serve to read a command line, which is read
    again if it is sound. Where torch is loaded already, nothing is absent.

    Args:
        other: A package beside this one that has such modules.
    """
    if "torch" in sys.modules:
        yield
        return
    before, finder = {*sys.modules}, _Finder()
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        for name in {*sys.modules} - before:
            package, _, last = name.rpartition(".")
            if name.partition(".")[0] in {_PACKAGE, other, *_HEAVY}:
                del sys.modules[name]
                if package in before:
                    vars(sys.modules[package]).pop(last, None)


class _Absent(type):
    """Any use of what is absent gives what is absent; a class may derive from it."""

    def __getattr__(cls, name: str) -> Any:  # noqa: ANN401 - whatever is asked for
        if name.startswith("__"):
            raise AttributeError(name)
        return ABSENT

    def __call__(cls, *given: object, **named: object) -> Any:  # noqa: ANN401
        return ABSENT if cls is ABSENT else super().__call__(*given, **named)

    def __iter__(cls) -> Iterator[Any]:
        return iter(())

    def __int__(cls) -> int:
        return 0

    def __exit__(cls, *_: object) -> None:
        pass


for _use in (
    *("getitem", "or", "ror", "and", "add", "radd", "sub", "rsub", "mul", "rmul", "truediv"),
    *("rtruediv", "pow", "neg", "enter"),
):
    setattr(_Absent, f"__{_use}__", lambda *_: ABSENT)


class ABSENT(metaclass=_Absent):
    """Stands for whatever would take long to load."""


class _Finder(MetaPathFinder, Loader):
    """Finds :class:`ABSENT` in place of every module of a heavy package."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        heavy = fullname.partition(".")[0] in _HEAVY
        return ModuleSpec(fullname, self, is_package=True) if heavy else None

    def create_module(self, spec: ModuleSpec) -> Any:  # noqa: ANN401
        return ABSENT

    def exec_module(self, module: ModuleType) -> None:
        pass
