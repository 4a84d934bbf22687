"""Chains made from settings, a preset or a file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, overload

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
    """Return the chain for these settings; see :func:`load_chain`."""
    if isinstance(config, PublishedConfig):
        return Published(config, observer, cache, **stages)
    return CoarseToFine(config, observer, cache, **stages)


@overload
def load_chain(
    name_or_path: Literal["default", "fast", "training"] = "default",
    changes: Mapping[str, object] | None = None,
    observer: Observer | None = None,
    cache: Store | Path | str | None = None,
    **stages: nn.Module,
) -> CoarseToFine: ...
@overload
def load_chain(
    name_or_path: Literal["paper"],
    changes: Mapping[str, object] | None = None,
    observer: Observer | None = None,
    cache: Store | Path | str | None = None,
    **stages: nn.Module,
) -> Published: ...
@overload
def load_chain(
    name_or_path: str | Path,
    changes: Mapping[str, object] | None = None,
    observer: Observer | None = None,
    cache: Store | Path | str | None = None,
    **stages: nn.Module,
) -> CoarseToFine | Published: ...
def load_chain(
    name_or_path: str | Path = "default",
    changes: Mapping[str, object] | None = None,
    observer: Observer | None = None,
    cache: Store | Path | str | None = None,
    **stages: nn.Module,
) -> CoarseToFine | Published:
    """Return the chain of a preset or of a file of settings.

    Args:
        name_or_path: ``"default"``, ``"fast"``, ``"training"``, ``"paper"``, or a YAML file.
        changes: Override its settings, nested by stage: ``{"factorize": {"loss": "huber"}}``.
        observer: Receives reports of a run.
        cache: Folder in which the record of every stage is kept; without it, none is.
        stages: Modules that replace the chain's stages, by the names of its attributes.

    Raises:
        ConfigError: Names the file or `changes`, section and key, and the nearest valid one; or
            the chain has no stage of a given name.
    """
    return make_chain(load_config(name_or_path, changes), observer, cache, **stages)
