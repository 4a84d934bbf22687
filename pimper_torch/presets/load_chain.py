"""Chains made from settings, a preset or a file."""

from collections.abc import Mapping
from pathlib import Path

from torch import nn

from pimper_torch.chains.coarse_to_fine import CoarseToFine
from pimper_torch.paper.chain import Published
from pimper_torch.paper.paper_config import PublishedConfig
from pimper_torch.presets.load_config import Config, load_config
from pimper_torch.runtime.reporting import Observer
from pimper_torch.store import Store


def make_chain(
    config: Config,
    observer: Observer | None = None,
    cache: Store | Path | str | None = None,
    **stages: nn.Module,
) -> CoarseToFine | Published:
    """Return the chain for these settings.

    Args:
        observer: Receives reports of a run.
        cache: Folder in which the record of every stage is kept; without it, none is.
        stages: Modules that replace the chain's stages, by the names of its attributes.

    Raises:
        ConfigError: The chain has no stage of a given name.
    """
    if isinstance(config, PublishedConfig):
        return Published(config, observer, cache, **stages)
    return CoarseToFine(config, observer, cache, **stages)


def load_chain(
    name_or_path: str | Path = "default",
    changes: Mapping[str, object] | None = None,
    observer: Observer | None = None,
    cache: Store | Path | str | None = None,
    **stages: nn.Module,
) -> CoarseToFine | Published:
    """Return the chain of a preset or file; see :func:`load_config` and :func:`make_chain`."""
    return make_chain(load_config(name_or_path, changes), observer, cache, **stages)
