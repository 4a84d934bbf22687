"""Settings by the name of a preset or from a file, and the chain that they are for."""

from collections.abc import Mapping
from pathlib import Path

from torch import nn

from pimper_torch.chains.coarse_to_fine import CoarseToFine, CoarseToFineConfig
from pimper_torch.chains.published import Published, PublishedConfig
from pimper_torch.config import build, find_config, overlay, read_mapping, require
from pimper_torch.errors import ConfigError
from pimper_torch.reporting import Observer
from pimper_torch.store import Store

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
        ConfigError: Names the file, the section and the key, and the nearest valid one.
    """
    path = find_config(name_or_path)
    settings = overlay(read_mapping(path), changes or {})
    _refuse_former(settings, str(path))
    chain = settings.get("chain", CoarseToFineConfig.chain)
    found = [config for config in (CoarseToFineConfig, PublishedConfig) if config.chain == chain]
    names = f"{CoarseToFineConfig.chain} or {PublishedConfig.chain}"
    require(len(found) == 1, f"{path}: chain", chain, names)
    config: type[Config] = found[0]
    return build(config, settings, str(path))


# Settings that had other names, and what each is now. Those that are the same for all photographs
# are constants, or arguments of the stages in Python.
_FORMER = {
    "rounds.scales": "`scales`",
    "rounds.all_round": "`chain`: coarse-to-fine sees all round, published one side",
    "outline": "`silhouettes`, with object, region and size_px",
    "rims": "no setting: `contour_rays` takes a `RayConfig`",
    "enclose": "`coarse_surface`, with reference and num_facets",
    "adapt": "`remesh`",
    "mend": "no setting: `Repair` takes a `RepairConfig`",
    "fuse.rims": "`fuse.terms`, by contour_rays",
    **{
        f"fuse.{former}": f"`fuse.terms`, by {name}"
        for former, name in [
            *(("slopes", "normals"), ("heights", "swept_heights")),
            *(("points", "cloud_points"), ("contours", "contour_rays")),
        ]
    },
    "fuse.drift_rounds": "`fuse.bias_iterations`",
    "fuse.noise_rounds": "`fuse.noise_iterations`",
    "refine.hold_planes": "`refine.keep_planes`",
    "reconstruct.track_rounds": "`reconstruct.track_iterations`",
    "factorize.light_pull": "`factorize.light_prior`",
    "factorize.start": "no setting: lights and normals start at the coarse mesh",
    "factorize.rank": "no setting: light is of first order; see single_view.factorization",
    "factorize.colour": "no setting: normals come from gray, albedo from every channel",
    **{
        f"triangulate.{name}": "a constant"
        for name in [
            *("facet_edge_px", "fill_smoothing", "max_view_angle_deg", "min_track_length"),
            *("max_reprojection_px", "min_angle_deg", "neighbours", "hiding_slope", "max_slope"),
            *("max_deviation", "max_isolation", "max_tilt_deg", "max_stretch", "min_altitude"),
            *("min_tip_deg", "min_coverage", "dark_share", "smoothing_rounds"),
        ]
    },
    **dict.fromkeys(
        [
            *("align.rows", "align.columns", "align.reach_samples"),
            *("sweep.step_samples", "sweep.window_samples", "sweep.loss_scale", "sweep.max_slope"),
            *("reconstruct.min_matches", "reconstruct.min_registration_points"),
            *("reconstruct.min_share", "warp.pyramid_levels", "refine.samples_per_vertex"),
            "extract.min_confidence",
            *("fuse.outlier_samples", "integrate.max_tilt_deg"),
        ],
        "a constant",
    ),
}


def _refuse_former(settings: Mapping[str, object], where: str, section: str = "") -> None:
    """Refuse a setting under a name that it had, and tell what it is now.

    Raises:
        ConfigError: Names both.
    """
    for key, value in settings.items():
        name = f"{section}.{key}" if section else str(key)
        if name in _FORMER:
            raise ConfigError(f"{where}: `{name}` is {_FORMER[name]} now.")
        if isinstance(value, Mapping):
            _refuse_former(value, where, name)


def make_chain(
    config: Config,
    observer: Observer | None = None,
    cache: Store | Path | str | None = None,
    **stages: nn.Module,
) -> CoarseToFine | Published:
    """Make the chain that settings are for.

    Args:
        config: Of one of the chains.
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
