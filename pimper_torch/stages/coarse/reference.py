"""The reference view: the frontal one, or the one given by name."""

from pimper_torch.records import SparseScene
from pimper_torch.runtime.file_names import view_named


def reference_view(scene: SparseScene, name: str = "") -> int:
    """Return the view that shares the most points with the others, or the one with a name.

    Each other view counts with the square root of the number of shared points, so that many views
    on the sides have more weight than one nearly identical view.
    """
    if not name:
        observed = scene.observed.to(scene.points_world.dtype)
        shared = (observed.mT @ observed).fill_diagonal_(0)
        return int(shared.sqrt().sum(dim=1).argmax())
    return view_named(name, scene.views.names, "registered photographs")
