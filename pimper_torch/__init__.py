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
    from pimper_torch.coarse.remesh import Remesh
    from pimper_torch.coarse.surface import CoarseSurface
    from pimper_torch.fusion.fuse import Fuse
    from pimper_torch.io.finish import MeshFiles
    from pimper_torch.io.meshes import read_mesh
    from pimper_torch.io.photographs import load_views
    from pimper_torch.io.results import write_result
    from pimper_torch.io.tensors import scene_of
    from pimper_torch.meshing.extract import Extract
    from pimper_torch.meshing.repair import Repair
    from pimper_torch.paper.triangulate import Triangulate
    from pimper_torch.patches.decompose import Decompose
    from pimper_torch.patches.warp import Warp
    from pimper_torch.photometry.factorize import Factorize, FactorizeConfig
    from pimper_torch.radiometry import Encoding
    from pimper_torch.records import (
        Cameras,
        CoarseMesh,
        DepthPatches,
        Mesh,
        PatchSet,
        PatchViews,
        PhotometricPatches,
        Reconstruction,
        Record,
        Silhouettes,
        SparseScene,
        Surface,
        SweptPatches,
        Views,
    )
    from pimper_torch.records.stored import load_record, save_record
    from pimper_torch.sfm.reconstruct import Reconstruct
    from pimper_torch.silhouettes.find import FindSilhouettes
    from pimper_torch.single_view.integration import integrate_normal_map
    from pimper_torch.single_view.photometric_stereo.stereo import photometric_stereo
    from pimper_torch.size.find import find_scale
    from pimper_torch.size.given import CameraDistance, Mark, ScaleBar
    from pimper_torch.size.scale import Scale
    from pimper_torch.size.scaled import scaled
    from pimper_torch.stage import Given, Stage
    from pimper_torch.store.folders import user_cache
    from pimper_torch.sweep.sweep import Sweep
    from pimper_torch.viz.patches import by_facet, plot_in_view, plot_patch

__all__ = [
    "CameraDistance",
    "Cameras",
    "Chain",
    "CoarseMesh",
    "CoarseSurface",
    "CoarseToFine",
    "CoarseToFineConfig",
    "ConfigError",
    "Decompose",
    "DepthPatches",
    "Encoding",
    "Extract",
    "Factorize",
    "FactorizeConfig",
    "FindSilhouettes",
    "Fuse",
    "Given",
    "InputError",
    "Mark",
    "Mesh",
    "MeshFiles",
    "OutputError",
    "PatchSet",
    "PatchViews",
    "PhotometricPatches",
    "PimperError",
    "PimperWarning",
    "Published",
    "PublishedConfig",
    "Reconstruct",
    "Reconstruction",
    "ReconstructionError",
    "Record",
    "Remesh",
    "Repair",
    "Scale",
    "ScaleBar",
    "Silhouettes",
    "SparseScene",
    "Stage",
    "Step",
    "Surface",
    "Sweep",
    "SweptPatches",
    "Triangulate",
    "Views",
    "Warp",
    "__version__",
    "by_facet",
    "find_scale",
    "integrate_normal_map",
    "load_chain",
    "load_config",
    "load_record",
    "load_views",
    "make_chain",
    "photometric_stereo",
    "plot_in_view",
    "plot_patch",
    "read_mesh",
    "save_record",
    "scaled",
    "scene_of",
    "user_cache",
    "write_result",
]

# What needs torch is imported when it is asked for, so that the command line answers at once.
_HOMES = {
    "pimper_torch.chains.chain": (
        "Chain",
        "Step",
    ),
    "pimper_torch.chains.coarse_to_fine": (
        "CoarseToFine",
        "CoarseToFineConfig",
    ),
    "pimper_torch.chains.presets": (
        "load_chain",
        "load_config",
        "make_chain",
    ),
    "pimper_torch.chains.published": (
        "Published",
        "PublishedConfig",
    ),
    "pimper_torch.coarse.remesh": ("Remesh",),
    "pimper_torch.coarse.surface": ("CoarseSurface",),
    "pimper_torch.paper.triangulate": ("Triangulate",),
    "pimper_torch.fusion.fuse": ("Fuse",),
    "pimper_torch.io.finish": ("MeshFiles",),
    "pimper_torch.io.meshes": ("read_mesh",),
    "pimper_torch.io.photographs": ("load_views",),
    "pimper_torch.io.results": ("write_result",),
    "pimper_torch.io.tensors": ("scene_of",),
    "pimper_torch.meshing.extract": ("Extract",),
    "pimper_torch.meshing.repair": ("Repair",),
    "pimper_torch.silhouettes.find": ("FindSilhouettes",),
    "pimper_torch.patches.decompose": ("Decompose",),
    "pimper_torch.patches.warp": ("Warp",),
    "pimper_torch.photometry.factorize": (
        "Factorize",
        "FactorizeConfig",
    ),
    "pimper_torch.radiometry": ("Encoding",),
    "pimper_torch.records": (
        "Cameras",
        "CoarseMesh",
        "DepthPatches",
        "Mesh",
        "Silhouettes",
        "PatchSet",
        "PatchViews",
        "PhotometricPatches",
        "Reconstruction",
        "Record",
        "SparseScene",
        "Surface",
        "SweptPatches",
        "Views",
    ),
    "pimper_torch.records.stored": (
        "load_record",
        "save_record",
    ),
    "pimper_torch.store.folders": ("user_cache",),
    "pimper_torch.sfm.reconstruct": ("Reconstruct",),
    "pimper_torch.single_view.integration": ("integrate_normal_map",),
    "pimper_torch.single_view.photometric_stereo.stereo": ("photometric_stereo",),
    "pimper_torch.size.find": ("find_scale",),
    "pimper_torch.size.given": (
        "CameraDistance",
        "Mark",
        "ScaleBar",
    ),
    "pimper_torch.size.scale": ("Scale",),
    "pimper_torch.size.scaled": ("scaled",),
    "pimper_torch.stage": (
        "Given",
        "Stage",
    ),
    "pimper_torch.sweep.sweep": ("Sweep",),
    "pimper_torch.viz.patches": (
        "by_facet",
        "plot_in_view",
        "plot_patch",
    ),
}


def __getattr__(name: str) -> object:
    if name == "__version__":
        return import_module("pimper_torch.io.version").installed_version()
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(home), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
