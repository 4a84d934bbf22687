"""Dense surfaces from photographs of many viewpoints under many unknown lights.

>>> import pimper_torch as pt
>>> views = pt.load_views("photos/")  # doctest: +SKIP
>>> result = pt.load_chain("default")(views)  # doctest: +SKIP
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
    from pimper_torch.chains.chain import Chain, Step
    from pimper_torch.chains.coarse_to_fine import CoarseToFine, CoarseToFineConfig
    from pimper_torch.chains.presets import load_chain, load_config, make_chain
    from pimper_torch.chains.published import Published, PublishedConfig
    from pimper_torch.io.photographs import load_views
    from pimper_torch.io.results import write_result
    from pimper_torch.radiometry import Encoding
    from pimper_torch.sfm.cache import user_cache
    from pimper_torch.stage import Stage

__all__ = [
    "Chain",
    "CoarseToFine",
    "CoarseToFineConfig",
    "ConfigError",
    "Encoding",
    "InputError",
    "OutputError",
    "PimperError",
    "PimperWarning",
    "Published",
    "PublishedConfig",
    "ReconstructionError",
    "Stage",
    "Step",
    "__version__",
    "load_chain",
    "load_config",
    "load_views",
    "make_chain",
    "user_cache",
    "write_result",
]

# What needs torch is imported when it is asked for, so that the command line answers at once.
_HOMES = {
    "Encoding": "pimper_torch.radiometry",
    "Chain": "pimper_torch.chains.chain",
    "Step": "pimper_torch.chains.chain",
    "CoarseToFine": "pimper_torch.chains.coarse_to_fine",
    "CoarseToFineConfig": "pimper_torch.chains.coarse_to_fine",
    "Published": "pimper_torch.chains.published",
    "PublishedConfig": "pimper_torch.chains.published",
    "Stage": "pimper_torch.stage",
    "load_chain": "pimper_torch.chains.presets",
    "load_config": "pimper_torch.chains.presets",
    "make_chain": "pimper_torch.chains.presets",
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
