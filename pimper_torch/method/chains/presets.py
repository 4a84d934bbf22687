"""Settings by the name of a preset or from a file, and the chain that they are for."""

from collections.abc import Mapping
from pathlib import Path

from torch import nn

from pimper_torch.method.chains.coarse_to_fine import CoarseToFine, CoarseToFineConfig
from pimper_torch.method.chains.published import Published, PublishedConfig
from pimper_torch.runtime.config import build, find_config, overlay, read_mapping, require
from pimper_torch.runtime.reporting import Observer
from pimper_torch.runtime.store import Store

Config = CoarseToFineConfig | PublishedConfig


def load_config(
    name_or_path: str | Path = "default", changes: Mapping[str, object] | None = None
) -> Config:
    """Read a preset, or a YAML file of one's own, which holds only what differs.

    Args:
        name_or_path: ``"default"``, ``"paper"``, ``"fast"``, or a file. Its ``chain`` says which
            chain it is for: ``coarse-to-fine`` unless given, or ``published``.
        changes: Laid over the file, nested by stage like it.

    Raises:
        ConfigError: Names the file or `changes`, section and key, and the nearest valid one.
    """
    path = find_config(name_or_path)
    settings = read_mapping(path)
    config = _built(settings, str(path))
    return _built(overlay(settings, changes), "changes") if changes else config


def _built(settings: Mapping[str, object], where: str) -> Config:
    """Make the config of the chain that settings are for."""
    chain = settings.get("chain", CoarseToFineConfig.chain)
    found = [config for config in (CoarseToFineConfig, PublishedConfig) if config.chain == chain]
    names = f"{CoarseToFineConfig.chain} or {PublishedConfig.chain}"
    require(len(found) == 1, f"{where}: chain", chain, names)
    config: type[Config] = found[0]
    return build(config, settings, where)


def make_chain(
    config: Config,
    observer: Observer | None = None,
    cache: Store | Path | str | None = None,
    **stages: nn.Module,
) -> CoarseToFine | Published:
    """Make the chain that settings are for.

    Args:
        observer: Hears how a run is going.
        cache: Folder that keeps the record of every stage; nothing is kept without.
        stages: Modules in place of the chain's own, by the names of its attributes.

    Raises:
        ConfigError: The chain has no stage of a name.
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
    """Make the chain of a preset; see :func:`load_config` and :func:`make_chain`."""
    return make_chain(load_config(name_or_path, changes), observer, cache, **stages)
