"""Module paths of version 0.10, which work for one more version with a warning."""

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

# Former paths and present ones, in the package; the longest one that matches counts. A folder
# without a present path only held others.
_FORMER = {
    "doors": None,
    "doors.camera_files": "io.cameras",
    "doors.export": "export",
    "doors.export.openexr": "io.openexr",
    "doors.io": "io",
    "doors.io.reports": "export.reports",
    "doors.io.results": "export.results",
    "doors.result_folder": "export.result_folder",
    "doors.scale": "scale",
    "ground": None,
    "ground.geometry": "geometry",
    "ground.kernels": "kernels",
    "ground.linalg": "linalg",
    "ground.radiometry": "radiometry",
    "ground.shapes": "records.shapes",
    "method": None,
    "method.chains": "chains",
    "method.chains.presets": "presets.load_chain",
    "method.chains.published": "paper.chain",
    "method.coarse": "stages.coarse",
    "method.fusion": "stages.fusion",
    "method.meshing": "stages.meshing",
    "method.patches": "stages.patches",
    "method.photometry": "stages.photometry",
    "method.photometry.depth_from_light": "stages.light_depth.depth_from_light",
    "method.photometry.light_field": "lighting.light_field",
    "method.photometry.lights": "lighting.lights",
    "method.sfm": "stages.sfm",
    "method.sfm.existing": "io.cameras.existing",
    "method.sfm.model": "records.sparse_model",
    "method.sfm.model_files": "io.cameras.model_files",
    "method.silhouettes": "stages.silhouettes",
    "method.sweep": "stages.sweep",
    "published": "paper",
    "published.published_config": "paper.paper_config",
    "result": None,
    "result.asset": "stages.texturing",
    "result.asset.finish": "stages.meshing.finish",
    "result.asset.gltf": "io.assets.gltf",
    "result.asset.mesh_files": "io.assets.mesh_files",
    "result.asset.usd": "io.assets.usd",
    "result.asset.write": "io.assets.write",
    "result.relighting": "stages.relighting",
    "result.report": "viz.report",
    "result.viewer": "viewer",
    "result.viz": "viz",
    "runtime.stage": "stages.stage",
    "runtime.store": "store",
}


def renamed(old: str, new: str) -> str:
    """Warn that a name has changed, and return the new one."""
    warnings.warn(f"`{old}` is now `{new}`.", DeprecationWarning, stacklevel=3)
    return new


class FormerModules(MetaPathFinder, Loader):
    """Finder of modules by their former paths, which gives the present module."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return how to load a module with a former path; ``None`` for others."""
        package, _, inside = name.partition(".")
        if package != "pimper_torch":
            return None
        parts = inside.split(".")
        heads = (".".join(parts[:count]) for count in range(len(parts), 0, -1))
        former = next((head for head in heads if head in _FORMER), None)
        if former is None:
            return None
        present = _FORMER[former]
        if present is None:
            return ModuleSpec(name, self, is_package=True) if former == inside else None
        return ModuleSpec(name, self, loader_state=f"{package}.{present}{inside[len(former) :]}")

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Import the present module; a folder that only held others is a new module."""
        if spec.loader_state is None:
            return None
        present = import_module(renamed(spec.name, spec.loader_state))
        spec.loader_state = present.__spec__
        return present

    def exec_module(self, module: ModuleType) -> None:
        """Restore the specification of the present module."""
        spec = module.__spec__
        if spec is not None and spec.loader_state is not None:
            module.__spec__ = spec.loader_state


def install() -> None:
    """Let imports find former paths, before other finders load a second copy of a module."""
    sys.meta_path.insert(0, FormerModules())
