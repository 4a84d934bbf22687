"""The stage that turns silhouettes into constraints on the surface."""

import torch

from pimper_torch.geometry.contours import Contours, contour_rays
from pimper_torch.geometry.visual_hull import bounding_cube, visual_hull
from pimper_torch.records import Cameras, Silhouettes
from pimper_torch.runtime.errors import caution
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.stages.stage import Stage

# Fraction of the views whose silhouette may be wrong at a position. Found silhouettes lack parts in
# shadow: with 0.05, if 4 of 24 silhouettes of a cow lack a third of it, 23 % of its pixels are not
# covered, with 0.1 only 0.3 %. With 0.15, one of 8 views is outvoted: Chamfer 0.19 instead of 0.12.
_DISAGREEING = {"masks": 0.03, "found": 0.1}


class TraceContours(Stage):
    """Turn silhouettes into constraints on the surface. Not differentiable."""

    @torch.no_grad()
    def forward(self, silhouettes: Silhouettes, cameras: Cameras) -> Contours:
        """Cast rays through the silhouettes and build their visual hull.

        Returns:
            Contours without constraints if silhouettes exclude nothing and, with a warning, if they
            have no point in common.
        """
        if silhouettes.source == "everything":
            return Contours.none(silhouettes, cameras)
        box = bounding_cube(silhouettes, cameras)
        hull = None
        if box is not None:  # voxels need no more than single precision
            fraction = _DISAGREEING[silhouettes.source]
            hull = visual_hull(
                silhouettes, cameras.to(torch.float32), box.float(), disagreeing=fraction
            )
        leave_out("contours.hull", hull is None)
        if hull is None:
            caution(
                "contours: the silhouettes of the views have no point in common, so they do not "
                "constrain the surface. Check whether the masks show the same object in all "
                "photographs.",
                stacklevel=2,
            )
            return Contours.none(silhouettes, cameras)
        rays = contour_rays(silhouettes, cameras)
        return Contours(silhouettes=silhouettes, rays=rays, cameras=cameras, hull=hull)
