"""The reference view: the frontal one, or the one that a setting names."""

from pimper_torch.records import SparseScene
from pimper_torch.runtime.file_names import view_named


def reference_view(scene: SparseScene, name: str = "") -> int:
    """Choose the view that shares the most points with the others, or find one by name.

    Each other view counts with the square root of the number of points shared, so that many
    views at the side weigh more than one close twin.
    """
    if not name:
        observed = scene.observed.to(scene.points_world.dtype)
        shared = (observed.mT @ observed).fill_diagonal_(0)
        return int(shared.sqrt().sum(dim=1).argmax())
    return view_named(name, scene.views.names, "registered photographs")
