"""Settings by the name of a preset, or from a file."""

from collections.abc import Mapping
from pathlib import Path

from pimper_torch.chains.chain_config import CoarseToFineConfig
from pimper_torch.paper.paper_config import PublishedConfig
from pimper_torch.runtime.config import build, find_config, overlay, read_mapping, require

Config = CoarseToFineConfig | PublishedConfig


def load_config(
    name_or_path: str | Path = "default", changes: Mapping[str, object] | None = None
) -> Config:
    """Read the settings of a preset or of a YAML file; the file contains only changes to defaults.

    Args:
        name_or_path: ``"default"``, ``"fast"``, ``"paper"``, ``"training"``, or a file. Its
            ``chain`` selects the chain: ``coarse-to-fine``, the default, or ``published``.
        changes: Override the file, nested by stage as in it.

    Raises:
        ConfigError: Names the file or `changes`, section and key, and the nearest valid one.
    """
    require(isinstance(changes, Mapping | None), "changes", changes, "settings nested by stage")
    settings = read_mapping(path := find_config(name_or_path))
    config = _built(settings, str(path))
    return _built(overlay(settings, changes), "changes") if changes else config


def _built(settings: Mapping[str, object], where: str) -> Config:
    chain = settings.get("chain", CoarseToFineConfig.chain)
    configs = (CoarseToFineConfig, PublishedConfig)
    matching = [config for config in configs if config.chain == chain]
    names = " or ".join(config.chain for config in configs)
    require(len(matching) == 1, f"{where}: chain", chain, names)
    config: type[Config] = matching[0]
    return build(config, settings, where)
