"""Dense surfaces from photographs, each from a different viewpoint under a different unknown light.

>>> import pimper_torch as pt
>>> chain = pt.load_chain("default")
>>> result = chain(pt.load_views("photos/"))  # doctest: +SKIP
>>> pt.write_result(result, chain.config, "out/")  # doctest: +SKIP

``scene_of`` takes images and cameras as tensors. The rest is in subpackages, which ``dir`` lists:

- ``records``: inputs and outputs of stages and chains, such as ``pt.records.Mesh``
- ``stages``: the stages of chains with their settings, to replace or to call alone
- ``priors``, ``prior_files``: estimates of networks, in memory and in folders
- ``data``, ``losses``: captures in a folder as a data set; losses of a surface for training
- ``scale``, ``viz``: real size from markers or lengths; figures
- ``export``, ``radiometry``, ``store``: folders of results; response curves; kept records of stages
- ``batches``, ``single_view``: many objects; one viewpoint under many lights
- ``errors``: all errors raised on purpose are a ``PimperError``

Public names of subpackages also work without it: ``pt.Mesh``, ``pt.Warp``.
"""

from importlib import import_module

import lazy_loader

from pimper_torch.runtime import former_modules

# Public names are listed in `__init__.pyi`, also for type checkers. Modules that need torch are
# imported on first use, so the command line starts fast.
_public, _, _names = lazy_loader.attach_stub(__name__, __file__)

former_modules.install()

# Public subpackages below another one.
_NESTED = {"batches": "cli", "errors": "runtime", "prior_files": "priors"}

__all__ = [
    *("batches", "data", "errors", "export", "losses", "prior_files", "priors", "radiometry"),
    *("records", "single_view", "scale", "stages", "store", "viz"),
    *("load_views", "scene_of", "load_chain", "load_config", "find_scale", "show"),
    *("write_result", "read_result", "write_mesh", "read_mesh", "load_record"),
    *("PimperError", "__version__"),
]
# Also completed, but not printed by `help`, which would be longer than a screen.
_COMPLETED = ("Encoding", "Given", "priors_of", "save_record")


def __getattr__(name: str) -> object:
    if name == "__version__":
        from pimper_torch.io.version import installed_version

        return installed_version()
    if name in _NESTED:
        return import_module(f"{__name__}.{_NESTED[name]}.{name}")
    return _public(name)


def __dir__() -> list[str]:
    return sorted([*__all__, *_COMPLETED])
