"""Photographs that are kept from the reconstruction, to judge it by."""

from collections.abc import Iterable

import torch

from pimper_torch.config import require
from pimper_torch.records import SparseScene
from pimper_torch.sfm.sparse_scene import with_views

# As many as a surface needs, as everywhere.
_MIN_VIEWS = 3


def held_apart(
    scene: SparseScene, every: int, needed: Iterable[str] = ()
) -> tuple[SparseScene, SparseScene | None]:
    """Divide a scene into views that are used, and every n-th by name that is held out.

    Args:
        every: Which; 0 for none.
        needed: Names, with their suffix or without, of views that are used in any case.

    Returns:
        Both with the whole cloud; the first is the scene itself where no view is held out.

    Raises:
        ConfigError: Too few views are left.
    """
    names, stay = scene.views.names, set(needed)
    ordered = sorted(range(len(names)), key=names.__getitem__)
    chosen = ordered[every - 1 :: every] if every else []
    held = [view for view in chosen if not stay & {names[view], names[view].rsplit(".", 1)[0]}]
    if not held:
        return scene, None
    left = len(names) - len(held)
    needs = f"a number that leaves {_MIN_VIEWS} views at least; it leaves {left}"
    require(left >= _MIN_VIEWS, "hold_out", every, needs)
    out = torch.zeros(len(names), dtype=torch.bool)
    out[held] = True
    return (
        with_views(scene, ~out).replace(unregistered=scene.unregistered),
        with_views(scene, out).replace(unregistered=()),
    )
