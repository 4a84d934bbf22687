"""Dense surfaces from photographs of many viewpoints under many unknown lights.

>>> import pimper_torch as pt
>>> chain = pt.load_chain("default")
>>> result = chain(pt.load_views("photos/"))  # doctest: +SKIP
>>> pt.write_result(result, chain.config, "out/")  # doctest: +SKIP

Photographs and cameras at hand come in by ``scene_of``. The rest is in rooms, which completion and
``dir`` list:

- ``records``: what goes in, what stages hand over, and what comes out, such as ``pt.records.Mesh``
- ``stages``: what a chain is made of, to swap or to call alone, and the settings of each
- ``priors``, ``prior_files``: guesses of networks, in memory and in folders
- ``size``, ``viz``: real size by markers or lengths; figures
- ``exchange``, ``radiometry``, ``store``: folders of results; response curves; kept stages
- ``batches``, ``single_view``: many objects; one viewpoint under many lights
- ``errors``: all that are raised on purpose are ``PimperError``

What documents call ``pt.Mesh`` or ``pt.Warp`` is that of its room.
"""

from importlib import import_module

import lazy_loader

# Public names stand in `__init__.pyi`, for type checkers, too. What needs torch is imported when it
# is asked for, so that the command line answers at once.
_public, _, _names = lazy_loader.attach_stub(__name__, __file__)

# Rooms that users look into, and their floors; other modules stand where the tree shows them.
_ROOMS = {
    "batches": "cli",
    "errors": "runtime",
    "export": "doors",
    "prior_files": "priors",
    "radiometry": "ground",
    "scale": "doors",
    "store": "runtime",
    "viz": "result",
}

_RENAMED = {"exchange": "export", "settled": "resolve_prior_conventions", "size": "scale"}

__all__ = [
    *("batches", "errors", "export", "prior_files", "priors", "radiometry", "records"),
    *("single_view", "scale", "stages", "store", "viz"),
    *("load_views", "scene_of", "read_mesh", "load_chain", "load_config", "find_scale", "show"),
    *("write_result", "read_result", "PimperError", "__version__"),
]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from pimper_torch.doors.io.version import installed_version

        return installed_version()
    if name in _RENAMED:
        from pimper_torch.runtime.renamed import renamed

        return __getattr__(renamed(f"pimper_torch.{name}", _RENAMED[name]))
    if name in _ROOMS:
        return import_module(f"{__name__}.{_ROOMS[name]}.{name}")
    return _public(name)


def __dir__() -> list[str]:
    return sorted(__all__)
