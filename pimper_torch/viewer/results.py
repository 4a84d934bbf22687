"""What a run finds, one after another, in the viewer."""

from pimper_torch.chains.chain import Step
from pimper_torch.io.estimates import estimate_of
from pimper_torch.records import Reconstruction, SparseScene
from pimper_torch.viewer.viewer import Viewer

COARSE, RESULT = "coarse surface", "result"


def add_found(viewer: Viewer, found: SparseScene | Step, reference: int = 0) -> None:
    """Show cameras, photographs and points, or the surface of a pass, as soon as it is there.

    Args:
        reference: View that the page begins in.
    """
    if isinstance(found, Step):
        viewer.add_pass(f"pass at {found.scale:g} of the photographs", found.surface.mesh)
    else:
        names = found.views.names
        viewer.add_cameras(names, found.cameras, found.points_world, reference, found.views)


def add_outcome(viewer: Viewer, result: Reconstruction) -> None:
    """Show the surface of a run, and know the lights of its photographs."""
    viewer.set_lights(result.scene.views.names, estimate_of(result).lights_world)
    viewer.add_pass(RESULT, result.mesh)
