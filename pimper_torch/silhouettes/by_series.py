"""Silhouettes of an object that was moved between series of photographs: each series by itself.

In the object's frame its surroundings are elsewhere in every series, and so is the plane that it
stands on.
"""

from collections.abc import Callable

import torch

from pimper_torch.ledger import leave_out
from pimper_torch.records import Silhouettes, SparseScene
from pimper_torch.sfm.sound_views import with_views


def by_series(scene: SparseScene, find: Callable[[SparseScene], Silhouettes]) -> Silhouettes:
    """Find silhouettes in the views of each series, and put them side by side.

    Args:
        find: From the scene of one series to its silhouettes.

    Returns:
        Of all views. Where those of one series are everything, everything above every known plane.
    """
    if not len(scene.series):
        return find(scene)
    chosen = [scene.series == number for number in sorted(set(scene.series.tolist()))]
    views = [one.nonzero()[:, 0] for one in chosen]
    found = [find(part(scene, one.tolist())) for one in views]
    doubtful = sum(one.source == "everything" for one in found)
    leave_out("silhouettes.by_series", doubtful, total=len(found))
    if doubtful:
        planes = torch.cat([one.planes_world for one in found])
        return Silhouettes.everything(scene.views, planes)
    order = torch.cat(views).argsort()
    hidden = [one.inside < 0 if one.hidden is None else one.hidden for one in found]
    return found[0].replace(
        inside=torch.cat([one.inside for one in found])[order],
        reliable=torch.cat([one.reliable for one in found])[order],
        hidden=torch.cat(hidden)[order] if any(map(torch.any, hidden)) else None,
    )


def part(scene: SparseScene, views: list[int]) -> SparseScene:
    """Return the scene of some views, as if the object had stood there alone."""
    kept = torch.zeros(scene.views.num_views, dtype=torch.bool)
    kept[views] = True
    some = with_views(scene, kept)
    return some.replace(series=some.series[:0])
