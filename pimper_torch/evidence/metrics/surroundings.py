"""Rays through the object's pixels that a mesh lets pass to the table."""

import torch
from jaxtyping import Bool
from torch import Tensor

from pimper_torch.evidence.metrics.relative import Meeting
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.records import Truth


def without_surroundings(met: Meeting, truth: Truth) -> Meeting:
    """Count rays that meet the surroundings behind the object as misses.

    Where a surface has a hole on the object and goes on over the table, a ray through the
    hole meets the table: no error of the object's shape, but a part of it that is not there.
    Such a point lies behind the true one on its ray, and nearer to the true surroundings than
    to the true object.

    Args:
        met: Frame of the truth; of the rays that meet the object.
        truth: Where it has no mesh or no surroundings, nothing changes.
    """
    if truth.mesh is None or truth.surroundings is None or not len(truth.surroundings.faces):
        return met
    beside = met.both.clone()
    beside[met.both] = _beside(met, NearestSurface(truth.mesh), NearestSurface(truth.surroundings))
    return met.only(~beside)


def _beside(
    met: Meeting, true_object: NearestSurface, surroundings: NearestSurface
) -> Bool[Tensor, " ray"]:
    off = (met.points - met.points_true).norm(dim=1)
    asked = (met.points.norm(dim=1) > met.points_true.norm(dim=1)).nonzero()[:, 0]
    points = met.points_world[asked]
    aside = surroundings.query(points).distance
    # The object is no farther than its point on the ray, so that most need not be asked.
    unsure = aside < off[asked]
    asked, points, aside = asked[unsure], points[unsure], aside[unsure]
    beside = torch.zeros(len(off), dtype=torch.bool, device=off.device)
    beside[asked] = aside < true_object.query(points).distance
    return beside
