"""Results of a run, one after another, in the viewer."""

import torch

from pimper_torch.chains.chain import Step
from pimper_torch.records import Mesh, Reconstruction, Silhouettes, SparseScene
from pimper_torch.relighting.fit_lights import fit_lights
from pimper_torch.viewer.viewer import Viewer

COARSE, RESULT = "coarse surface", "result"


def add_found(viewer: Viewer, found: SparseScene | Step, reference: int = 0) -> None:
    """Show cameras, photographs and points, or the surface of a pass, as soon as it is there."""
    if isinstance(found, Step):
        viewer.add_pass(f"pass at {found.scale:g} of the photographs", found.surface.mesh)
    else:
        names = found.views.names
        viewer.add_cameras(names, found.cameras, found.points_world, reference, found.views)


def add_outcome(viewer: Viewer, result: Reconstruction) -> None:
    """Show the surface of a run, and know the lights of its photographs."""
    viewer.add_pass(RESULT, result.mesh)
    add_lights(viewer, result.mesh, result.scene, result.silhouettes)


def add_lights(viewer: Viewer, mesh: Mesh, scene: SparseScene, silhouettes: Silhouettes) -> None:
    """Fit the light of every photograph, as the report does, for the viewer to set."""
    with torch.no_grad():
        lights = fit_lights(mesh.to("cpu"), scene.to("cpu"), silhouettes.to("cpu"))
    ambient, directed = lights.ambient.mean(dim=1), lights.directed.mean(dim=1)
    share = ambient / (ambient + directed).clamp_min(torch.finfo(ambient.dtype).tiny)
    viewer.set_lights(scene.views.names, lights.direction_world, share)
