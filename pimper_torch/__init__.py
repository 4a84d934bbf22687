"""Dense surfaces from photographs of many viewpoints under many unknown lights.

>>> import pimper_torch as pt
>>> views = pt.load_views("photos/")  # doctest: +SKIP
>>> result = pt.load_chain("default")(views)  # doctest: +SKIP
"""

import lazy_loader

# Public names stand in `__init__.pyi`, for type checkers, too. What needs torch is imported when it
# is asked for, so that the command line answers at once.
_public, _, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__"]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from pimper_torch.io.version import installed_version

        return installed_version()
    return _public(name)


def __dir__() -> list[str]:
    return sorted(__all__)
