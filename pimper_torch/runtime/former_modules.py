"""Module paths of version 0.10, which work for one more version with a warning."""

import sys
import warnings
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

# Present paths; the longest former one that matches counts. The empty one is the package.
_FORMER = {
    **{"doors": "", "ground": "", "method": "stages", "published": "paper", "result": ""},
    "doors.camera_files": "io.cameras",
    "doors.export.openexr": "io.openexr",
    "doors.io.reports": "export.reports",
    "doors.io.results": "export.results",
    "doors.result_folder": "export.result_folder",
    "ground.shapes": "records.shapes",
    "method.chains": "chains",
    "method.chains.presets": "presets.load_chain",
    "method.chains.published": "paper.chain",
    "method.photometry.depth_from_light": "stages.light_depth.depth_from_light",
    "method.photometry.light_field": "lighting.light_field",
    "method.photometry.lights": "lighting.lights",
    "method.sfm.existing": "io.cameras.existing",
    "method.sfm.model": "records.sparse_model",
    "method.sfm.model_files": "io.cameras.model_files",
    "published.published_config": "paper.paper_config",
    "result.asset": "stages.texturing",
    "result.asset.finish": "stages.meshing.finish",
    "result.asset.gltf": "io.assets.gltf",
    "result.asset.mesh_files": "io.assets.mesh_files",
    "result.asset.write": "io.assets.write",
    "result.relighting": "stages.relighting",
    "result.report": "viz.report",
    "runtime.stage": "stages.stage",
    "runtime.store": "store",
}


def present_path(former: str) -> str | None:
    """Return the present path of a module in the package; ``None`` if it has not changed."""
    parts = former.split(".")
    heads = (".".join(parts[:count]) for count in range(len(parts), 0, -1))
    head = next((head for head in heads if head in _FORMER), None)
    return None if head is None else f"{_FORMER[head]}{former[len(head) :]}".removeprefix(".")


def renamed(old: str, new: str) -> str:
    """Warn that a name has changed, and return the new one."""
    warnings.warn(f"`{old}` is now `{new}`.", DeprecationWarning, stacklevel=3)
    return new


class FormerModules(MetaPathFinder, Loader):
    """Finder of modules by their former paths, which gives the present module."""

    def find_spec(
        self, name: str, path: object, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return how to load a module with a former path; ``None`` for others."""
        package, _, former = name.partition(".")
        present = present_path(former) if package == "pimper_torch" else None
        present_name = f"{package}.{present}".removesuffix(".")
        return None if present is None else ModuleSpec(name, self, loader_state=present_name)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Import the present module."""
        present = import_module(renamed(spec.name, spec.loader_state))
        spec.loader_state = present.__spec__
        return present

    def exec_module(self, module: ModuleType) -> None:
        """Restore the specification of the present module."""
        if module.__spec__ is not None:
            module.__spec__ = module.__spec__.loader_state


def install() -> None:
    """Let imports find former paths, before other finders load a second copy of a module."""
    sys.meta_path.insert(0, FormerModules())
