"""Dense surfaces from photographs of many viewpoints under many unknown lights.

>>> import pimper_torch as pt
>>> views = pt.load_views("photos/")  # doctest: +SKIP
>>> surface = pt.Pimper(pt.load_config("default"))(views)  # doctest: +SKIP
"""

from importlib import import_module
from typing import TYPE_CHECKING

from pimper_torch.errors import (
    ConfigError,
    InputError,
    OutputError,
    PimperError,
    PimperWarning,
    ReconstructionError,
)

if TYPE_CHECKING:
    __version__: str
    from pimper_torch.io.photographs import load_views
    from pimper_torch.io.results import write_result
    from pimper_torch.pipeline import Pimper, PimperConfig, load_config
    from pimper_torch.radiometry import Encoding
    from pimper_torch.sfm.cache import user_cache

__all__ = [
    "ConfigError",
    "Encoding",
    "InputError",
    "OutputError",
    "Pimper",
    "PimperConfig",
    "PimperError",
    "PimperWarning",
    "ReconstructionError",
    "__version__",
    "load_config",
    "load_views",
    "user_cache",
    "write_result",
]

# What needs torch is imported when it is asked for, so that the command line answers at once.
_HOMES = {
    "Encoding": "pimper_torch.radiometry",
    "Pimper": "pimper_torch.pipeline",
    "PimperConfig": "pimper_torch.pipeline",
    "load_config": "pimper_torch.pipeline",
    "load_views": "pimper_torch.io.photographs",
    "user_cache": "pimper_torch.sfm.cache",
    "write_result": "pimper_torch.io.results",
}


def __getattr__(name: str) -> object:
    if name == "__version__":
        return import_module("pimper_torch.io.version").installed_version()
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
